// The op of the Gaussians that have a part in each pixel.
#pragma once

#include "torch/backend.h"

namespace dsmoe {
namespace binding {

template <class Backend> void gate_map(Arguments& arguments) {
  auto gate_sum = arguments.read<Tensor>();
  const auto radii = arguments.read<Tensor>();
  const Saved saved = read_saved(arguments);
  const Tensor background_gate = read_optional(arguments);
  const auto options = read_options(arguments);
  const Expect expect = check_saved("gate_map", radii, saved, background_gate, options);
  expect("gate_sum", gate_sum, {1, options.image_height, options.image_width});
  const typename Backend::Guard guard(radii.device());
  const auto image = [&] { return empty({options.image_height, options.image_width}, radii, kInt); };
  const Tensor gaussians = image(), counts = image(), medians = image();
  gate_sum = gate_sum.contiguous();
  dispatch("gate_map", saved[0], [&](auto zero) {
    using S = decltype(zero);
    const GateMap map = {mutable_data<int32_t>(gaussians), mutable_data<int32_t>(counts),
                         mutable_data<int32_t>(medians)};
    auto own = Backend::template walked<S>(expect, radii, saved, blend_config<S>(background_gate, options), options);
    set_sums(own.saved, Backend::saved_sizes(own, options), mutable_data<S>(gate_sum));
    TensorMemory memory(radii);
    DSMOE_WALK(Backend, gate_map, own, map, options, memory);
  });
  arguments.give_back(gaussians, counts, medians);
}

template <class Backend, class Ops> void gate_map_ops(Ops& ops) {
  // From what one rasterize saved: the Gaussian of the greatest gate in each pixel [H, W], how many have a part, and
  // the median one.
  ops.template add<&gate_map<Backend>>(
      "gate_map(Tensor gate_sum, Tensor radii, Tensor[] saved, Tensor? background_gate, " + options_in_schema() +
      ") -> (Tensor gaussians, Tensor counts, Tensor medians)");
}

}  // namespace binding
}  // namespace dsmoe
