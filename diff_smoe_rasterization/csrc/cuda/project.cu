// Stage 1: every Gaussian to the image plane, how many tiles each meets, and its place in the depth order.
#include "device.cuh"
#include "dsmoe/project.h"
#include "tile_rows.cuh"

namespace dsmoe {
namespace cuda {
namespace {

constexpr int kBlock = 128;

// The features of a Gaussian; where their number is known they stay in registers on their way to memory.
template <int kFeatures, class S>
__device__ bool write_features(const GaussianInputs<S>& in, const Camera<S>& camera, const RasterConfig<S>& config,
                               S depth, S* out) {
  if constexpr (kFeatures == 3) {
    RasterConfig<S> known = config;
    known.num_channels = 3, known.depth = false, known.inverse_depth = false;
    S features[3];
    if (!project_features(in, camera, known, 0, depth, features)) return false;
    for (int c = 0; c < 3; ++c) out[c] = features[c];
    return true;
  } else {
    return project_features(in, camera, config, 0, depth, out);
  }
}

// kStaged: the SH rows pass through shared memory.
template <class S, int kFeatures, bool kStaged>
__global__ void __launch_bounds__(kBlock)
    project_kernel(GaussianInputs<S> inputs, DeviceCamera<S> device_camera, RasterConfig<S> config,
                   SavedForward<S> saved, int32_t* radii, int32_t* tile_counts) {
  __shared__ Camera<S> camera;
  extern __shared__ float sh_rows[];
  load_camera(device_camera, camera);
  __syncthreads();

  const int64_t i = int64_t(blockIdx.x) * kBlock + threadIdx.x;
  const int lane = threadIdx.x % kWarp;
  const bool exists = i < inputs.num_gaussians;
  auto gaussian_inputs = inputs_of(inputs, config.num_channels, exists ? i : 0);
  ProjectedGaussian<S> gaussian;
  int32_t radius = exists ? project_shape(gaussian_inputs, camera, config, 0, gaussian) : 0;
  if constexpr (kStaged) {
    const int length = 3 * inputs.num_sh;
    float* rows = sh_rows + threadIdx.x / kWarp * (kWarp * row_stride(length));
    load_rows(inputs.shs + (i - lane) * length, rows, length, __ballot_sync(kAllLanes, radius > 0), lane);
    gaussian_inputs.shs = rows + lane * row_stride(length);
  }
  if (!exists) return;
  if (radius > 0) {
    S* features = saved.features + i * feature_stride(config.num_features());
    if (!write_features<kFeatures>(gaussian_inputs, camera, config, gaussian.depth, features)) radius = 0;
  }
  radii[i] = radius;
  int32_t count = 0;
  if (radius > 0) {
    saved.projected[i] = gaussian;
    count = count_tiles(gaussian, tile_bounds(config.mode, camera, gaussian.mean, S(radius)));
  }
  tile_counts[i] = count;
}

template <class S>
__global__ void mark_visible_kernel(int64_t num_gaussians, const S* means3D, const S* view, S near, bool* visible) {
  const int64_t i = int64_t(blockIdx.x) * blockDim.x + threadIdx.x;
  if (i < num_gaussians) visible[i] = transform_point(view, load3(means3D + 3 * i)).z > near;
}

}  // namespace

template <class S>
void project(const GaussianInputs<S>& inputs, const DeviceCamera<S>& camera, const RasterConfig<S>& config,
             const SavedForward<S>& saved, const ImageOutputs<S>& images, const Binning& binning, cudaStream_t stream) {
  if (inputs.num_gaussians == 0) return;
  const auto launch = [&](auto kernel, size_t shared) {
    kernel<<<blocks_for(inputs.num_gaussians, kBlock), kBlock, shared, stream>>>(inputs, camera, config, saved,
                                                                                 images.radii, binning.tile_counts);
    DSMOE_CHECK_LAUNCH("project");
  };
  if constexpr (sizeof(S) == sizeof(float)) {
    if (inputs.shs != nullptr && inputs.num_sh > 0 && inputs.num_sh <= kMaxShCoefficients) {
      const size_t shared = sizeof(float) * kBlock * row_stride(3 * inputs.num_sh);
      if (config.num_features() == 3) return launch(project_kernel<S, 3, true>, shared);
      return launch(project_kernel<S, 0, true>, shared);
    }
  }
  launch(project_kernel<S, 0, false>, 0);
}

template <class S>
void mark_visible(int64_t num_gaussians, const S* means3D, const S* view, S near, bool* visible, cudaStream_t stream) {
  if (num_gaussians == 0) return;
  mark_visible_kernel<<<blocks_for(num_gaussians, 256), 256, 0, stream>>>(num_gaussians, means3D, view, near, visible);
  DSMOE_CHECK_LAUNCH("mark_visible");
}

#define DSMOE_INSTANTIATE(S)                                                                           \
  template void project(const GaussianInputs<S>&, const DeviceCamera<S>&, const RasterConfig<S>&,      \
                        const SavedForward<S>&, const ImageOutputs<S>&, const Binning&, cudaStream_t); \
  template void mark_visible(int64_t, const S*, const S*, S, bool*, cudaStream_t);
DSMOE_INSTANTIATE(float)
DSMOE_INSTANTIATE(double)
#undef DSMOE_INSTANTIATE

}  // namespace cuda
}  // namespace dsmoe
