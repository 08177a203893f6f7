// The first half of a rendering for the views of a batch, and back. A thread takes a Gaussian through all views, so
// that its numbers are read once, and so that its gradients are written once.
#include <algorithm>

#include "cuda/lane_gradient.cuh"
#include "refuse.h"

namespace dsmoe {
namespace cuda {
namespace {

static_assert(kViewBlock == kRowsBlock, "a block of threads has a block of Gaussians");
constexpr int kViewWarps = kViewBlock / kWarp;

struct BatchArguments {
  GaussianInputs<float> inputs;
  RasterConfig<float> config;
  GaussianGradients<float> gradients;  // of the backward pass
  int num_views;
  BatchView<DeviceCamera<float>> views[kMostViews];
};
static_assert(sizeof(BatchArguments) <= 4096, "what every card takes as arguments of a kernel");

BatchArguments arguments_of(const ViewBatch& batch) {
  BatchArguments arguments = {};
  arguments.inputs = batch.inputs, arguments.config = batch.config;
  arguments.num_views = static_cast<int>(batch.views.size());
  std::copy(batch.views.begin(), batch.views.end(), arguments.views);
  return arguments;
}

// All threads of the block take part. No barrier.
template <class AnyCamera> __device__ void load_cameras(const BatchArguments& arguments, AnyCamera* cameras) {
  for (int v = 0; v < arguments.num_views; ++v) load_camera(arguments.views[v].camera, cameras[v]);
}

// Where the rows of a thread's Gaussian are.
class RowsOfViews {
 public:
  // counts: [views, warps] in shared memory. All threads of the block take part, which then wait for each other.
  __device__ RowsOfViews(const BatchArguments& arguments, int64_t i, int* counts)
      : arguments_(arguments), i_(i), exists_(i < arguments.inputs.num_gaussians), counts_(counts) {
    const int lane = threadIdx.x % kWarp, warp = threadIdx.x / kWarp;
    for (int v = 0; v < arguments.num_views; ++v) {
      const int32_t own = radius(v);
      const unsigned all = __ballot_sync(kAllLanes, own != 0);
      has_row_ |= own != 0;
      if (lane == 0) counts[v * kViewWarps + warp] = __popc(all);
    }
  }

  // Whether the Gaussian has a row in a view.
  __device__ bool has_row() const { return has_row_; }

  __device__ int32_t radius(int v) const { return exists_ ? arguments_.views[v].radii[i_] : 0; }

  // The Gaussian's row in a view, -1 if it has none. After a barrier; all lanes of the warp take part.
  __device__ int64_t row(int v, int32_t radius) const {
    const unsigned all = __ballot_sync(kAllLanes, radius != 0);
    const auto& view = arguments_.views[v];
    int64_t row = view.offsets[blockIdx.x];
    for (int warp = 0; warp < threadIdx.x / kWarp; ++warp) row += counts_[v * kViewWarps + warp];
    row += __popc(all & ((1u << threadIdx.x % kWarp) - 1));
    return radius != 0 && row < view.num_rows ? row : -1;
  }

 private:
  const BatchArguments& arguments_;
  const int64_t i_;
  const bool exists_;
  const int* counts_;
  bool has_row_ = false;
};

template <class AnyCamera>
__global__ void __launch_bounds__(kViewBlock) count_rows_kernel(const __grid_constant__ BatchArguments arguments) {
  __shared__ AnyCamera cameras[kMostViews];
  __shared__ int counts[kMostViews];
  const int64_t i = int64_t(blockIdx.x) * kViewBlock + threadIdx.x;
  const bool exists = i < arguments.inputs.num_gaussians;
  const Gaussian<float> gaussian = load_gaussian(arguments.inputs, exists ? i : 0);
  load_cameras(arguments, cameras);
  if (threadIdx.x < arguments.num_views) counts[threadIdx.x] = 0;
  __syncthreads();
  for (int v = 0; v < arguments.num_views; ++v) {
    int32_t radius = 0;
    if (exists) {
      radius = project(gaussian, cameras[v], arguments.config.projection_rules()).radius;
      arguments.views[v].radii[i] = radius;
    }
    const unsigned all = __ballot_sync(kAllLanes, radius > 0);
    if (threadIdx.x % kWarp == 0) atomicAdd(&counts[v], __popc(all));
  }
  __syncthreads();
  if (threadIdx.x < arguments.num_views) arguments.views[threadIdx.x].offsets[blockIdx.x] = counts[threadIdx.x];
}

// Makes first rows of the counts, in one block for each view. A thread adds up a strip of them.
__global__ void __launch_bounds__(kSortBlock)
    add_up_rows_kernel(const __grid_constant__ BatchArguments arguments, int64_t blocks) {
  __shared__ int32_t sums[kSortBlock];
  int32_t* offsets = arguments.views[blockIdx.x].offsets;
  const int64_t strip = (blocks + kSortBlock - 1) / kSortBlock;
  const int64_t begin = min(blocks, strip * threadIdx.x), end = min(blocks, begin + strip);
  int32_t sum = 0;
  for (int64_t block = begin; block < end; ++block) sum += offsets[block];
  sums[threadIdx.x] = sum;
  for (int step = 1; step < kSortBlock; step *= 2) {
    __syncthreads();
    const int32_t before = threadIdx.x >= step ? sums[threadIdx.x - step] : 0;
    __syncthreads();
    sums[threadIdx.x] += before;
  }
  int32_t first = sums[threadIdx.x] - sum;
  for (int64_t block = begin; block < end; ++block) {
    const int32_t count = offsets[block];
    offsets[block] = first;
    first += count;
  }
  if (threadIdx.x == kSortBlock - 1) offsets[blocks] = first;
}

// What the threads of a block share, besides SH rows.
template <class AnyCamera> struct SharedViews {
  AnyCamera cameras[kMostViews];
  int counts[kMostViews * kViewWarps];
};

// A thread's Gaussian, with its SH row and where its rows are.
template <class AnyCamera, class Rows> class ViewLane {
 public:
  // sh_rows: shared memory. All threads of the block take part, and wait for each other.
  __device__ ViewLane(const BatchArguments& arguments, SharedViews<AnyCamera>& shared, float4* sh_rows)
      : i(int64_t(blockIdx.x) * kViewBlock + threadIdx.x),
        length(3 * arguments.inputs.num_sh),
        first(i - threadIdx.x % kWarp),
        rows(reinterpret_cast<float*>(sh_rows) + threadIdx.x / kWarp * kWarp * Rows::stride(length), length,
             static_cast<int>(max<int64_t>(0, min<int64_t>(kWarp, arguments.inputs.num_gaussians - first))),
             threadIdx.x % kWarp),
        of_views(arguments, i, shared.counts),
        config(arguments.config),
        inputs_(arguments.inputs),
        own_(i < inputs_.num_gaussians ? i : 0) {
    load_cameras(arguments, shared.cameras);
    if constexpr (Rows::kStaged) {
      rows.load(inputs_.shs + first * length, __ballot_sync(kAllLanes, of_views.has_row()));
      wait_for_copies();
    }
    __syncthreads();
    gaussian = Rows::gaussian(inputs_, own_);
    if constexpr (Rows::kDcApart) store3(dc_, load3(inputs_.dc + 3 * own_));
    config.num_channels = kFastFeatures;
    config.leave_out_further_features();
  }

  __device__ ColorSource<float> source(const PinholeCamera<float>& camera) const {
    return {colors(), gaussian.mean, camera, config};
  }

  const int64_t i;      // of the Gaussian, which may not exist
  const int length;     // numbers of an SH row
  const int64_t first;  // Gaussian of the warp
  const Rows rows;
  const RowsOfViews of_views;
  RasterConfig<float> config;
  Gaussian<float> gaussian;

 private:
  __device__ Colors<float> colors() const {
    if constexpr (Rows::kKnown) return Rows::known_colors(dc_, rows.own());
    Colors<float> colors = colors_of(inputs_, kFastFeatures, own_);
    if (Rows::kStaged) colors.shs = rows.own();
    return colors;
  }

  const GaussianInputs<float>& inputs_;
  const int64_t own_;  // a Gaussian that exists
  float dc_[3];        // if degree 0 lies apart
};

template <class AnyCamera, class Rows>
__global__ void __launch_bounds__(kViewBlock) project_rows_kernel(const __grid_constant__ BatchArguments arguments) {
  __shared__ SharedViews<AnyCamera> shared;
  extern __shared__ float4 shared_rows[];
  const ViewLane<AnyCamera, Rows> lane(arguments, shared, shared_rows);
  for (int v = 0; v < arguments.num_views; ++v) {
    const auto& view = arguments.views[v];
    int32_t radius = lane.of_views.radius(v);
    const int64_t row = lane.of_views.row(v, radius);
    if (row < 0) continue;
    auto [radius_again, projected] = project(lane.gaussian, shared.cameras[v], lane.config.projection_rules());
    float features[kFastFeatures] = {};
    // The kernel that counted may have rounded otherwise: then the Gaussian is culled only here.
    if (radius_again == 0 || !write_features<float>(lane.source(shared.cameras[v]), projected.depth, features)) {
      radius = 0, projected = {};
      features[0] = features[1] = features[2] = 0;
      view.radii[lane.i] = kCulledInRow;
    }
    *reinterpret_cast<ProjectedGaussian<float>*>(view.gates + row * kProjectedGaussianSize) = projected;
    *reinterpret_cast<float4*>(view.features + row * kRowFeatures) =
        make_float4(features[0], features[1], features[2], __int_as_float(radius));
  }
}

template <class AnyCamera, class Rows>
__global__ void __launch_bounds__(kViewBlock, Rows::kKnown ? kViewsBackwardBlocks : 1)
    project_rows_backward_kernel(const __grid_constant__ BatchArguments arguments) {
  __shared__ SharedViews<AnyCamera> shared;
  extern __shared__ float4 shared_rows[];
  const ViewLane<AnyCamera, Rows> lane(arguments, shared, shared_rows);
  const GaussianGradients<float>& gradients = arguments.gradients;
  ViewSum<Rows::kKnown ? Rows::kLength : kAllShLength> sum;
  for (int v = 0; v < arguments.num_views; ++v) {
    const auto& view = arguments.views[v];
    const int32_t radius = lane.of_views.radius(v);
    const int64_t row = lane.of_views.row(v, radius);
    if (row < 0 || radius < 0) continue;
    const float4 four = *reinterpret_cast<const float4*>(view.features + row * kRowFeatures);
    const float features[kFastFeatures] = {four.x, four.y, four.z};
    float record[kNumGateGradients + kFastFeatures];
    for (int k = 0; k < kNumGateGradients + kFastFeatures; ++k) {
      record[k] = view.records[row * (kNumGateGradients + kFastFeatures) + k];
    }
    const auto by_view = sum.add(lane.gaussian, lane.source(shared.cameras[v]), shared.cameras[v], features, record);
    if (view.means2D != nullptr) store3<float>(view.means2D + 3 * lane.i, {by_view.mean2D.x, by_view.mean2D.y, 0});
  }
  __syncwarp();
  if constexpr (Rows::kKnown) {
    lane.rows.write(sum.shs);
    store_gradients<Rows>({sum.gaussian, {sum.dc[0], sum.dc[1], sum.dc[2]}}, lane.rows, gradients, lane.rows.all());
  } else {
    if (lane.i < arguments.inputs.num_gaussians) {
      store_gradient(sum.gaussian, gradients, lane.i);
      if (gradients.dc != nullptr) store3(gradients.dc + 3 * lane.i, load3(sum.dc));
      for (int k = 0; gradients.shs != nullptr && k < lane.length; ++k) {
        (Rows::kStaged ? lane.rows.own() : gradients.shs + lane.i * lane.length)[k] = sum.shs[k];
      }
    }
    if constexpr (Rows::kStaged) {
      if (gradients.shs != nullptr) lane.rows.store(gradients.shs + lane.first * lane.length, lane.rows.all());
    }
  }
}

template <class Body> void dispatch_cameras(const ViewBatch& batch, const Body& body) {
  CameraKind most = CameraKind::kPinhole;
  for (const auto& view : batch.views) most = std::max(most, kind_of(view.camera));
  dispatch_camera<float>(most, body);
}

// Calls launch(TypeOf<camera>, TypeOf<rows>, blocks, bytes of shared memory).
template <class Launch> void launch_rows(const ViewBatch& batch, bool aligned, const Launch& launch) {
  dispatch_cameras(batch, [&](auto camera) {
    dispatch_sh_rows(batch.inputs, aligned, [&](auto rows, size_t shared) {
      launch(camera, rows, static_cast<unsigned>(num_view_blocks(batch.inputs.num_gaussians)), shared);
    });
  });
}

}  // namespace

void count_rows(const ViewBatch& batch, const Work& work) {
  refuse_batch<Frame<float>>("cuda::count_rows", batch, [](const auto&) {});
  const BatchArguments arguments = arguments_of(batch);
  const int64_t blocks = num_view_blocks(batch.inputs.num_gaussians);
  if (blocks > 0) {
    dispatch_cameras(batch, [&](auto camera) {
      using AnyCamera = typename decltype(camera)::type;
      count_rows_kernel<AnyCamera><<<static_cast<unsigned>(blocks), kViewBlock, 0, work.stream>>>(arguments);
      DSMOE_CHECK_LAUNCH("count_rows");
    });
  }
  add_up_rows_kernel<<<arguments.num_views, kSortBlock, 0, work.stream>>>(arguments, blocks);
  DSMOE_CHECK_LAUNCH("add_up_rows");
}

void project_rows(const ViewBatch& batch, const Work& work) {
  refuse_rows<Frame<float>>("cuda::project_rows", batch, false);
  if (batch.inputs.num_gaussians == 0) return;
  const BatchArguments arguments = arguments_of(batch);
  launch_rows(batch, true, [&](auto camera, auto rows, unsigned blocks, size_t shared) {
    using AnyCamera = typename decltype(camera)::type;
    using Rows = typename decltype(rows)::type;
    project_rows_kernel<AnyCamera, Rows><<<blocks, kViewBlock, shared, work.stream>>>(arguments);
    DSMOE_CHECK_LAUNCH("project_rows");
  });
}

void project_rows_backward(const ViewBatch& batch, const GaussianGradients<float>& gradients, const Work& work) {
  refuse_rows<Frame<float>>("cuda::project_rows_backward", batch, true);
  if (batch.inputs.num_gaussians == 0) return;
  BatchArguments arguments = arguments_of(batch);
  arguments.gradients = gradients;
  const bool aligned =
      are_vector_aligned(gradients.shs, gradients.dc, gradients.means3D, gradients.scales, gradients.rotations);
  launch_rows(batch, aligned, [&](auto camera, auto rows, unsigned blocks, size_t shared) {
    using AnyCamera = typename decltype(camera)::type;
    using Rows = typename decltype(rows)::type;
    project_rows_backward_kernel<AnyCamera, Rows><<<blocks, kViewBlock, shared, work.stream>>>(arguments);
    DSMOE_CHECK_LAUNCH("project_rows_backward");
  });
}

}  // namespace cuda
}  // namespace dsmoe
