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
  template <class S>
  static void adam(const std::vector<AdamTensor<S>>& tensors, const AdamConstants<S>& constants, const bool* visible) {
    cuda::adam(tensors, constants, visible, current_stream());
  }

  template <class S> static int64_t num_image_loss_sums(const ImageLoss<S>& loss) {
    return cuda::num_image_loss_sums<S>(loss.planes, loss.height, loss.width);
  }

  template <class S> static void image_loss(const ImageLoss<S>& loss) { cuda::image_loss(loss, current_stream()); }

  template <class S>
  static void activate(const GaussianParameters<const S>& raw, const GaussianParameters<S>& values, int64_t count) {
    cuda::activate(raw, values, count, current_stream());
  }

  template <class S>
  static void activate_backward(const GaussianParameters<const S>& raw, const GaussianParameters<const S>& values,
                                const GaussianParameters<const S>& dL_dvalues, const GaussianParameters<S>& dL_draw,
                                int64_t count) {
    cuda::activate_backward(raw, values, dL_dvalues, dL_draw, count, current_stream());
  }

  template <class S>
  static void add_view(const S* dL_dmeans2D, const int32_t* radii, S* gradient_sum, S* view_count, int64_t count) {
    cuda::add_view(dL_dmeans2D, radii, gradient_sum, view_count, count, current_stream());
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
    cuda::morton_codes(given.data_ptr<scalar_t>(), count, low.data_ptr<scalar_t>(), high.data_ptr<scalar_t>(),
                       codes.data_ptr<int64_t>(), current_stream());
    const at::Tensor order = codes.argsort();
    const at::Tensor sorted = given.index_select(0, order);
    const at::Tensor boxes = at::empty({(count + cuda::kBoxPoints - 1) / cuda::kBoxPoints, 2, 3}, given.options());
    cuda::mean_squared_distances(sorted.data_ptr<scalar_t>(), order.data_ptr<int64_t>(), count,
                                 boxes.data_ptr<scalar_t>(), result.data_ptr<scalar_t>(), current_stream());
  });
  return result;
}

}  // namespace
}  // namespace binding
}  // namespace dsmoe

TORCH_LIBRARY_IMPL(diff_smoe_rasterization, CUDA, m) {
  m.impl("adam", &dsmoe::binding::adam<dsmoe::binding::Cuda>);
  m.impl("image_loss", &dsmoe::binding::image_loss<dsmoe::binding::Cuda>);
  m.impl("activate", &dsmoe::binding::activate<dsmoe::binding::Cuda>);
  m.impl("activate_backward", &dsmoe::binding::activate_backward<dsmoe::binding::Cuda>);
  m.impl("add_view", &dsmoe::binding::add_view<dsmoe::binding::Cuda>);
  m.impl("mean_squared_neighbour_distances", &dsmoe::binding::mean_squared_neighbour_distances);
}
