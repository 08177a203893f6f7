// From one record per Gaussian to the gradients of every input. Also writes the zeros of Gaussians that no pixel saw.
#include "lane_gradient.cuh"
#include "reduce.cuh"
#include "sh_rows.cuh"

namespace dsmoe {
namespace cuda {
namespace {

// Whether a kernel for these cameras knows of rolling shutters.
template <class AnyCamera, class S> constexpr bool kMayRoll = std::is_same_v<AnyCamera, Camera<S>>;

// Numbers of the camera's gradient, of which the last 16 are those of a rolling shutter.
constexpr int kCameraGradientSize = sizeof(CameraGradient<float>) / sizeof(float);
static_assert(kCameraGradientSize == 51, "view, projection, position and view_end lie side by side");
DSMOE_HD constexpr int camera_columns(bool rolls) { return rolls ? kCameraGradientSize : kCameraGradientSize - 16; }

template <class S> struct ProjectBackwardArguments {
  GaussianInputs<S> inputs;        // of the forward pass
  DeviceCamera<S> camera;          // of the forward pass
  RasterConfig<S> config;          // of the forward pass
  SavedForward<S> saved;           // projected and features are read
  const int32_t* radii;            // [N] pixels; above 0 if a Gaussian was seen
  const S* dL_dgaussians;          // [N, kNumGateMoments + F] the records
  bool by_footprints;              // which are gradients by the footprints, not sums over pixels
  const S* dL_ddepths;             // [N] gradients by the view depths, added to those of the features; or null
  GaussianGradients<S> gradients;  // written
  S* camera_rows;                  // [warps, camera_columns()] each warp's sums, written; or null
};

// The sum over the warp of the camera's gradients.
template <bool kRolls, class S>
__device__ void store_camera_row(const ProjectBackwardArguments<S>& arguments, int64_t i,
                                 const CameraGradient<S>& dL_dcamera, int lane) {
  S* out = arguments.camera_rows + (i / kWarp) * camera_columns(kRolls);
  const auto store_sums = [&](const auto& numbers) {
    for (const S number : numbers) {
      const S sum = sum_lanes(number);
      if (lane == 0) *out = sum;
      ++out;
    }
  };
  store_sums(dL_dcamera.view), store_sums(dL_dcamera.projection), store_sums(dL_dcamera.position);
  if constexpr (kRolls) store_sums(dL_dcamera.view_end);
}

template <class S> __device__ GateGradient<S> gate_of_moments(const ProjectedGaussian<S>& projected, const S* record) {
  const GateMoments<S> moments = {record[0], record[1], record[2], record[3], record[4], record[5]};
  return moments_backward(projected.conic, projected.opacity, moments);
}

// All that comes back to Gaussian i from the image. projected: only read if the record is of sums over pixels.
template <class S>
__device__ ProjectedGradient<S> image_gradient(const ProjectBackwardArguments<S>& arguments, int64_t i,
                                               const ProjectedGaussian<S>& projected, const S* record,
                                               Vec3<S> from_color, const RasterConfig<S>& config) {
  GateGradient<S> gate = {{record[0], record[1]}, {record[2], record[3], record[4]}, record[5]};
  if (!arguments.by_footprints) gate = gate_of_moments(projected, record);
  auto out = projected_gradient(gate, record + kNumGateMoments, from_color, config);
  if (arguments.dL_ddepths != nullptr) out.depth += arguments.dL_ddepths[i];
  return out;
}

constexpr int kRecordLength = kNumGateMoments + kFastFeatures;  // of colours
constexpr int kMostRecordLength = kRecordLength + kMostFurtherFeatures;
using RecordRows = WarpRows<kRecordLength>;

// Blocks of the common case that one multiprocessor holds at once.
template <class AnyCamera, bool kCamera>
constexpr int kKnownBackwardBlocks = kCamera                      ? kCameraBackwardBlocks
                                     : kMayRoll<AnyCamera, float> ? kShutterBackwardBlocks
                                                                  : kRowsBackwardBlocks;

// The common case. The SH rows come through shared memory. So do the records if they are of colours only. All other
// numbers live in registers.
template <class AnyCamera, bool kCamera, bool kOnlyColors, class Rows>
__global__ void __launch_bounds__(kRowsBlock, kKnownBackwardBlocks<AnyCamera, kCamera>)
    known_backward_kernel(const __grid_constant__ ProjectBackwardArguments<float> arguments) {
  __shared__ AnyCamera camera;
  extern __shared__ float4 shared_rows[];
  const int64_t count = arguments.inputs.num_gaussians, i = int64_t(blockIdx.x) * kRowsBlock + threadIdx.x;
  const int warp = threadIdx.x / kWarp, lane = threadIdx.x % kWarp;
  const int64_t first = i - lane;
  const int exist = static_cast<int>(max<int64_t>(0, min<int64_t>(kWarp, count - first)));
  const bool seen = lane < exist && arguments.radii[i] > 0;
  load_camera(arguments.camera, camera);
  __syncthreads();

  RasterConfig<float> config = arguments.config;
  config.num_channels = kFastFeatures;
  if constexpr (kOnlyColors) config.leave_out_further_features();
  float* memory = reinterpret_cast<float*>(shared_rows) +
                  warp * kWarp * (Rows::stride(Rows::kLength) + RecordRows::stride(kRecordLength));
  const Rows rows(memory, Rows::kLength, exist, lane);
  const RecordRows records(memory + kWarp * Rows::stride(Rows::kLength), kRecordLength, exist, lane);
  const unsigned all_seen = __ballot_sync(kAllLanes, seen);
  if constexpr (kOnlyColors) records.load(arguments.dL_dgaussians + first * kRecordLength, all_seen);
  rows.load(arguments.inputs.shs + first * Rows::kLength, all_seen);
  Gaussian<float> own;
  float dc[3];
  ProjectedGaussian<float> projected;
  float4 features;
  if (seen) {
    own = Rows::gaussian(arguments.inputs, i);
    if constexpr (Rows::kDcApart) store3(dc, load3(arguments.inputs.dc + 3 * i));
    if (!arguments.by_footprints) projected = arguments.saved.projected[i];
    features = *reinterpret_cast<const float4*>(arguments.saved.features + i * feature_stride(config.num_features()));
  }
  wait_for_copies();

  LaneGradient gradient = {};
  CameraGradient<float> dL_dcamera = {};
  float sh[Rows::kLength], dL_dsh[Rows::kLength] = {};
  if (seen) {
    const int size = kNumGateMoments + config.num_features();
    float record[kOnlyColors ? kRecordLength : kMostRecordLength];
    if constexpr (kOnlyColors) {
      records.read(record);
    } else {
      for (int k = 0; k < kMostRecordLength; ++k) record[k] = k < size ? arguments.dL_dgaussians[i * size + k] : 0.0f;
    }
    const float color[3] = {features.x, features.y, features.z};
    rows.read(sh);
    const auto from_color = write_color_gradients<float>({Rows::known_colors(dc, sh), own.mean, camera, config},
                                                         {color, record + kNumGateMoments},
                                                         {nullptr, Rows::kDcApart ? gradient.dc : nullptr, dL_dsh});
    rows.write(dL_dsh);  // the row's registers are free from here on
    gradient.gaussian = project_backward(own, camera, config.projection_rules(),
                                         image_gradient(arguments, i, projected, record, from_color, config));
    if constexpr (kCamera) dL_dcamera.add(gradient.gaussian.camera);
  } else {
    rows.write(dL_dsh);
  }
  store_gradients(gradient, rows, arguments.gradients, arguments.gradients.seen_only ? all_seen : rows.all());
  if constexpr (kCamera) store_camera_row<kMayRoll<AnyCamera, float>>(arguments, i, dL_dcamera, lane);
}

// Every other case. Staged SH rows leave their gradients in the same place.
template <class AnyCamera, class S, bool kCamera, class Rows>
__global__ void __launch_bounds__(kRowsBlock)
    project_backward_kernel(const __grid_constant__ ProjectBackwardArguments<S> arguments) {
  __shared__ AnyCamera camera;
  extern __shared__ float4 shared_rows[];
  load_camera(arguments.camera, camera);
  __syncthreads();

  const int64_t count = arguments.inputs.num_gaussians, i = int64_t(blockIdx.x) * kRowsBlock + threadIdx.x;
  const int warp = threadIdx.x / kWarp, lane = threadIdx.x % kWarp;
  const bool exists = i < count;
  const RasterConfig<S>& config = arguments.config;
  const GaussianInputs<S>& inputs = arguments.inputs;
  const int num_features = config.num_features(), length = 3 * inputs.num_sh;
  auto colors = colors_of(inputs, config.num_channels, exists ? i : 0);
  auto to_colors = color_gradients_of(arguments.gradients, config.num_channels, inputs.num_sh, exists ? i : 0);
  const bool seen = exists && arguments.radii[i] > 0;
  const int64_t first = i - lane;
  const Rows rows(reinterpret_cast<float*>(shared_rows) + warp * kWarp * Rows::stride(length), length,
                  static_cast<int>(max<int64_t>(0, min<int64_t>(kWarp, count - first))), lane);
  if constexpr (Rows::kStaged) {
    rows.load(inputs.shs + first * length, __ballot_sync(kAllLanes, seen));
    colors.shs = rows.own();
    if (to_colors.shs != nullptr) to_colors.shs = rows.own();
  }

  Gaussian<S> own = {};
  ProjectedGaussian<S> projected = {};
  if (seen) own = load_gaussian(inputs, i);
  if (seen && !arguments.by_footprints) projected = arguments.saved.projected[i];
  const S* features = arguments.saved.features + i * feature_stride(num_features);
  const S* record = arguments.dL_dgaussians + i * (kNumGateMoments + num_features);
  const S* dL_dfeatures = record + kNumGateMoments;
  if constexpr (Rows::kStaged) wait_for_copies();

  CameraGradient<S> dL_dcamera = {};
  if (seen) {
    // Coefficients above the active degree have no gradient.
    if constexpr (Rows::kStaged) {
      const int active = 3 * (sh_coefficients(inputs.sh_degree) - (inputs.dc != nullptr));
      for (int k = active; k < length; ++k) rows.own()[k] = 0.0f;
    } else {
      store_zeros(ColorGradients<S>{nullptr, nullptr, to_colors.shs}, 0, inputs.num_sh);
    }
    const auto from_color =
        write_color_gradients<S>({colors, own.mean, camera, config}, {features, dL_dfeatures}, to_colors);
    const auto gradient = project_backward(own, camera, config.projection_rules(),
                                           image_gradient(arguments, i, projected, record, from_color, config));
    store_gradient(gradient, arguments.gradients, i);
    if constexpr (kCamera) dL_dcamera.add(gradient.camera);
  } else if (exists && !arguments.gradients.seen_only) {
    store_gradient(GaussianGradient<S>{}, arguments.gradients, i);
    store_zeros(to_colors, config.num_channels, inputs.num_sh);
  }
  if constexpr (Rows::kStaged) {
    const unsigned wanted = arguments.gradients.seen_only ? __ballot_sync(kAllLanes, seen) : rows.all();
    if (arguments.gradients.shs != nullptr) rows.store(arguments.gradients.shs + first * length, wanted);
  }
  if constexpr (kCamera) store_camera_row<kMayRoll<AnyCamera, S>>(arguments, i, dL_dcamera, lane);
}

template <class S> struct FinishArguments {
  int64_t num_gaussians;  // N
  int length;             // numbers a record
  SavedForward<S> saved;  // projected is read
  const int32_t* radii;   // [N] pixels; above 0 if a Gaussian was seen
  S* records;             // [N, length] read and written
};

template <class S>
__global__ void __launch_bounds__(kStoreBlock)
    finish_records_kernel(const __grid_constant__ FinishArguments<S> arguments) {
  const int64_t i = int64_t(blockIdx.x) * kStoreBlock + threadIdx.x;
  if (i >= arguments.num_gaussians || arguments.radii[i] == 0) return;
  S* record = arguments.records + i * arguments.length;
  store_gate_gradient(gate_of_moments(arguments.saved.projected[i], record), record);
}

}  // namespace

template <class S> void finish_records(const Frame<S>& frame, const BackwardPass<S>& pass, const Work& work) {
  FinishArguments<S> arguments = {};
  arguments.num_gaussians = frame.inputs.num_gaussians;
  arguments.length = kNumGateMoments + frame.config.num_features();
  arguments.saved = frame.saved;
  arguments.radii = frame.images.radii;
  arguments.records = pass.dL_dgaussians;
  if (arguments.num_gaussians == 0) return;
  finish_records_kernel<<<blocks_for(arguments.num_gaussians, kStoreBlock), kStoreBlock, 0, work.stream>>>(arguments);
  DSMOE_CHECK_LAUNCH("finish_records");
}

template <class S> void project_backward(const Frame<S>& frame, const BackwardPass<S>& pass, const Work& work) {
  const GaussianInputs<S>& inputs = frame.inputs;
  const RasterConfig<S>& config = frame.config;
  const GaussianGradients<S>& gradients = pass.gradients.inputs;
  const S* dL_dgaussians = pass.dL_dgaussians;
  Scratch& scratch = *work.scratch;
  const cudaStream_t stream = work.stream;
  ProjectBackwardArguments<S> arguments = {};
  arguments.inputs = inputs;
  arguments.camera = frame.camera;
  arguments.config = config;
  arguments.saved = frame.saved;
  arguments.radii = frame.images.radii;
  arguments.dL_dgaussians = dL_dgaussians;
  arguments.by_footprints = pass.by_footprints;
  arguments.dL_ddepths = pass.dL_ddepths;
  arguments.gradients = gradients;
  const bool with_camera = gradients.camera != nullptr;
  const int64_t blocks = blocks_for(inputs.num_gaussians, kRowsBlock), warps = blocks * (kRowsBlock / kWarp);
  const int columns = camera_columns(kind_of(frame.camera) == CameraKind::kShutter);
  if (with_camera) arguments.camera_rows = allocate<S>(scratch, warps * columns);
  if (inputs.num_gaussians > 0) {
    const bool aligned = are_vector_aligned(dL_dgaussians, gradients.shs, gradients.dc, gradients.means3D,
                                            gradients.means2D, gradients.scales, gradients.rotations);
    dispatch_camera<S>(kind_of(frame.camera), [&](auto camera) {
      using AnyCamera = typename decltype(camera)::type;
      dispatch_sh_rows(inputs, aligned, [&](auto type, size_t shared) {
        using Rows = typename decltype(type)::type;
        const auto launch = [&](auto kernel, size_t shared_bytes) {
          kernel<<<static_cast<unsigned>(blocks), kRowsBlock, shared_bytes, stream>>>(arguments);
          DSMOE_CHECK_LAUNCH("project_backward");
        };
        if constexpr (Rows::kKnown) {
          shared += sizeof(float) * kRowsBlock * RecordRows::stride(kRecordLength);
          if (config.num_features() == kFastFeatures) {
            with_camera ? launch(known_backward_kernel<AnyCamera, true, true, Rows>, shared)
                        : launch(known_backward_kernel<AnyCamera, false, true, Rows>, shared);
          } else {
            with_camera ? launch(known_backward_kernel<AnyCamera, true, false, Rows>, shared)
                        : launch(known_backward_kernel<AnyCamera, false, false, Rows>, shared);
          }
        } else {
          with_camera ? launch(project_backward_kernel<AnyCamera, S, true, Rows>, shared)
                      : launch(project_backward_kernel<AnyCamera, S, false, Rows>, shared);
        }
      });
    });
  }
  if (with_camera) {
    sum_columns(arguments.camera_rows, warps, columns, reinterpret_cast<S*>(gradients.camera), stream);
  }
}

#define DSMOE_INSTANTIATE(S)                                                          \
  template void finish_records(const Frame<S>&, const BackwardPass<S>&, const Work&); \
  template void project_backward(const Frame<S>&, const BackwardPass<S>&, const Work&);
DSMOE_INSTANTIATE(float)
DSMOE_INSTANTIATE(double)
#undef DSMOE_INSTANTIATE

}  // namespace cuda
}  // namespace dsmoe
