// From one record per Gaussian to the gradients of every input. Also writes the zeros of Gaussians that no pixel saw.
#include "dsmoe/project.h"
#include "reduce.cuh"
#include "sh_rows.cuh"

namespace dsmoe {
namespace cuda {
namespace {

constexpr int kCameraGradientSize = sizeof(CameraGradient<float>) / sizeof(float);
static_assert(kCameraGradientSize == 35, "view, projection and position lie side by side");

template <class S> struct ProjectBackwardArguments {
  GaussianInputs<S> inputs;
  DeviceCamera<S> camera;
  RasterConfig<S> config;
  SavedForward<S> saved;
  const int32_t* radii;
  const S* dL_dgaussians;
  const S* slots;  // or null
  GaussianGradients<S> gradients;
  S* camera_rows;       // [blocks * warps, 35] of each warp, or null
  S* dL_dfeature_rows;  // [N, F] scratch, where slots are summed and the number of features is not known
};

template <class S> __device__ void set_zero(S* values, int size) {
  if (values == nullptr) return;
  for (int k = 0; k < size; ++k) values[k] = S(0);
}

template <class S> __device__ void set_zero(const GaussianGradients<S>& g, int num_channels, int num_sh) {
  set_zero(g.means3D, 3);
  set_zero(g.means2D, 3);
  set_zero(g.opacities, 1);
  set_zero(g.scales, 3);
  set_zero(g.rotations, 4);
  set_zero(g.cov3D_precomp, 6);
  set_zero(g.colors_precomp, num_channels);
  set_zero(g.dc, 3);
  set_zero(g.shs, 3 * num_sh);
}

// Number k of Gaussian i's record: what was added to it, or the sum over its slots.
template <class S>
__device__ S record_number(const ProjectBackwardArguments<S>& arguments, int64_t i, int size, int k) {
  const S direct = arguments.dL_dgaussians[i * size + k];
  if (arguments.slots == nullptr || overflows(arguments.saved)) return direct;
  double sum = direct;
  for (int64_t slot = arguments.saved.slot_ranges[2 * i] * kSlotsPerInstance;
       slot < arguments.saved.slot_ranges[2 * i + 1] * kSlotsPerInstance; ++slot) {
    sum += double(arguments.slots[slot * size + k]);
  }
  return static_cast<S>(sum);
}

// Staged SH rows leave their gradients in the same place.
template <class S, int kFeatures, bool kCamera, class Rows>
__global__ void __launch_bounds__(kRowsBlock, sizeof(S) == sizeof(float) && !kCamera ? 5 : 1)
    project_backward_kernel(const __grid_constant__ ProjectBackwardArguments<S> arguments) {
  __shared__ Camera<S> camera;
  extern __shared__ float sh_rows[];
  load_camera(arguments.camera, camera);
  __syncthreads();

  const int64_t count = arguments.inputs.num_gaussians, i = int64_t(blockIdx.x) * kRowsBlock + threadIdx.x;
  const int lane = threadIdx.x % kWarp;
  const bool exists = i < count;
  RasterConfig<S> config = arguments.config;
  if constexpr (kFeatures == 3) config.num_channels = 3, config.depth = false, config.inverse_depth = false;
  const int num_features = config.num_features();
  auto inputs = inputs_of(arguments.inputs, config.num_channels, exists ? i : 0);
  Rows::specialise(inputs);
  const int length = 3 * inputs.num_sh;
  auto gradients = gradients_of(arguments.gradients, config.num_channels, inputs.num_sh, exists ? i : 0);
  const bool seen = exists && arguments.radii[i] > 0;
  float* rows = sh_rows + threadIdx.x / kWarp * (kWarp * row_stride(length));
  float* row = rows + lane * row_stride(length);
  if constexpr (Rows::kStaged) {
    load_rows<Rows::kLength>(arguments.inputs.shs + (i - lane) * length, rows, length, __ballot_sync(kAllLanes, seen),
                             lane);
    inputs.shs = row;
    if (gradients.shs != nullptr) gradients.shs = row;
  }

  const ProjectedGaussian<S> gaussian = arguments.saved.projected[seen ? i : 0];
  const S* features = arguments.saved.features + i * feature_stride(num_features);
  GateMoments<S> moments;
  S known_features[kFeatures == 3 ? 3 : 1], known_gradients[kFeatures == 3 ? 3 : 1];
  const S* dL_dfeatures = known_gradients;
  if (seen) {
    const int size = kNumGateMoments + num_features;
    moments.one = record_number(arguments, i, size, 0), moments.x = record_number(arguments, i, size, 1);
    moments.y = record_number(arguments, i, size, 2), moments.xx = record_number(arguments, i, size, 3);
    moments.xy = record_number(arguments, i, size, 4), moments.yy = record_number(arguments, i, size, 5);
    if constexpr (kFeatures == 3) {
      for (int f = 0; f < 3; ++f) {
        known_features[f] = features[f];
        known_gradients[f] = record_number(arguments, i, size, kNumGateMoments + f);
      }
      features = known_features;
    } else {
      S* summed = arguments.dL_dfeature_rows + i * num_features;
      for (int f = 0; f < num_features; ++f) summed[f] = record_number(arguments, i, size, kNumGateMoments + f);
      dL_dfeatures = summed;
    }
  }
  if constexpr (Rows::kStaged) wait_for_rows();

  CameraGradient<S> dL_dcamera = {};
  if (seen) {
    if constexpr (Rows::kStaged) {
      // Coefficients above the active degree have no gradient.
      const int active = 3 * (sh_coefficients(inputs.sh_degree) - (inputs.dc != nullptr));
      for (int k = active; k < length; ++k) row[k] = 0.0f;
    } else if (gradients.shs != nullptr) {
      set_zero(gradients.shs, length);
    }
    project_gaussian_backward(inputs, camera, config, 0, features,
                              {moments_backward(gaussian.conic, gaussian.opacity, moments), dL_dfeatures}, gradients,
                              kCamera ? &dL_dcamera : nullptr);
  } else if (exists) {
    set_zero(gradients, config.num_channels, inputs.num_sh);
  }
  if constexpr (Rows::kStaged) {
    if (arguments.gradients.shs != nullptr) {
      const int64_t first = i - lane;
      const int here = static_cast<int>(count - first < kWarp ? count - first : kWarp);
      store_rows<Rows::kLength>(rows, arguments.gradients.shs + first * length, length, here, lane);
    }
  }
  if constexpr (kCamera) {
    const S* numbers = dL_dcamera.view;
    S* out = arguments.camera_rows + (i / kWarp) * kCameraGradientSize;
    for (int k = 0; k < kCameraGradientSize; ++k) {
      const S sum = sum_lanes(numbers[k]);
      if (lane == 0) out[k] = sum;
    }
  }
}

}  // namespace

template <class S>
void project_backward(const GaussianInputs<S>& inputs, const DeviceCamera<S>& camera, const RasterConfig<S>& config,
                      const SavedForward<S>& saved, const int32_t* radii, const S* dL_dgaussians, const S* slots,
                      const GaussianGradients<S>& gradients, Scratch& scratch, cudaStream_t stream) {
  ProjectBackwardArguments<S> arguments = {inputs,        camera, config,    saved,   radii,
                                           dL_dgaussians, slots,  gradients, nullptr, nullptr};
  const bool with_camera = gradients.camera != nullptr;
  const int64_t blocks = blocks_for(inputs.num_gaussians, kRowsBlock), warps = blocks * (kRowsBlock / kWarp);
  if (with_camera) arguments.camera_rows = allocate<S>(scratch, warps * kCameraGradientSize);
  if (inputs.num_gaussians > 0) {
    dispatch_sh_rows(inputs, [&](auto rows, size_t shared) {
      using Rows = decltype(rows);
      const auto launch = [&](auto kernel) {
        kernel<<<static_cast<unsigned>(blocks), kRowsBlock, shared, stream>>>(arguments);
        DSMOE_CHECK_LAUNCH("project_backward");
      };
      if constexpr (Rows::kStaged) {
        if (config.num_features() == 3) {
          with_camera ? launch(project_backward_kernel<S, 3, true, Rows>)
                      : launch(project_backward_kernel<S, 3, false, Rows>);
          return;
        }
      }
      arguments.dL_dfeature_rows = allocate<S>(scratch, inputs.num_gaussians * config.num_features());
      with_camera ? launch(project_backward_kernel<S, 0, true, Rows>)
                  : launch(project_backward_kernel<S, 0, false, Rows>);
    });
  }
  if (with_camera) {
    sum_columns(arguments.camera_rows, warps, kCameraGradientSize, gradients.camera->view, stream);
  }
}

#define DSMOE_INSTANTIATE(S)                                                                               \
  template void project_backward(const GaussianInputs<S>&, const DeviceCamera<S>&, const RasterConfig<S>&, \
                                 const SavedForward<S>&, const int32_t*, const S*, const S*,               \
                                 const GaussianGradients<S>&, Scratch&, cudaStream_t);
DSMOE_INSTANTIATE(float)
DSMOE_INSTANTIATE(double)
#undef DSMOE_INSTANTIATE

}  // namespace cuda
}  // namespace dsmoe
