// The op of the image loss.
#pragma once

#include <climits>
#include <tuple>
#include <vector>

#include "dsmoe/training/image_loss.h"
#include "torch/op.h"

namespace dsmoe {
namespace binding {

template <class Backend, class S> int64_t num_image_loss_sums(const ImageLoss<S>& loss) {
  if constexpr (Backend::kOnHost) {
    return cpu::num_image_loss_sums(loss.planes, loss.height, loss.width);
  } else {
    return cuda::num_image_loss_sums<S>(loss.planes, loss.height, loss.width);
  }
}

// The loss and, if it is wanted, its gradient by the image; an empty tensor otherwise.
template <class Backend>
std::tuple<Tensor, Tensor> image_loss(const Tensor& image, const Tensor& target, double l1_weight, double l2_weight,
                                      double ssim_weight, double offset, int64_t margin, bool with_gradient) {
  const char* function = "image_loss";
  const Expect expect(function, "image", image);
  expect("image", image, shape_of(image.sizes()));
  DSMOE_CHECK_VALUE(image.dim() >= 2 && image.numel() > 0, function, ": image has shape ", image.sizes(),
                    "; it must be [..., H, W] with at least one pixel");
  const int64_t height = image.size(image.dim() - 2), width = image.size(image.dim() - 1);
  DSMOE_CHECK_VALUE(height <= INT_MAX && width <= INT_MAX, function, ": image has shape ", image.sizes(),
                    "; its sides may have ", INT_MAX, " pixels");
  DSMOE_CHECK_VALUE(0 <= margin && margin <= INT_MAX, function, ": margin is ", margin, "; it must be 0 to ", INT_MAX);
  DSMOE_CHECK_VALUE(height > 2 * margin && width > 2 * margin, function, ": image has shape ", image.sizes(),
                    "; with a margin of ", margin, " its sides must be at least ", 2 * margin + 1);
  const bool bytes = target.defined() && target.scalar_type() == kByte;
  expect("target", target, shape_of(image.sizes()), bytes ? kByte : kAsLike);
  const DeviceGuard guard(image.device());
  const Tensor x = image.contiguous(), y = target.contiguous();
  const int64_t planes = x.numel() / (height * width);
  const Tensor loss = empty(std::vector<int64_t>(), x);
  const Tensor gradient = with_gradient ? empty_like(x) : empty({0}, x);
  const Tensor derivatives = empty({with_gradient ? 3 * x.numel() : 0}, x);
  dispatch_real(x, [&](auto zero) {
    using scalar_t = decltype(zero);
    ImageLoss<scalar_t> arguments = {};
    arguments.image = x.data_ptr<scalar_t>();
    arguments.target = bytes ? nullptr : y.data_ptr<scalar_t>();
    arguments.target_bytes = bytes ? y.data_ptr<uint8_t>() : nullptr;
    arguments.planes = planes;
    arguments.height = static_cast<int>(height), arguments.width = static_cast<int>(width);
    arguments.margin = static_cast<int>(margin);
    arguments.l1_weight = l1_weight, arguments.l2_weight = l2_weight;
    arguments.ssim_weight = ssim_weight, arguments.offset = offset;
    const Tensor sums = empty({num_image_loss_sums<Backend>(arguments)}, x, kDouble);
    arguments.sums = sums.data_ptr<double>();
    arguments.loss = loss.data_ptr<scalar_t>();
    arguments.gradient = with_gradient ? gradient.data_ptr<scalar_t>() : nullptr;
    arguments.derivatives = with_gradient ? derivatives.data_ptr<scalar_t>() : nullptr;
    DSMOE_ON(Backend, image_loss, arguments);
  });
  return {loss, gradient};
}

template <class Backend, class Ops> void image_loss_ops(Ops& ops) {
  // offset + l1_weight mean |image - target| + l2_weight mean (image - target)^2 + ssim_weight mean SSIM, where the
  // mean of SSIM leaves out `margin` pixels at each side; gradient by image, or empty. image [..., H, W]; target alike,
  // or bytes.
  ops.template add<&image_loss<Backend>>(
      "image_loss(Tensor image, Tensor target, float l1_weight, float l2_weight, float ssim_weight, float offset, "
      "int margin, bool with_gradient) -> (Tensor loss, Tensor gradient)");
}

}  // namespace binding
}  // namespace dsmoe
