// The trainers' ops on the CPU.
#include <ATen/Parallel.h>
#include <torch/library.h>

#include "cpu/parallel.h"
#include "dsmoe/neighbors.h"
#include "training_ops.h"

namespace dsmoe {
namespace binding {
namespace {

constexpr int64_t kChunk = 1 << 14;  // Gaussians a thread takes at a time

struct Cpu {
  template <class S> static void adam(const std::vector<AdamTensor<S>>& tensors, const AdamStep<S>& step) {
    cpu::adam(tensors, step, at::get_num_threads());
  }

  template <class S> static void catch_up(const LazyAdam<S>& adam) { cpu::catch_up(adam, at::get_num_threads()); }

  template <class S> static void note_step(const LazyAdamStep<S>& step) { cpu::note_step(step); }

  template <class S> static void step_gaussians(const GaussianAdam<S>& adam) {
    cpu::step_gaussians(adam, at::get_num_threads());
  }

  template <class S> static void gather_rows(const std::vector<GatherTensor<S>>& tensors, const GatherRows& rows) {
    cpu::gather_rows(tensors, rows, at::get_num_threads());
  }

  template <class S> static int64_t num_image_loss_sums(const ImageLoss<S>& loss) {
    return cpu::num_image_loss_sums(loss.planes, loss.height, loss.width);
  }

  template <class S> static void image_loss(const ImageLoss<S>& loss) { cpu::image_loss(loss, at::get_num_threads()); }

  template <class Pass> static void for_each_gaussian(const Pass& pass, int64_t count) {
    cpu::parallel_for(at::get_num_threads(), count, kChunk, [&](int64_t begin, int64_t end) {
      for (int64_t i = begin; i < end; ++i) pass(i);
    });
  }
};

at::Tensor mean_squared_neighbour_distances(const at::Tensor& points) {
  check_points(points);
  const at::Tensor dense = points.contiguous(), result = at::empty({points.size(0)}, points.options());
  AT_DISPATCH_FLOATING_TYPES(points.scalar_type(), "mean_squared_neighbour_distances", [&] {
    cpu::mean_squared_distances(dense.data_ptr<scalar_t>(), points.size(0), result.data_ptr<scalar_t>(),
                                at::get_num_threads());
  });
  return result;
}

}  // namespace
}  // namespace binding
}  // namespace dsmoe

TORCH_LIBRARY_IMPL(diff_smoe_rasterization, CPU, m) {
  m.impl("adam", &dsmoe::binding::adam<dsmoe::binding::Cpu>);
  m.impl("lazy_adam_catch_up", &dsmoe::binding::lazy_adam_catch_up<dsmoe::binding::Cpu>);
  m.impl("lazy_adam_step", &dsmoe::binding::lazy_adam_step<dsmoe::binding::Cpu>);
  m.impl("gaussian_adam", &dsmoe::binding::gaussian_adam<dsmoe::binding::Cpu>);
  m.impl("gather_rows", &dsmoe::binding::gather_rows<dsmoe::binding::Cpu>);
  m.impl("image_loss", &dsmoe::binding::image_loss<dsmoe::binding::Cpu>);
  m.impl("activate", &dsmoe::binding::activate<dsmoe::binding::Cpu>);
  m.impl("activate_backward", &dsmoe::binding::activate_backward<dsmoe::binding::Cpu>);
  m.impl("add_view", &dsmoe::binding::add_view<dsmoe::binding::Cpu>);
  m.impl("mean_squared_neighbour_distances", &dsmoe::binding::mean_squared_neighbour_distances);
}
