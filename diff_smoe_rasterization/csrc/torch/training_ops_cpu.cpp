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
  template <class S>
  static void adam(const std::vector<AdamTensor<S>>& tensors, const AdamConstants<S>& constants, const bool* visible) {
    cpu::adam(tensors, constants, visible, at::get_num_threads());
  }

  template <class S> static int64_t num_image_loss_sums(const ImageLoss<S>& loss) {
    return cpu::num_image_loss_sums(loss.planes, loss.height, loss.width);
  }

  template <class S> static void image_loss(const ImageLoss<S>& loss) { cpu::image_loss(loss, at::get_num_threads()); }

  template <class Function> static void for_each(int64_t count, Function function) {
    cpu::parallel_for(at::get_num_threads(), count, kChunk, [&](int64_t begin, int64_t end) {
      for (int64_t i = begin; i < end; ++i) function(i);
    });
  }

  template <class S>
  static void activate(const GaussianParameters<const S>& raw, const GaussianParameters<S>& values, int64_t count) {
    for_each(count, [&](int64_t i) { dsmoe::activate(raw, values, i); });
  }

  template <class S>
  static void activate_backward(const GaussianParameters<const S>& raw, const GaussianParameters<const S>& values,
                                const GaussianParameters<const S>& dL_dvalues, const GaussianParameters<S>& dL_draw,
                                int64_t count) {
    for_each(count, [&](int64_t i) { dsmoe::activate_backward(raw, values, dL_dvalues, dL_draw, i); });
  }

  template <class S>
  static void add_view(const S* dL_dmeans2D, const int32_t* radii, S* gradient_sum, S* view_count, int64_t count) {
    for_each(count, [&](int64_t i) { dsmoe::add_view(dL_dmeans2D, radii, gradient_sum, view_count, i); });
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
  m.impl("image_loss", &dsmoe::binding::image_loss<dsmoe::binding::Cpu>);
  m.impl("activate", &dsmoe::binding::activate<dsmoe::binding::Cpu>);
  m.impl("activate_backward", &dsmoe::binding::activate_backward<dsmoe::binding::Cpu>);
  m.impl("add_view", &dsmoe::binding::add_view<dsmoe::binding::Cpu>);
  m.impl("mean_squared_neighbour_distances", &dsmoe::binding::mean_squared_neighbour_distances);
}
