// The trainers' ops on a GPU: on the tensors' device and torch's current stream.
#include <ATen/cuda/CUDAContext.h>
#include <torch/library.h>

#include "dsmoe/neighbors.h"
#include "training_ops.h"

namespace dsmoe {
namespace binding {
namespace {

void* current_stream() { return at::cuda::getCurrentCUDAStream().stream(); }

struct Cuda {
  template <class S> static void adam(const std::vector<AdamTensor<S>>& tensors, const AdamStep<S>& step) {
    cuda::adam(tensors, step, current_stream());
  }

  template <class S> static void catch_up(const LazyAdam<S>& adam) { cuda::catch_up(adam, current_stream()); }

  template <class S> static void note_step(const LazyAdamStep<S>& step) { cuda::note_step(step, current_stream()); }

  template <class S> static void step_gaussians(const GaussianAdam<S>& adam) {
    cuda::step_gaussians(adam, current_stream());
  }

  template <class S> static void gather_rows(const std::vector<GatherTensor<S>>& tensors, const GatherRows& rows) {
    cuda::gather_rows(tensors, rows, current_stream());
  }

  template <class S> static int64_t num_image_loss_sums(const ImageLoss<S>& loss) {
    return cuda::num_image_loss_sums<S>(loss.planes, loss.height, loss.width);
  }

  template <class S> static void image_loss(const ImageLoss<S>& loss) { cuda::image_loss(loss, current_stream()); }

  template <class Pass> static void for_each_gaussian(const Pass& pass, int64_t count) {
    cuda::for_each_gaussian(pass, count, current_stream());
  }
};

at::Tensor mean_squared_neighbour_distances(const at::Tensor& points) {
  check_points(points);
  const c10::DeviceGuard guard(points.device());
  const int64_t count = points.size(0);
  const at::Tensor result = at::empty({count}, points.options());
  if (count == 0) return result;
  const at::Tensor given = points.contiguous(), low = given.amin(0), high = given.amax(0);
  const at::Tensor codes = at::empty({count}, given.options().dtype(at::kLong));
  AT_DISPATCH_FLOATING_TYPES(given.scalar_type(), "mean_squared_neighbour_distances", [&] {
    cuda::MortonCodes<scalar_t> morton = {};
    morton.points = given.data_ptr<scalar_t>();
    morton.count = count;
    morton.low = low.data_ptr<scalar_t>();
    morton.high = high.data_ptr<scalar_t>();
    morton.codes = codes.data_ptr<int64_t>();
    cuda::morton_codes(morton, current_stream());
    const at::Tensor order = codes.argsort();
    const at::Tensor sorted = given.index_select(0, order);
    const at::Tensor boxes = at::empty({(count + cuda::kBoxPoints - 1) / cuda::kBoxPoints, 2, 3}, given.options());
    cuda::NeighborDistances<scalar_t> search = {};
    search.points = sorted.data_ptr<scalar_t>();
    search.count = count;
    search.order = order.data_ptr<int64_t>();
    search.boxes = boxes.data_ptr<scalar_t>();
    search.result = result.data_ptr<scalar_t>();
    cuda::mean_squared_distances(search, current_stream());
  });
  return result;
}

}  // namespace
}  // namespace binding
}  // namespace dsmoe

TORCH_LIBRARY_IMPL(diff_smoe_rasterization, CUDA, m) {
  m.impl("adam", &dsmoe::binding::adam<dsmoe::binding::Cuda>);
  m.impl("lazy_adam_catch_up", &dsmoe::binding::lazy_adam_catch_up<dsmoe::binding::Cuda>);
  m.impl("lazy_adam_step", &dsmoe::binding::lazy_adam_step<dsmoe::binding::Cuda>);
  m.impl("gaussian_adam", &dsmoe::binding::gaussian_adam<dsmoe::binding::Cuda>);
  m.impl("gather_rows", &dsmoe::binding::gather_rows<dsmoe::binding::Cuda>);
  m.impl("image_loss", &dsmoe::binding::image_loss<dsmoe::binding::Cuda>);
  m.impl("activate", &dsmoe::binding::activate<dsmoe::binding::Cuda>);
  m.impl("activate_backward", &dsmoe::binding::activate_backward<dsmoe::binding::Cuda>);
  m.impl("add_view", &dsmoe::binding::add_view<dsmoe::binding::Cuda>);
  m.impl("mean_squared_neighbour_distances", &dsmoe::binding::mean_squared_neighbour_distances);
}
