// The op of the sums over the pixels of each Gaussian.
#pragma once

#include "torch/backend.h"

namespace dsmoe {
namespace binding {

template <class Backend> void contributions(Arguments& arguments) {
  const auto pixel_weights = arguments.read<Tensor>();
  const auto radii = arguments.read<Tensor>();
  const Saved saved = read_saved(arguments);
  const Tensor background_gate = read_optional(arguments);
  const auto options = read_options(arguments);
  const Expect expect = check_saved("contributions", radii, saved, background_gate, options);
  expect("pixel_weights", pixel_weights, {options.image_height, options.image_width});
  const typename Backend::Guard guard(radii.device());
  const auto real = [&] { return empty({radii.numel()}, pixel_weights); };
  const Tensor weights = real(), pixels = empty_like(radii), blend_weights = real(), distances = real();
  const Tensor map = pixel_weights.contiguous();
  dispatch("contributions", map, [&](auto zero) {
    using S = decltype(zero);
    ContributionSums<S> sums;
    sums.pixel_weights = mutable_data<S>(weights);
    sums.pixels = mutable_data<int32_t>(pixels);
    sums.blend_weights = mutable_data<S>(blend_weights);
    sums.distances = mutable_data<S>(distances);
    const auto own =
        Backend::template walked<S>(expect, radii, saved, blend_config<S>(background_gate, options), options);
    const ContributionMap<S> arguments = {data<S>(map), sums};
    TensorMemory memory(map);
    DSMOE_WALK(Backend, contributions, own, arguments, options, memory);
  });
  arguments.give_back(weights, pixels, blend_weights, distances);
}

template <class Backend, class Ops> void contributions_ops(Ops& ops) {
  // From a map [H, W] and what one rasterize saved: sums over the pixels of each Gaussian.
  ops.template add<&contributions<Backend>>(
      "contributions(Tensor pixel_weights, Tensor radii, Tensor[] saved, Tensor? background_gate, " +
      options_in_schema() + ") -> (Tensor pixel_weights, Tensor pixels, Tensor blend_weights, Tensor distances)");
}

}  // namespace binding
}  // namespace dsmoe
