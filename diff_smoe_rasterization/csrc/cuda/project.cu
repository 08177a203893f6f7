// Stage 1: every Gaussian to the image plane.
#include "../dispatch.h"
#include "../refuse.h"
#include "dsmoe/project.h"
#include "sh_rows.cuh"

namespace dsmoe {
namespace cuda {
namespace {

// Where the order of the Gaussians begins: with what the depth sort sorts or, without a depth order, with the order.
template <class S> struct OrderTargets {
  DepthBits<S>* depths;   // [N] the greatest number for culled Gaussians; null: the order is written
  int32_t* order;         // [N] 0, 1, 2, ...; ~i for a culled Gaussian i; or null
  int64_t* num_ordered;   // N is written
  int64_t num_gaussians;  // N
};

template <class S> OrderTargets<S> order_targets(const Frame<S>& frame, DepthBits<S>* depths) {
  return {depths, frame.saved.order, frame.saved.num_ordered, frame.inputs.num_gaussians};
}

template <class S> struct ProjectArguments {
  GaussianInputs<S> inputs;  // read
  DeviceCamera<S> camera;    // read
  RasterConfig<S> config;    // read
  SavedForward<S> saved;     // projected and features are written
  int32_t* radii;            // [N] pixels, written
  OrderTargets<S> order;     // written
};

// Writes the features of a Gaussian, one row of saved.features. If their number is known they stay in registers
// until they are written. Returns false if the Gaussian is culled.
template <int kFeatures, class S> __device__ bool store_features(const ColorSource<S>& source, S depth, S* out) {
  const RasterConfig<S>& config = source.config;
  if constexpr (kFeatures == kFastFeatures) {
    RasterConfig<S> known = config;
    known.num_channels = kFastFeatures;
    known.leave_out_further_features();
    S features[kFastFeatures];
    if (!write_features<S>({source.colors, source.mean, source.camera, known}, depth, features)) return false;
    *reinterpret_cast<float4*>(out) = make_float4(features[0], features[1], features[2], 0);
    return true;
  } else {
    for (int f = config.num_features(); f < feature_stride(config.num_features()); ++f) out[f] = S(0);
    return write_features(source, depth, out);
  }
}

// radius: 0 if Gaussian i is culled.
template <class S> __device__ void store_order(const OrderTargets<S>& to, int64_t i, int32_t radius, S depth) {
  if (to.depths != nullptr) {
    to.depths[i] = radius > 0 ? depth_bits(depth) : ~DepthBits<S>(0);
  } else if (to.order != nullptr) {
    to.order[i] = static_cast<int32_t>(radius > 0 ? i : ~i);
    if (i == 0) *to.num_ordered = to.num_gaussians;
  }
}

// Without Gaussians no thread runs, so the host writes the zero.
template <class S> void order_nothing(const Frame<S>& frame, cudaStream_t stream) {
  if (frame.saved.num_ordered == nullptr) return;
  check(cudaMemsetAsync(frame.saved.num_ordered, 0, sizeof(int64_t), stream), "projecting Gaussians");
}

template <class AnyCamera, class S, int kFeatures, class Rows>
__global__ void __launch_bounds__(kRowsBlock) project_kernel(const __grid_constant__ ProjectArguments<S> arguments) {
  __shared__ AnyCamera camera;
  extern __shared__ float4 shared_rows[];
  const GaussianInputs<S>& inputs = arguments.inputs;
  const RasterConfig<S>& config = arguments.config;
  const int64_t i = int64_t(blockIdx.x) * kRowsBlock + threadIdx.x;
  const int warp = threadIdx.x / kWarp, lane = threadIdx.x % kWarp;
  const bool exists = i < inputs.num_gaussians;
  const int64_t own = exists ? i : 0;
  const Gaussian<S> gaussian = Rows::gaussian(inputs, own);
  S dc[3];
  if constexpr (Rows::kDcApart) store3(dc, load3(inputs.dc + 3 * own));
  load_camera(arguments.camera, camera);
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
    S* features = arguments.saved.features + i * feature_stride(config.num_features());
    if (!store_features<kFeatures, S>({colors, gaussian.mean, camera, config}, depth, features)) radius = 0;
    arguments.saved.projected[i] = projection.gaussian;
  }
  arguments.radii[i] = radius;
  store_order(arguments.order, i, radius, depth);
}

template <class S> struct KeyArguments {
  int64_t num_gaussians;                  // N
  const ProjectedGaussian<S>* projected;  // [N]
  const int32_t* radii;                   // [N] pixels
  OrderTargets<S> order;                  // written
};

template <class S>
__global__ void __launch_bounds__(kStoreBlock)
    key_footprints_kernel(const __grid_constant__ KeyArguments<S> arguments) {
  const int64_t i = int64_t(blockIdx.x) * kStoreBlock + threadIdx.x;
  if (i >= arguments.num_gaussians) return;
  store_order(arguments.order, i, arguments.radii[i], arguments.projected[i].depth);
}

template <class S> struct RadiiArguments {
  GaussianInputs<S> inputs;  // read
  DeviceCamera<S> camera;    // read
  RasterConfig<S> config;    // read
  int32_t* radii;            // [N] pixels, written
};

template <class AnyCamera, class S>
__global__ void __launch_bounds__(kRowsBlock) radii_kernel(const __grid_constant__ RadiiArguments<S> arguments) {
  __shared__ AnyCamera camera;
  load_camera(arguments.camera, camera);
  __syncthreads();
  const int64_t i = int64_t(blockIdx.x) * kRowsBlock + threadIdx.x;
  if (i >= arguments.inputs.num_gaussians) return;
  S features[kMostHeldFeatures];
  arguments.radii[i] = project_gaussian<S, AnyCamera>({arguments.inputs, camera, arguments.config, i}, features).radius;
}

template <class S> struct VisibleArguments {
  int64_t num_gaussians;  // N
  const S* means3D;       // [N, 3] world
  const S* view;          // [4, 4] as Camera has it
  S near;                 // view depth; what is not beyond is not visible
  const S* view_end;      // likewise; or null, if the shutter does not roll
  LensModel lens;         // which says what a depth is
  bool* visible;          // [N] written
};

template <class S>
__global__ void __launch_bounds__(kStoreBlock)
    mark_visible_kernel(const __grid_constant__ VisibleArguments<S> arguments) {
  const int64_t i = int64_t(blockIdx.x) * kStoreBlock + threadIdx.x;
  if (i >= arguments.num_gaussians) return;
  const Vec3<S> point = load3(arguments.means3D + 3 * i);
  bool visible = view_depth(arguments.lens, transform_point(arguments.view, point)) > arguments.near;
  if (arguments.view_end != nullptr) {
    visible |= view_depth(arguments.lens, transform_point(arguments.view_end, point)) > arguments.near;
  }
  arguments.visible[i] = visible;
}

}  // namespace

template <class S> void project(const Frame<S>& frame, DepthBits<S>* depths, const Work& work) {
  const GaussianInputs<S>& inputs = frame.inputs;
  if (inputs.num_gaussians == 0) return order_nothing(frame, work.stream);
  ProjectArguments<S> arguments = {};
  arguments.inputs = inputs;
  arguments.camera = frame.camera;
  arguments.config = frame.config;
  arguments.saved = frame.saved;
  arguments.radii = frame.images.radii;
  arguments.order = order_targets(frame, depths);
  dispatch_camera<S>(kind_of(frame.camera), [&](auto camera) {
    using AnyCamera = typename decltype(camera)::type;
    dispatch_sh_rows(inputs, true, [&](auto type, size_t shared) {
      using Rows = typename decltype(type)::type;
      const auto launch = [&](auto kernel) {
        kernel<<<blocks_for(inputs.num_gaussians, kRowsBlock), kRowsBlock, shared, work.stream>>>(arguments);
        DSMOE_CHECK_LAUNCH("project");
      };
      if constexpr (Rows::kStaged) {
        if (frame.config.num_features() == kFastFeatures) {
          return launch(project_kernel<AnyCamera, S, kFastFeatures, Rows>);
        }
      }
      launch(project_kernel<AnyCamera, S, kAnyFeatures, Rows>);
    });
  });
}

template <class S> void key_footprints(const Frame<S>& frame, DepthBits<S>* depths, const Work& work) {
  if (frame.inputs.num_gaussians == 0) return order_nothing(frame, work.stream);
  KeyArguments<S> arguments = {};
  arguments.num_gaussians = frame.inputs.num_gaussians;
  arguments.projected = frame.saved.projected;
  arguments.radii = frame.images.radii;
  arguments.order = order_targets(frame, depths);
  key_footprints_kernel<<<blocks_for(arguments.num_gaussians, kStoreBlock), kStoreBlock, 0, work.stream>>>(arguments);
  DSMOE_CHECK_LAUNCH("key_footprints");
}

template <class S> void project_radii(const Frame<S>& frame, const Work& work) {
  const int64_t count = frame.inputs.num_gaussians;
  if (count == 0) return;
  const RadiiArguments<S> arguments = {frame.inputs, frame.camera, frame.config, frame.images.radii};
  dispatch_camera<S>(kind_of(frame.camera), [&](auto camera) {
    using AnyCamera = typename decltype(camera)::type;
    radii_kernel<AnyCamera><<<blocks_for(count, kRowsBlock), kRowsBlock, 0, work.stream>>>(arguments);
    DSMOE_CHECK_LAUNCH("radii");
  });
}

template <class S> void mark_visible(const Frame<S>& frame, bool* visible, const Work& work) {
  refuse_mark_visible("cuda::mark_visible", frame, visible);
  VisibleArguments<S> arguments = {};
  arguments.num_gaussians = frame.inputs.num_gaussians;
  arguments.means3D = frame.inputs.means3D;
  arguments.view = frame.camera.view;
  arguments.view_end = frame.camera.shutter == Shutter::kGlobal ? nullptr : frame.camera.view_end;
  arguments.near = frame.camera.near;
  arguments.lens = frame.camera.lens.model;
  arguments.visible = visible;
  if (arguments.num_gaussians == 0) return;
  const unsigned blocks = blocks_for(arguments.num_gaussians, kStoreBlock);
  mark_visible_kernel<<<blocks, kStoreBlock, 0, work.stream>>>(arguments);
  DSMOE_CHECK_LAUNCH("mark_visible");
}

#define DSMOE_INSTANTIATE(S)                                                 \
  template void project(const Frame<S>&, DepthBits<S>*, const Work&);        \
  template void key_footprints(const Frame<S>&, DepthBits<S>*, const Work&); \
  template void project_radii(const Frame<S>&, const Work&);                 \
  template void mark_visible(const Frame<S>&, bool*, const Work&);
DSMOE_INSTANTIATE(float)
DSMOE_INSTANTIATE(double)
#undef DSMOE_INSTANTIATE

}  // namespace cuda
}  // namespace dsmoe
