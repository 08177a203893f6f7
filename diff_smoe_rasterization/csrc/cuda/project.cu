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
__device__ bool write_features(const GaussianInputs<S>& in, const Camera<S>& camera, const RasterConfig<S>& config,
                               S depth, S* out) {
  if constexpr (kFeatures == 3) {
    RasterConfig<S> known = config;
    known.num_channels = 3, known.depth = false, known.inverse_depth = false;
    S features[3];
    if (!project_features(in, camera, known, 0, depth, features)) return false;
    *reinterpret_cast<float4*>(out) = make_float4(features[0], features[1], features[2], 0);
    return true;
  } else {
    for (int f = config.num_features(); f < feature_stride(config.num_features()); ++f) out[f] = S(0);
    return project_features(in, camera, config, 0, depth, out);
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
  auto own = inputs_of(inputs, config.num_channels, exists ? i : 0);
  Rows::specialise(own);
  InputRegisters<S, Rows> registers;
  registers.take(own, true);
  load_camera(device_camera, camera);
  __syncthreads();
  ProjectedGaussian<S> gaussian;
  int32_t radius = exists ? project_shape(own, camera, config, 0, gaussian) : 0;
  S sh[Rows::kKnown ? Rows::kLength : 1];
  if constexpr (Rows::kStaged) {
    const int length = 3 * own.num_sh;
    const int64_t first = i - lane;
    const Rows rows(reinterpret_cast<float*>(shared_rows) + warp * kWarp * Rows::stride(length), length,
                    static_cast<int>(min<int64_t>(kWarp, inputs.num_gaussians - first)), lane);
    rows.load(inputs.shs + first * length, __ballot_sync(kAllLanes, radius > 0));
    wait_for_copies();
    own.shs = rows.own();
    if constexpr (Rows::kKnown) {
      rows.read(sh);
      own.shs = sh;
    }
  }
  if (!exists) return;
  if (radius > 0) {
    S* features = saved.features + i * feature_stride(config.num_features());
    if (!write_features<kFeatures>(own, camera, config, gaussian.depth, features)) radius = 0;
    saved.projected[i] = gaussian;
  }
  radii[i] = radius;
  keys.gaussians[i] = static_cast<int32_t>(radius > 0 ? i : ~i);
  if (keys.depths != nullptr) keys.depths[i] = radius > 0 ? depth_bits(gaussian.depth) : ~DepthBits<S>(0);
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
