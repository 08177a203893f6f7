// Loads and stores of one Gaussian: between the arrays of params.h and the values of project.h and sh.h.
#pragma once

#include "dsmoe/params.h"
#include "dsmoe/project.h"
#include "dsmoe/sh.h"

namespace dsmoe {

template <class S> DSMOE_HD Vec3<S> load3(const S* p) { return {p[0], p[1], p[2]}; }
template <class S> DSMOE_HD void store3(S* p, Vec3<S> v) { p[0] = v.x, p[1] = v.y, p[2] = v.z; }

template <class S> DSMOE_HD Gaussian<S> load_gaussian(const GaussianInputs<S>& in, int64_t i) {
  Gaussian<S> out = {};
  out.mean = load3(in.means3D + 3 * i);
  out.opacity = in.opacities[i];
  out.has_covariance = in.cov3D_precomp != nullptr;
  if (out.has_covariance) {
    const S* c = in.cov3D_precomp + 6 * i;
    out.covariance = {c[0], c[1], c[2], c[3], c[4], c[5]};
  } else {
    const S* q = in.rotations + 4 * i;
    out.scale = load3(in.scales + 3 * i);
    out.rotation = {q[0], q[1], q[2], q[3]};
  }
  return out;
}

// Reads coefficients of spherical harmonics by their number.
template <class S> struct ShReader {
  const S* dc;    // [3] degree 0
  const S* rest;  // [K - 1, 3] the others
  DSMOE_HD Vec3<S> operator()(int k) const { return k == 0 ? load3(dc) : load3(rest + 3 * (k - 1)); }
};

// Writes gradients of coefficients by their number. Either array may be null. Then those gradients are not wanted.
template <class S> struct ShWriter {
  S* dc;    // [3]
  S* rest;  // [K - 1, 3]
  DSMOE_HD void operator()(int k, Vec3<S> value) const {
    if (k == 0 && dc != nullptr) store3(dc, value);
    if (k > 0 && rest != nullptr) store3(rest + 3 * (k - 1), value);
  }
};

// The colours of one Gaussian. They are either given, or made of coefficients of spherical harmonics.
template <class S> struct Colors {
  const S* given;  // [C], or null
  const S* dc;     // [3], or null if shs holds degree 0
  const S* shs;    // [num_sh, 3], or null
  int num_sh;      // coefficients in shs
  int sh_degree;   // active degree

  DSMOE_HD ShReader<S> sh() const { return dc != nullptr ? ShReader<S>{dc, shs} : ShReader<S>{shs, shs + 3}; }
};

template <class S> DSMOE_HD Colors<S> colors_of(const GaussianInputs<S>& in, int num_channels, int64_t i) {
  const auto at = [i](const S* base, int size) { return base == nullptr ? nullptr : base + i * size; };
  return {at(in.colors_precomp, num_channels), at(in.dc, 3), at(in.shs, 3 * in.num_sh), in.num_sh, in.sh_degree};
}

// Where the gradients of a Gaussian's colours go. Any may be null.
template <class S> struct ColorGradients {
  S* given;  // [C]
  S* dc;     // [3]
  S* shs;    // [num_sh, 3]
};

template <class S>
DSMOE_HD ColorGradients<S> color_gradients_of(const GaussianGradients<S>& g, int num_channels, int num_sh, int64_t i) {
  const auto at = [i](S* base, int size) { return base == nullptr ? nullptr : base + i * size; };
  return {at(g.colors_precomp, num_channels), at(g.dc, 3), at(g.shs, 3 * num_sh)};
}

// Whether all numbers that a Gaussian's colour is made of are finite. Else the Gaussian is culled.
template <class S> DSMOE_HD bool is_finite(const Colors<S>& colors, int num_channels) {
  bool finite = true;
  if (colors.given != nullptr) finite = finite && all_finite(colors.given, num_channels);
  if (colors.shs != nullptr) finite = finite && all_finite(colors.shs, 3 * colors.num_sh);
  if (colors.dc != nullptr) finite = finite && all_finite(colors.dc, 3);
  return finite;
}

// What the colour of one Gaussian on an image depends on.
template <class S> struct ColorSource {
  Colors<S> colors;
  Vec3<S> mean;                    // of the Gaussian, world
  const PinholeCamera<S>& camera;  // that sees it; its lens has no part in a colour
  const RasterConfig<S>& config;   // which features there are

  DSMOE_HD ShRules<S> sh_rules() const { return {colors.sh_degree, config.clamp_color, load3(camera.position)}; }
};

// Writes the features of a Gaussian, [F]: what the pixels blend of it. depth: its view z. Returns false if the
// Gaussian is culled.
template <class S> DSMOE_HD bool write_features(const ColorSource<S>& source, S depth, S* features) {
  const Colors<S>& colors = source.colors;
  const RasterConfig<S>& config = source.config;
  if (!is_finite(colors, config.num_channels)) return false;
  if (colors.given != nullptr) {
    for (int c = 0; c < config.num_channels; ++c) features[c] = colors.given[c];
  } else {
    store3(features, sh_color(source.sh_rules(), source.mean, colors.sh()));
  }
  S* extra = features + config.num_channels;
  if (config.depth) *extra++ = depth;
  if (config.inverse_depth) *extra = S(1) / depth;
  // Finite coefficients can add up to an infinite colour. Infinity times a weight of 0 is NaN, and would reach pixels
  // next to the Gaussian.
  return all_finite(features, config.num_features());
}

// The features of a Gaussian as the forward pass wrote them, and the gradients by them.
template <class S> struct BlendedFeatures {
  const S* values;      // [F]
  const S* dL_dvalues;  // [F]
};

// Writes the gradients of a Gaussian's colours, of the active degree. Returns dL/dmean by way of the colours.
template <class S>
DSMOE_HD Vec3<S> write_color_gradients(const ColorSource<S>& source, const BlendedFeatures<S>& features,
                                       const ColorGradients<S>& out) {
  const Colors<S>& colors = source.colors;
  if (colors.given != nullptr) {
    if (out.given != nullptr) {
      for (int c = 0; c < source.config.num_channels; ++c) out.given[c] = features.dL_dvalues[c];
    }
    return {S(0), S(0), S(0)};
  }
  ShWriter<S> write = {out.dc, out.shs};
  if (colors.dc == nullptr && out.shs != nullptr) write = {out.shs, out.shs + 3};
  return sh_color_backward(source.sh_rules(), source.mean, colors.sh(), load3(features.values),
                           load3(features.dL_dvalues), write);
}

// Puts together what a Gaussian's pixels hand back. dL_dfeatures: [F]. color: what write_color_gradients returned.
template <class S>
DSMOE_HD ProjectedGradient<S> projected_gradient(const GateGradient<S>& gate, const S* dL_dfeatures, Vec3<S> color,
                                                 const RasterConfig<S>& config) {
  ProjectedGradient<S> out = {gate, S(0), S(0), color};
  const S* extra = dL_dfeatures + config.num_channels;
  if (config.depth) out.depth = *extra++;
  if (config.inverse_depth) out.inverse_depth = *extra;
  return out;
}

// Writes the gradients of Gaussian i, except by its colours.
template <class S>
DSMOE_HD void store_gradient(const GaussianGradient<S>& g, const GaussianGradients<S>& out, int64_t i) {
  if (out.means3D != nullptr) store3(out.means3D + 3 * i, g.mean);
  if (out.means2D != nullptr) store3<S>(out.means2D + 3 * i, {g.mean2D.x, g.mean2D.y, S(0)});
  if (out.opacities != nullptr) out.opacities[i] = g.opacity;
  if (out.scales != nullptr) store3(out.scales + 3 * i, g.scale);
  if (out.rotations != nullptr) {
    S* q = out.rotations + 4 * i;
    q[0] = g.rotation.x, q[1] = g.rotation.y, q[2] = g.rotation.z, q[3] = g.rotation.w;
  }
  if (out.cov3D_precomp != nullptr) {
    S* c = out.cov3D_precomp + 6 * i;
    c[0] = g.covariance.xx, c[1] = g.covariance.xy, c[2] = g.covariance.xz;
    c[3] = g.covariance.yy, c[4] = g.covariance.yz, c[5] = g.covariance.zz;
  }
}

// Writes what Gaussian i gets of its sums over pixels of |dL/dmean|. They have the factors of means2D.
template <class S, class AnyCamera>
DSMOE_HD void store_absolute(const S* sums, const AnyCamera& camera, S* means2D_abs, int64_t i) {
  means2D_abs[2 * i] = sums[0] * S(0.5) * S(camera.width);
  means2D_abs[2 * i + 1] = sums[1] * S(0.5) * S(camera.height);
}

template <class S> DSMOE_HD void store_zeros(const ColorGradients<S>& out, int num_channels, int num_sh) {
  const auto clear = [](S* values, int size) {
    for (int k = 0; values != nullptr && k < size; ++k) values[k] = S(0);
  };
  clear(out.given, num_channels), clear(out.dc, 3), clear(out.shs, 3 * num_sh);
}

// Writes zeros to every gradient of Gaussian i.
template <class S> DSMOE_HD void store_zeros(const GaussianGradients<S>& out, int num_channels, int num_sh, int64_t i) {
  store_gradient(GaussianGradient<S>{}, out, i);
  if (out.means2D_abs != nullptr) out.means2D_abs[2 * i] = out.means2D_abs[2 * i + 1] = S(0);
  store_zeros(color_gradients_of(out, num_channels, num_sh, i), num_channels, num_sh);
}

// One Gaussian of a rendering. Without a lens, AnyCamera is PinholeCamera<S> where code for lenses would cost time.
template <class S, class AnyCamera = Camera<S>> struct RenderedGaussian {
  const GaussianInputs<S>& inputs;
  const AnyCamera& camera;
  const RasterConfig<S>& config;
  int64_t index;  // of the Gaussian

  DSMOE_HD ColorSource<S> color_source(Vec3<S> mean) const {
    return {colors_of(inputs, config.num_channels, index), mean, camera, config};
  }
};

// Projects a Gaussian, and writes its features, [F]. The radius is 0 if the Gaussian is culled. Then the rest means
// nothing.
template <class S, class AnyCamera = Camera<S>>
DSMOE_HD Projection<S> project_gaussian(const RenderedGaussian<S, AnyCamera>& of, S* features) {
  const Gaussian<S> gaussian = load_gaussian(of.inputs, of.index);
  Projection<S> out = project(gaussian, of.camera, of.config.projection_rules());
  if (out.radius > 0 && !write_features(of.color_source(gaussian.mean), out.gaussian.depth, features)) out.radius = 0;
  return out;
}

// What the pixels of a Gaussian hand back to it.
template <class S> struct PixelSums {
  GateGradient<S> gate;         // by its shape and opacity on the image
  BlendedFeatures<S> features;  // and the gradients by them
  S depth = 0;                  // by its view depth, if others than the pixels read that
};

// What a record of FootprintGradients says. features: what the forward pass wrote of the Gaussian.
template <class S> DSMOE_HD PixelSums<S> pixel_sums(const S* record, const S* features) {
  return {{{record[0], record[1]}, {record[2], record[3], record[4]}, record[5]},
          {features, record + kNumGateGradients}};
}

// Writes the gate's part of such a record.
template <class S> DSMOE_HD void store_gate_gradient(const GateGradient<S>& gate, S* record) {
  record[0] = gate.mean.x, record[1] = gate.mean.y;
  record[2] = gate.conic.xx, record[3] = gate.conic.xy, record[4] = gate.conic.yy;
  record[5] = gate.opacity;
}

// The gradients of a Gaussian over views. kShs: numbers that there is room for.
template <int kShs> struct ViewSum {
  GaussianGradient<float> gaussian = {};
  float dc[3] = {}, shs[kShs] = {};

  // Adds those that a view gives. features: of the Gaussian's row; record: as FootprintGradients has them. Returns the
  // view's own gradient, mean2D among them.
  template <class AnyCamera>
  DSMOE_HD GaussianGradient<float> add(const Gaussian<float>& from, const ColorSource<float>& source,
                                       const AnyCamera& camera, const float* features, const float* record) {
    float by_dc[3] = {}, by_shs[kShs] = {};
    const PixelSums<float> sums = pixel_sums(record, features);
    const Vec3<float> color = write_color_gradients(source, sums.features, {nullptr, by_dc, by_shs});
    const GaussianGradient<float> view =
        project_backward(from, camera, source.config.projection_rules(),
                         projected_gradient(sums.gate, sums.features.dL_dvalues, color, source.config));
    gaussian.mean = gaussian.mean + view.mean;
    gaussian.opacity += view.opacity;
    gaussian.scale = gaussian.scale + view.scale;
    gaussian.rotation.x += view.rotation.x, gaussian.rotation.y += view.rotation.y;
    gaussian.rotation.z += view.rotation.z, gaussian.rotation.w += view.rotation.w;
    DSMOE_UNROLL
    for (int k = 0; k < 3; ++k) dc[k] += by_dc[k];
    DSMOE_UNROLL
    for (int k = 0; k < kShs; ++k) shs[k] += by_shs[k];
    return view;
  }
};

// Writes the gradients of a Gaussian, but for coefficients above the active degree. Returns the Gaussian's share of the
// camera's gradient.
template <class S, class AnyCamera = Camera<S>>
DSMOE_HD CameraShare<S> project_gaussian_backward(const RenderedGaussian<S, AnyCamera>& of, const PixelSums<S>& sums,
                                                  const GaussianGradients<S>& out) {
  const RasterConfig<S>& config = of.config;
  const Gaussian<S> gaussian = load_gaussian(of.inputs, of.index);
  const Vec3<S> color = write_color_gradients(of.color_source(gaussian.mean), sums.features,
                                              color_gradients_of(out, config.num_channels, of.inputs.num_sh, of.index));
  auto by_image = projected_gradient(sums.gate, sums.features.dL_dvalues, color, config);
  by_image.depth += sums.depth;
  const auto gradient = project_backward(gaussian, of.camera, config.projection_rules(), by_image);
  store_gradient(gradient, out, of.index);
  return gradient.camera;
}

}  // namespace dsmoe
