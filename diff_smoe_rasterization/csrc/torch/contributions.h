// The op `contributions`, once for all backends: sums over the pixels of each Gaussian, from what a rendering saved.
#pragma once

#include <tuple>

#include "checks.h"
#include "tensors.h"

namespace dsmoe {
namespace binding {

// The op's results, in its order.
using ContributionTensors = std::tuple<at::Tensor, at::Tensor, at::Tensor, at::Tensor>;

template <class S> ContributionSums<S> contribution_sums(const ContributionTensors& tensors) {
  ContributionSums<S> out;
  out.pixel_weights = mutable_data<S>(std::get<0>(tensors));
  out.pixels = mutable_data<int32_t>(std::get<1>(tensors));
  out.blend_weights = mutable_data<S>(std::get<2>(tensors));
  out.distances = mutable_data<S>(std::get<3>(tensors));
  return out;
}

// Of the options, those that say which pairs count.
inline Options blend_options(double alpha_min, double fixed_background_gate, int64_t blend_mode) {
  Options out = {};
  out.alpha_min = alpha_min, out.fixed_background_gate = fixed_background_gate, out.blend_mode = blend_mode;
  return out;
}

template <class S> RasterConfig<S> contribution_config(const at::Tensor& background_gate, const Options& blend) {
  RasterConfig<S> out;
  set_blend(out, background_gate, blend);
  return out;
}

// outputs: those of the rendering that the op reads; the others are undefined tensors.
using ContributionFunction = void (*)(const at::Tensor& pixel_weights, const Outputs& outputs,
                                      const at::Tensor& background_gate, const Options& blend,
                                      const ContributionTensors& sums);

template <ContributionFunction kContributions>
ContributionTensors contributions(const at::Tensor& pixel_weights, const at::Tensor& radii, const at::Tensor& projected,
                                  const at::Tensor& instance_offsets, const at::Tensor& tile_offsets,
                                  const at::Tensor& instances, const at::Tensor& last_contributor,
                                  const at::Tensor& order, const OptionalTensor& gate, double alpha_min,
                                  double fixed_background_gate, int64_t blend_mode) {
  Outputs outputs;
  outputs[kRadii] = radii, outputs[kProjected] = projected, outputs[kInstanceOffsets] = instance_offsets;
  outputs[kTileOffsets] = tile_offsets, outputs[kInstances] = instances;
  outputs[kLastContributor] = last_contributor, outputs[kOrder] = order;
  const at::Tensor background_gate = gate.has_value() ? *gate : at::Tensor();
  const Options blend = blend_options(alpha_min, fixed_background_gate, blend_mode);
  check_contribution_arguments(pixel_weights, outputs, background_gate, blend);
  const auto real = [&] { return at::empty({projected.size(0)}, projected.options()); };
  const ContributionTensors sums = {real(), at::empty({projected.size(0)}, radii.options()), real(), real()};
  kContributions(pixel_weights.contiguous(), outputs, background_gate, blend, sums);
  return sums;
}

}  // namespace binding
}  // namespace dsmoe
