// The trainers' ops on the CPU.
#include <ATen/Parallel.h>
#include <torch/library.h>

#include "optim/ops.h"

namespace dsmoe {
namespace binding {
namespace {

struct Cpu {
  template <class S>
  static void adam(const std::vector<AdamTensor<S>>& tensors, const AdamConstants<S>& constants, const bool* visible) {
    cpu::adam(tensors, constants, visible, at::get_num_threads());
  }

  template <class S> static int64_t num_image_loss_sums(const ImageLoss<S>& loss) {
    return cpu::num_image_loss_sums(loss.planes, loss.height, loss.width);
  }

  template <class S> static void image_loss(const ImageLoss<S>& loss) { cpu::image_loss(loss, at::get_num_threads()); }
};

}  // namespace
}  // namespace binding
}  // namespace dsmoe

TORCH_LIBRARY_IMPL(diff_smoe_rasterization, CPU, m) {
  m.impl("adam", &dsmoe::binding::adam<dsmoe::binding::Cpu>);
  m.impl("image_loss", &dsmoe::binding::image_loss<dsmoe::binding::Cpu>);
}
