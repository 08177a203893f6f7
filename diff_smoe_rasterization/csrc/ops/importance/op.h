// The op of what each Gaussian is worth to an image.
#pragma once

#include "torch/backend.h"

namespace dsmoe {
namespace binding {

template <class Backend> void importance(Arguments& arguments) {
  const auto pixel_weights = arguments.read<Tensor>();
  Tensor share_weights, color, gate_sum, background;
  for (auto* image : {&share_weights, &color, &gate_sum, &background}) arguments.read(*image);
  const auto radii = arguments.read<Tensor>();
  const Saved saved = read_saved(arguments);
  const Tensor background_gate = read_optional(arguments);
  const auto options = read_options(arguments);
  const Expect expect = check_saved("importance", radii, saved, background_gate, options);
  expect("pixel_weights", pixel_weights, {options.image_height, options.image_width});
  const int64_t height = options.image_height, width = options.image_width;
  expect("share_weights", share_weights, {height, width});
  expect("color", color, {"C", height, width});
  expect("gate_sum", gate_sum, {1, height, width});
  expect("bg", background, {color.size(0)});
  const typename Backend::Guard guard(radii.device());
  const auto sums = [&] { return empty({radii.numel()}, pixel_weights); };
  const Tensor shares = sums(), squared_shares = sums(), removal_costs = sums();
  const Tensor weights = pixel_weights.contiguous();
  for (auto* image : {&share_weights, &color, &gate_sum, &background}) *image = image->contiguous();
  dispatch("importance", weights, [&](auto zero) {
    using S = decltype(zero);
    RasterConfig<S> config = blend_config<S>(background_gate, options);
    config.num_channels = static_cast<int>(color.size(0));
    config.background = data<S>(background);
    ask_for_features(config, options);
    ImportanceMap<S> map;
    map.color = data<S>(color);
    map.pixel_weights = data<S>(weights);
    map.share_weights = data<S>(share_weights);
    map.sums.shares = mutable_data<S>(shares);
    map.sums.squared_shares = mutable_data<S>(squared_shares);
    map.sums.removal_costs = mutable_data<S>(removal_costs);
    auto own = Backend::template frame_of_rendering<S>(radii, config, options);
    Backend::take_saved(own, expect, saved, mutable_data<S>(gate_sum), options);
    TensorMemory memory(gate_sum);
    DSMOE_WALK(Backend, importance, own, map, options, memory);
  });
  arguments.give_back(shares, squared_shares, removal_costs);
}

template <class Backend, class Ops> void importance_ops(Ops& ops) {
  // From the images of one rendering, weights of its pixels [H, W] and what it saved: what each Gaussian is worth.
  ops.template add<&importance<Backend>>(
      "importance(Tensor pixel_weights, Tensor share_weights, Tensor color, Tensor gate_sum, Tensor bg, Tensor radii, "
      "Tensor[] saved, Tensor? background_gate, " +
      options_in_schema() + ") -> (Tensor shares, Tensor squared_shares, Tensor removal_costs)");
}

}  // namespace binding
}  // namespace dsmoe
