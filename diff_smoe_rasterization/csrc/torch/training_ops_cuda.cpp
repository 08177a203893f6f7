// The trainers' ops on a GPU: on the tensors' device and torch's current stream.
#include "cuda_stream.h"
#include "dsmoe/neighbors.h"
#include "training_ops.h"

namespace dsmoe {
namespace binding {
namespace {

struct TrainingCuda {
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

  static Tensor mean_squared_neighbour_distances(const Tensor& points) {
    check_points(points);
    const DeviceGuard guard(points.device());
    const int64_t count = points.size(0);
    const Tensor result = empty({count}, points);
    if (count == 0) return result;
    const Tensor given = points.contiguous(), low = smallest(given), high = largest(given);
    const Tensor codes = empty({count}, given, kLong);
    dispatch_real(given, [&](auto zero) {
      using scalar_t = decltype(zero);
      cuda::MortonCodes<scalar_t> morton = {};
      morton.points = given.data_ptr<scalar_t>();
      morton.count = count;
      morton.low = low.data_ptr<scalar_t>();
      morton.high = high.data_ptr<scalar_t>();
      morton.codes = codes.data_ptr<int64_t>();
      cuda::morton_codes(morton, current_stream());
      const Tensor order = argsort(codes);
      const Tensor sorted = index_select(given, 0, order);
      const Tensor boxes = empty({(count + cuda::kBoxPoints - 1) / cuda::kBoxPoints, 2, 3}, given);
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
};

}  // namespace
}  // namespace binding
}  // namespace dsmoe

DSMOE_LIBRARY_IMPL(CUDA, m) { dsmoe::binding::register_training_ops<dsmoe::binding::TrainingCuda>(m); }
