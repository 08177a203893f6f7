// Stage 1: every Gaussian to the image plane.
#include "dsmoe/project.h"
#include "sh_rows.cuh"

namespace dsmoe {
namespace cuda {
namespace {

__device__ uint32_t depth_bits(float depth) { return __float_as_uint(depth); }
__device__ uint64_t depth_bits(double depth) { return __double_as_longlong(depth); }

// The features of a Gaussian, as one row of saved.features; where their number is known they stay in registers until
// they are written.
template <int kFeatures, class S>
__device__ bool store_features(const Colors<S>& colors, Vec3<S> mean, const Camera<S>& camera,
                               const RasterConfig<S>& config, S depth, S* out) {
  if constexpr (kFeatures == 3) {
    RasterConfig<S> known = config;
    known.num_channels = 3, known.depth = false, known.inverse_depth = false;
    S features[3];
    if (!write_features(colors, mean, camera, known, depth, features)) return false;
    *reinterpret_cast<float4*>(out) = make_float4(features[0], features[1], features[2], 0);
    return true;
  } else {
    for (int f = config.num_features(); f < feature_stride(config.num_features()); ++f) out[f] = S(0);
    return write_features(colors, mean, camera, config, depth, out);
  }
}

template <class S, int kFeatures, class Rows>
__global__ void __launch_bounds__(kRowsBlock)
    project_kernel(const __grid_constant__ GaussianInputs<S> inputs, const DeviceCamera<S> device_camera,
                   const RasterConfig<S> config, const SavedForward<S> saved, int32_t* radii, const DepthKeys<S> keys) {
  __shared__ Camera<S> camera;
  extern __shared__ float4 shared_rows[];
  const int64_t i = int64_t(blockIdx.x) * kRowsBlock + threadIdx.x;
  const int warp = threadIdx.x / kWarp, lane = threadIdx.x % kWarp;
  const bool exists = i < inputs.num_gaussians;
  const int64_t own = exists ? i : 0;
  const Gaussian<S> gaussian = Rows::gaussian(inputs, own);
  S dc[3];
  if constexpr (Rows::kDcApart) store3(dc, load3(inputs.dc + 3 * own));
  load_camera(device_camera, camera);
  __syncthreads();
  Projection<S> projection;
  projection.radius = 0;
  if (exists) projection = project(gaussian, camera, config.projection_rules());
  int32_t radius = projection.radius;
  auto colors = colors_of(inputs, config.num_channels, own);
  S sh[Rows::kKnown ? Rows::kLength : 1];
  if constexpr (Rows::kStaged) {
    const int length = 3 * inputs.num_sh;
    const int64_t first = i - lane;
    const Rows rows(reinterpret_cast<float*>(shared_rows) + warp * kWarp * Rows::stride(length), length,
                    static_cast<int>(min<int64_t>(kWarp, inputs.num_gaussians - first)), lane);
    rows.load(inputs.shs + first * length, __ballot_sync(kAllLanes, radius > 0));
    wait_for_copies();
    colors.shs = rows.own();
    if constexpr (Rows::kKnown) {
      rows.read(sh);
      colors = Rows::known_colors(dc, sh);
    }
  }
  if (!exists) return;
  const S depth = projection.gaussian.depth;
  if (radius > 0) {
    S* features = saved.features + i * feature_stride(config.num_features());
    if (!store_features<kFeatures>(colors, gaussian.mean, camera, config, depth, features)) radius = 0;
    saved.projected[i] = projection.gaussian;
  }
  radii[i] = radius;
  keys.gaussians[i] = static_cast<int32_t>(radius > 0 ? i : ~i);
  if (keys.depths != nullptr) keys.depths[i] = radius > 0 ? depth_bits(depth) : ~DepthBits<S>(0);
}

template <class S>
__global__ void mark_visible_kernel(int64_t num_gaussians, const S* means3D, const S* view, S near, bool* visible) {
  const int64_t i = int64_t(blockIdx.x) * blockDim.x + threadIdx.x;
  if (i < num_gaussians) visible[i] = transform_point(view, load3(means3D + 3 * i)).z > near;
}

}  // namespace

template <class S> void project(const Frame<S>& frame, const DepthKeys<S>& keys, const Work& work) {
  const GaussianInputs<S>& inputs = frame.inputs;
  const RasterConfig<S>& config = frame.config;
  if (inputs.num_gaussians == 0) return;
  dispatch_sh_rows(inputs, true, [&](auto type, size_t shared) {
    using Rows = typename decltype(type)::type;
    const auto launch = [&](auto kernel) {
      kernel<<<blocks_for(inputs.num_gaussians, kRowsBlock), kRowsBlock, shared, work.stream>>>(
          inputs, frame.camera, config, frame.saved, frame.images.radii, keys);
      DSMOE_CHECK_LAUNCH("project");
    };
    if constexpr (Rows::kStaged) {
      if (config.num_features() == 3) return launch(project_kernel<S, 3, Rows>);
    }
    launch(project_kernel<S, 0, Rows>);
  });
}

template <class S> void mark_visible(const Frame<S>& frame, bool* visible, const Work& work) {
  const int64_t count = frame.inputs.num_gaussians;
  if (count == 0) return;
  mark_visible_kernel<<<blocks_for(count, 256), 256, 0, work.stream>>>(count, frame.inputs.means3D, frame.camera.view,
                                                                       frame.camera.near, visible);
  DSMOE_CHECK_LAUNCH("mark_visible");
}

#define DSMOE_INSTANTIATE(S)                                                \
  template void project(const Frame<S>&, const DepthKeys<S>&, const Work&); \
  template void mark_visible(const Frame<S>&, bool*, const Work&);
DSMOE_INSTANTIATE(float)
DSMOE_INSTANTIATE(double)
#undef DSMOE_INSTANTIATE

}  // namespace cuda
}  // namespace dsmoe
