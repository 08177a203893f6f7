// A renderer without tiles, rows or packs: every pixel asks every Gaussian, by the headers' own scalar functions.
#pragma once

#include <algorithm>
#include <cmath>
#include <limits>
#include <numeric>
#include <utility>
#include <vector>

#include "dispatch.h"
#include "dsmoe/arrays.h"
#include "dsmoe/passes/contributions.h"
#include "dsmoe/pixel.h"
#include "test_scene.h"

namespace dsmoe {

template <class S> struct BruteForce {
  std::vector<int32_t> radii;
  std::vector<S> color, depth, inverse_depth, gate_sum;
  // For each pixel, how near, relatively, any decision came to its threshold: where rounding could turn one over,
  // another order of operations may give another image.
  std::vector<double> margin;
  int64_t num_pairs = 0;                            // that count
  std::vector<Contribution<double>> contributions;  // of each Gaussian, under brute_force_pixel_weight
  // Of each pixel: the Gaussian of the greatest weight, or -1; how far, relatively, the second greatest is below it;
  // and how many pairs contribute. The Gaussian with which the weights reach half of the denominator, or -1; and how
  // near, relatively, a sum of weights came to that half.
  std::vector<int32_t> greatest, num_contributing, medians;
  std::vector<double> lead, median_margin;

  double smallest_margin() const { return *std::min_element(margin.begin(), margin.end()); }
};

// Positive, and a number of every scalar type.
template <class S> S brute_force_pixel_weight(int64_t pixel) { return S(1 + pixel % 97) / S(64); }

template <BlendMode kMode, class S> BruteForce<S> brute_force_in(const Scene<S>& scene) {
  const auto inputs = scene.inputs();
  const auto config = scene.raster_config();
  const auto& camera = scene.camera;
  const int num_features = config.num_features();
  const TileGrid grid(camera.width, camera.height);
  std::vector<ProjectedGaussian<S>> projected(scene.count);
  std::vector<S> features(scene.count * num_features);
  BruteForce<S> out;
  for (int64_t i = 0; i < scene.count; ++i) {
    const auto projection = project_gaussian<S>({inputs, camera, config, i}, &features[i * num_features]);
    out.radii.push_back(projection.radius);
    projected[i] = projection.gaussian;
  }
  out.contributions.resize(scene.count);
  std::vector<int64_t> order;
  for (int64_t i = 0; i < scene.count; ++i) {
    if (out.radii[i] > 0) order.push_back(i);
  }
  if (Blend<kMode>::kNeedsDepthOrder) {
    std::stable_sort(order.begin(), order.end(),
                     [&](int64_t a, int64_t b) { return projected[a].depth < projected[b].depth; });
  }

  const int64_t pixels = scene.pixels();
  out.color.resize(pixels * config.num_channels);
  out.gate_sum.resize(pixels);
  out.depth.resize(config.depth ? pixels : 0);
  out.inverse_depth.resize(config.inverse_depth ? pixels : 0);
  for (int64_t pixel = 0; pixel < pixels; ++pixel) {
    const int x = static_cast<int>(pixel % camera.width), y = static_cast<int>(pixel / camera.width);
    double margin = std::numeric_limits<double>::infinity();
    int32_t greatest = -1, num_contributing = 0;
    double greatest_weight = 0, second_weight = 0;
    std::vector<std::pair<int32_t, double>> weights;  // of the pairs that contribute
    auto decide = [&](double value, double threshold) { margin = std::min(margin, std::abs(value / threshold - 1)); };
    // Calls body(i, dx, dy, power, gate) for each Gaussian of the pixel, front to back. near: only near pairs count.
    const auto for_each_pair = [&](bool near, auto body) {
      for (const int64_t i : order) {
        const auto& g = projected[i];
        if (!(g.opacity > S(0))) continue;
        if (Blend<kMode>::kWithinRadius) {
          const TileRect rect = radius_rect(g.mean, S(out.radii[i]), grid);
          const int tile_x = x / kTileSize, tile_y = y / kTileSize;
          if (tile_x < rect.x0 || tile_x >= rect.x1 || tile_y < rect.y0 || tile_y >= rect.y1) continue;
        }
        const S dx = S(x) - g.mean.x, dy = S(y) - g.mean.y;
        const S power = ColumnExponent<S, S>(g.conic, dx).at(dy);
        S least_alpha = config.blend.alpha_cut().of(g.opacity);
        if (near) least_alpha = near_alpha(g.opacity, least_alpha);
        const auto gate = evaluate_gate<kMode>(power, g.opacity, least_alpha);
        const double terms = double(g.conic.xx) * dx * dx + double(g.conic.yy) * dy * dy;
        if (terms > 0) margin = std::min(margin, std::abs(double(power)) / terms);
        if (Blend<kMode>::kCut == Cut::kAlpha) {
          decide(gate.alpha, kAlphaCut);
        } else if (Blend<kMode>::kCut == Cut::kStrong) {
          decide(gate.alpha, std::max<double>(least_alpha, kStrongAlpha));
        } else {
          decide(exp(power), kGateCut);
          if (least_alpha > 0) decide(gate.alpha, least_alpha);
        }
        body(i, dx, dy, power, gate);
      }
    };
    const auto decide_stop = [&](const PixelState<S>& state, const Gate<S>& gate) {
      if (gate.counts && state.is_open() && Blend<kMode>::kNeedsDepthOrder) {
        decide(state.transmittance * (S(1) - gate.alpha), kTransmittanceCut);
      }
    };
    bool wide = Blend<kMode>::kTails;
    if (config.blend.blends_near_first()) {
      auto state = PixelState<S>::open();
      for_each_pair(true, [&](int64_t, S, S, S, const Gate<S>& gate) {
        decide_stop(state, gate);
        Blend<kMode>::accumulate(state, gate);
      });
      decide(state.gate_sum, config.blend.wide_below());
      wide = state.gate_sum < config.blend.wide_below();
    }
    auto state = PixelState<S>::open();
    S tails = S(0);
    std::vector<S> sums(num_features);
    for_each_pair(config.blend.blends_near_first() && !wide, [&](int64_t i, S dx, S dy, S power, const Gate<S>& gate) {
      out.num_pairs += gate.counts;
      decide_stop(state, gate);
      if (Blend<kMode>::kTails && wide) add_tail(state, tails, tail_of(gate, power <= S(0), config.blend.tail_alpha()));
      const auto pair = Blend<kMode>::accumulate(state, gate);
      add_pair<double>(out.contributions[i], pair.contributes, brute_force_pixel_weight<S>(pixel), pair.weight, dx, dy);
      num_contributing += pair.contributes;
      if (pair.contributes) weights.push_back({static_cast<int32_t>(i), pair.weight});
      if (pair.contributes && pair.weight > greatest_weight) {
        greatest = static_cast<int32_t>(i);
        second_weight = std::exchange(greatest_weight, double(pair.weight));
      } else if (pair.contributes) {
        second_weight = std::max(second_weight, double(pair.weight));
      }
      for (int f = 0; f < num_features; ++f) sums[f] += pair.weight * features[i * num_features + f];
    });
    if (state.gate_sum > S(0)) decide(state.gate_sum, kGateSumCut);
    out.margin.push_back(margin);
    out.greatest.push_back(greatest);
    out.num_contributing.push_back(num_contributing);
    out.lead.push_back(greatest < 0 ? 1 : 1 - second_weight / greatest_weight);
    auto end = state.end(config.blend.lambda());
    end.tails = tails;
    out.gate_sum[pixel] = finish_alpha<kMode>(end);
    const double half = feature_end<kMode>(FeatureRule::kBlended, end).denominator / 2;
    double sum = 0, median_margin = std::numeric_limits<double>::infinity();
    int32_t median = -1;
    for (const auto& [i, weight] : weights) {
      sum += weight;
      median_margin = std::min(median_margin, std::abs(sum / half - 1));
      if (median < 0 && sum >= half) median = i;
    }
    out.medians.push_back(median);
    out.median_margin.push_back(median_margin);
    int f = 0;
    for (; f < config.num_channels; ++f) {
      out.color[f * pixels + pixel] = finish_feature<kMode>(FeatureRule::kBlended, end, sums[f], config.background[f]);
    }
    if (config.depth) out.depth[pixel] = finish_feature<kMode>(FeatureRule::kAveraged, end, sums[f++], S(0));
    if (config.inverse_depth)
      out.inverse_depth[pixel] = finish_feature<kMode>(FeatureRule::kBlended, end, sums[f], S(0));
  }
  return out;
}

template <class S> BruteForce<S> brute_force(const Scene<S>& scene) {
  BruteForce<S> out;
  dispatch_blend(scene.config.blend.mode, kAnyFeatures, [&](auto mode, auto) { out = brute_force_in<mode()>(scene); });
  return out;
}

}  // namespace dsmoe
