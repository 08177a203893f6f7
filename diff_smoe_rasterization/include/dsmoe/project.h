// One Gaussian from world to image plane, and its gradient back: composes camera, covariance, gate and colour.
#pragma once

#include "dsmoe/covariance.h"
#include "dsmoe/params.h"
#include "dsmoe/sh.h"
#include "dsmoe/tiles.h"

namespace dsmoe {

template <class S> DSMOE_HD Vec3<S> load3(const S* p) { return {p[0], p[1], p[2]}; }
template <class S> DSMOE_HD void store3(S* p, Vec3<S> v) { p[0] = v.x, p[1] = v.y, p[2] = v.z; }

// The covariance of Gaussian i, and what its backward needs again.
template <class S> struct WorldCovariance {
  Vec3<S> scale;
  Vec4<S> quaternion;
  Mat3<S> rotation;
  Sym3<S> cov;
};

template <class S>
DSMOE_HD WorldCovariance<S> world_covariance(const GaussianInputs<S>& in, S scale_modifier, int64_t i) {
  WorldCovariance<S> out = {};
  if (in.cov3D_precomp != nullptr) {
    const S* c = in.cov3D_precomp + 6 * i;
    out.cov = {c[0], c[1], c[2], c[3], c[4], c[5]};
    return out;
  }
  const S* q = in.rotations + 4 * i;
  out.scale = scale_modifier * load3(in.scales + 3 * i);
  out.quaternion = {q[0], q[1], q[2], q[3]};
  out.rotation = quaternion_to_rotation(out.quaternion);
  out.cov = covariance_3d(out.scale, out.rotation);
  return out;
}

template <class S> DSMOE_HD ShCoefficients<const S> sh_of(const GaussianInputs<S>& in, int64_t i) {
  const S* shs = in.shs + i * 3 * in.num_sh;
  if (in.dc != nullptr) return {in.dc + 3 * i, shs};
  return {shs, shs + 3};
}

// Whether every attribute that shapes Gaussian i is a finite number, and every one that colours it; a Gaussian with one
// that is not is culled.
template <class S> DSMOE_HD bool shape_finite(const GaussianInputs<S>& in, int64_t i) {
  bool finite = all_finite(in.means3D + 3 * i, 3) && is_finite(in.opacities[i]);
  if (in.cov3D_precomp != nullptr) finite = finite && all_finite(in.cov3D_precomp + 6 * i, 6);
  if (in.scales != nullptr) finite = finite && all_finite(in.scales + 3 * i, 3) && all_finite(in.rotations + 4 * i, 4);
  return finite;
}

template <class S> DSMOE_HD bool color_finite(const GaussianInputs<S>& in, int num_channels, int64_t i) {
  bool finite = true;
  if (in.colors_precomp != nullptr) finite = finite && all_finite(in.colors_precomp + i * num_channels, num_channels);
  if (in.shs != nullptr) finite = finite && all_finite(in.shs + i * 3 * in.num_sh, 3 * in.num_sh);
  if (in.dc != nullptr) finite = finite && all_finite(in.dc + 3 * i, 3);
  return finite;
}

template <class S> DSMOE_HD bool attributes_finite(const GaussianInputs<S>& in, int num_channels, int64_t i) {
  return shape_finite(in, i) && color_finite(in, num_channels, i);
}

// The tiles that may hold pairs of a Gaussian; the radius counts where the mode is within_radius().
template <class S> DSMOE_HD TileRect tile_bounds(BlendMode mode, const Camera<S>& camera, Vec2<S> mean, S radius) {
  const TileGrid grid(camera.width, camera.height);
  if (within_radius(mode)) return radius_rect(mean, radius, grid);
  return {0, 0, grid.columns, grid.rows};
}

// The footprint of Gaussian i. Returns its radius in pixels, 0 where it is culled (then out means nothing).
template <class S>
DSMOE_HD int32_t project_shape(const GaussianInputs<S>& in, const Camera<S>& camera, const RasterConfig<S>& config,
                               int64_t i, ProjectedGaussian<S>& out) {
  const Vec3<S> mean = load3(in.means3D + 3 * i);
  const Vec3<S> view = transform_point(camera.view, mean);
  if (!(view.z > camera.near) || !shape_finite(in, i)) return 0;
  const auto jacobian = projection_jacobian(camera, view);
  const auto axes = image_axes(jacobian.jacobian, view_rotation(camera.view));
  const Sym2<S> cov2d = covariance_2d(axes, world_covariance(in, config.scale_modifier, i).cov);
  const Conic<S> conic = make_conic(cov2d);
  const Vec2<S> pixel = project_to_pixel(camera, mean);
  const S radius = screen_radius(conic);
  if (!is_ellipse(conic) || !is_finite(radius)) return 0;
  if (!is_finite(pixel.x) || !is_finite(pixel.y)) return 0;
  const Cut cut = cut_of(config.mode);
  const S widest_reach = squared_reach(cut, S(1), S(0));
  const bool seen = within_radius(config.mode)
                        ? !tile_bounds(config.mode, camera, pixel, radius).empty()
                        : meets_image(conic.inverse, pixel, widest_reach, camera.width, camera.height);
  if (!seen) return 0;
  S opacity = in.opacities[i];
  if (config.antialiasing) opacity *= opacity_compensation(cov2d, conic);
  const S reach = squared_reach(cut, opacity, config.alpha_cut().of(opacity));
  out = {pixel, conic.inverse, opacity, reach, view.z};
  return static_cast<int32_t>(min(radius, S(1 << 30)));
}

// What the pixels blend of Gaussian i; depth is its view z. False where it is culled.
template <class S>
DSMOE_HD bool project_features(const GaussianInputs<S>& in, const Camera<S>& camera, const RasterConfig<S>& config,
                               int64_t i, S depth, S* features) {
  if (!color_finite(in, config.num_channels, i)) return false;
  if (in.colors_precomp != nullptr) {
    for (int c = 0; c < config.num_channels; ++c) features[c] = in.colors_precomp[i * config.num_channels + c];
  } else {
    sh_color(in.sh_degree, load3(in.means3D + 3 * i), camera.position, sh_of(in, i), config.clamp_color, features);
  }
  S* extra = features + config.num_channels;
  if (config.depth) *extra++ = depth;
  if (config.inverse_depth) *extra = S(1) / depth;
  // Finite coefficients can add up to an infinite colour; times a weight of 0 it would reach pixels next to the
  // Gaussian.
  return all_finite(features, config.num_features());
}

// Both. Returns the radius, 0 where the Gaussian is culled (then out and features mean nothing).
template <class S>
DSMOE_HD int32_t project_gaussian(const GaussianInputs<S>& in, const Camera<S>& camera, const RasterConfig<S>& config,
                                  int64_t i, ProjectedGaussian<S>& out, S* features) {
  const int32_t radius = project_shape(in, camera, config, i, out);
  return radius > 0 && project_features(in, camera, config, i, out.depth, features) ? radius : 0;
}

// The gradient that a Gaussian's pixels hand back.
template <class S> struct ProjectedGradient {
  GateGradient<S> gate;
  const S* features;  // [F]
};

// Writes the gradients of Gaussian i's colours; returns dL/dmean by way of them.
template <class S>
DSMOE_HD Vec3<S> project_color_backward(const GaussianInputs<S>& in, const Camera<S>& camera,
                                        const RasterConfig<S>& config, int64_t i, const S* features,
                                        const S* dL_dfeatures, const GaussianGradients<S>& out,
                                        CameraGradient<S>* dL_dcamera) {
  if (in.colors_precomp != nullptr) {
    if (out.colors_precomp != nullptr) {
      for (int c = 0; c < config.num_channels; ++c) out.colors_precomp[i * config.num_channels + c] = dL_dfeatures[c];
    }
    return {S(0), S(0), S(0)};
  }
  ShCoefficients<S> dL_dsh = {out.dc != nullptr ? out.dc + 3 * i : nullptr, nullptr};
  if (out.shs != nullptr) {
    S* shs = out.shs + i * 3 * in.num_sh;
    if (in.dc == nullptr) dL_dsh.dc = shs, shs += 3;
    dL_dsh.rest = shs;
  }
  const Vec3<S> dL_dmean = sh_color_backward(in.sh_degree, load3(in.means3D + 3 * i), camera.position, sh_of(in, i),
                                             config.clamp_color, features, dL_dfeatures, dL_dsh);
  if (dL_dcamera != nullptr) {
    S* position = dL_dcamera->position;
    position[0] -= dL_dmean.x, position[1] -= dL_dmean.y, position[2] -= dL_dmean.z;
  }
  return dL_dmean;
}

// Writes all its other gradients; from_color is what the function above returns.
template <class S>
DSMOE_HD void project_shape_backward(const GaussianInputs<S>& in, const Camera<S>& camera,
                                     const RasterConfig<S>& config, int64_t i, const ProjectedGradient<S>& g,
                                     Vec3<S> from_color, const GaussianGradients<S>& out,
                                     CameraGradient<S>* dL_dcamera) {
  const Vec3<S> mean = load3(in.means3D + 3 * i);
  const Vec3<S> view = transform_point(camera.view, mean);
  const auto jacobian = projection_jacobian(camera, view);
  const auto rotation = view_rotation(camera.view);
  const auto axes = image_axes(jacobian.jacobian, rotation);
  const auto world = world_covariance(in, config.scale_modifier, i);
  const Sym2<S> cov2d = covariance_2d(axes, world.cov);
  const Conic<S> conic = make_conic(cov2d);

  Sym2<S> dL_dcov2d = make_conic_backward(conic, g.gate.conic);
  S dL_dopacity = g.gate.opacity;
  if (config.antialiasing) {
    const Sym2<S> extra = opacity_compensation_backward(cov2d, conic, g.gate.opacity * in.opacities[i]);
    dL_dcov2d = {dL_dcov2d.xx + extra.xx, dL_dcov2d.xy + extra.xy, dL_dcov2d.yy + extra.yy};
    dL_dopacity *= opacity_compensation(cov2d, conic);
  }
  if (out.opacities != nullptr) out.opacities[i] = dL_dopacity;

  Sym3<S> dL_dcov;
  Mat23<S> dL_daxes;
  covariance_2d_backward(axes, world.cov, dL_dcov2d, dL_dcov, dL_daxes);
  if (out.cov3D_precomp != nullptr) {
    S* c = out.cov3D_precomp + 6 * i;
    c[0] = dL_dcov.xx, c[1] = dL_dcov.xy, c[2] = dL_dcov.xz, c[3] = dL_dcov.yy, c[4] = dL_dcov.yz, c[5] = dL_dcov.zz;
  }
  if (out.scales != nullptr || out.rotations != nullptr) {
    Vec3<S> dL_dscale;
    Mat3<S> dL_drotation;
    covariance_3d_backward(world.scale, world.rotation, dL_dcov, dL_dscale, dL_drotation);
    if (out.scales != nullptr) store3(out.scales + 3 * i, config.scale_modifier * dL_dscale);
    if (out.rotations != nullptr) {
      const Vec4<S> q = quaternion_to_rotation_backward(world.quaternion, dL_drotation);
      S* r = out.rotations + 4 * i;
      r[0] = q.x, r[1] = q.y, r[2] = q.z, r[3] = q.w;
    }
  }

  const Mat23<S> dL_dJ = {rotation * dL_daxes.r0, rotation * dL_daxes.r1};
  Vec3<S> dL_dview = projection_jacobian_backward(jacobian, dL_dJ);
  const S* extra = g.features + config.num_channels;
  if (config.depth) dL_dview.z += *extra++;
  if (config.inverse_depth) dL_dview.z -= *extra / (view.z * view.z);
  S* dL_dviewmatrix = dL_dcamera != nullptr ? dL_dcamera->view : nullptr;
  S* dL_dprojection = dL_dcamera != nullptr ? dL_dcamera->projection : nullptr;
  Vec3<S> dL_dmean = transform_point_backward(camera.view, mean, dL_dview, dL_dviewmatrix);
  dL_dmean = dL_dmean + project_to_pixel_backward(camera, mean, g.gate.mean, dL_dprojection);
  if (dL_dcamera != nullptr) {
    const auto& j = jacobian.jacobian;
    view_rotation_backward<S>({j.r0.x * dL_daxes.r0, j.r1.y * dL_daxes.r1, j.r0.z * dL_daxes.r0 + j.r1.z * dL_daxes.r1},
                              dL_dviewmatrix);
  }

  dL_dmean = dL_dmean + from_color;
  if (out.means3D != nullptr) store3(out.means3D + 3 * i, dL_dmean);
  if (out.means2D != nullptr) {
    store3<S>(out.means2D + 3 * i,
              {g.gate.mean.x * S(0.5) * S(camera.width), g.gate.mean.y * S(0.5) * S(camera.height), S(0)});
  }
}

// Writes the gradients of Gaussian i, and adds its share of the camera's where that is wanted.
template <class S>
DSMOE_HD void project_gaussian_backward(const GaussianInputs<S>& in, const Camera<S>& camera,
                                        const RasterConfig<S>& config, int64_t i, const S* features,
                                        const ProjectedGradient<S>& g, const GaussianGradients<S>& out,
                                        CameraGradient<S>* dL_dcamera) {
  const Vec3<S> from_color = project_color_backward(in, camera, config, i, features, g.features, out, dL_dcamera);
  project_shape_backward(in, camera, config, i, g, from_color, out, dL_dcamera);
}

}  // namespace dsmoe
