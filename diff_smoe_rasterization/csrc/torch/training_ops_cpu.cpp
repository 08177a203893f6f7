// The trainers' ops on the CPU.
#include "cpu/parallel.h"
#include "dsmoe/neighbors.h"
#include "training_ops.h"

namespace dsmoe {
namespace binding {
namespace {

constexpr int64_t kChunk = 1 << 14;  // Gaussians a thread takes at a time

struct TrainingCpu {
  template <class S> static void adam(const std::vector<AdamTensor<S>>& tensors, const AdamStep<S>& step) {
    cpu::adam(tensors, step, num_threads());
  }

  template <class S> static void catch_up(const LazyAdam<S>& adam) { cpu::catch_up(adam, num_threads()); }

  template <class S> static void note_step(const LazyAdamStep<S>& step) { cpu::note_step(step); }

  template <class S> static void step_gaussians(const GaussianAdam<S>& adam) {
    cpu::step_gaussians(adam, num_threads());
  }

  template <class S> static void gather_rows(const std::vector<GatherTensor<S>>& tensors, const GatherRows& rows) {
    cpu::gather_rows(tensors, rows, num_threads());
  }

  template <class S> static int64_t num_image_loss_sums(const ImageLoss<S>& loss) {
    return cpu::num_image_loss_sums(loss.planes, loss.height, loss.width);
  }

  template <class S> static void image_loss(const ImageLoss<S>& loss) { cpu::image_loss(loss, num_threads()); }

  template <class Pass> static void for_each_gaussian(const Pass& pass, int64_t count) {
    cpu::parallel_for(num_threads(), count, kChunk, [&](int64_t begin, int64_t end) {
      for (int64_t i = begin; i < end; ++i) pass(i);
    });
  }

  static Tensor mean_squared_neighbour_distances(const Tensor& points) {
    check_points(points);
    const Tensor dense = points.contiguous(), result = empty({points.size(0)}, points);
    dispatch_real(points, [&](auto zero) {
      using scalar_t = decltype(zero);
      cpu::mean_squared_distances(dense.data_ptr<scalar_t>(), points.size(0), result.data_ptr<scalar_t>(),
                                  num_threads());
    });
    return result;
  }
};

}  // namespace
}  // namespace binding
}  // namespace dsmoe

DSMOE_LIBRARY_IMPL(CPU, m) { dsmoe::binding::register_training_ops<dsmoe::binding::TrainingCpu>(m); }
