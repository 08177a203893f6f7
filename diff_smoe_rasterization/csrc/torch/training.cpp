// dsmoe/torch_training.h: the trainers' ops with their gradients for C++.
#include <torch/csrc/autograd/custom_function.h>

#include "call_op.h"
#include "checks.h"
#include "dsmoe/torch_training.h"
#include "dsmoe/training/adam.h"
#include "tensors.h"

namespace dsmoe {
namespace {

using binding::call_op;
using binding::find_op;
using binding::OptionalTensor;
using torch::autograd::AutogradContext;
using torch::autograd::variable_list;

void refuse_second_derivative(const char* function) {
  TORCH_CHECK(!at::GradMode::is_enabled(), function,
              ": second derivatives are not implemented; leave out create_graph");
}

using ActivatedTensors = std::tuple<at::Tensor, at::Tensor, at::Tensor>;

struct Activate : torch::autograd::Function<Activate> {
  static variable_list forward(AutogradContext* context, const at::Tensor& opacities, const at::Tensor& scales,
                               const at::Tensor& rotations) {
    static const c10::OperatorHandle op = find_op("activate");
    const auto [first, second, third] =
        call_op<ActivatedTensors(const at::Tensor&, const at::Tensor&, const at::Tensor&)>(op, opacities, scales,
                                                                                           rotations);
    context->set_materialize_grads(false);
    context->save_for_backward({opacities, scales, rotations, first, second, third});
    return {first, second, third};
  }

  static variable_list backward(AutogradContext* context, variable_list gradients) {
    static const c10::OperatorHandle op = find_op("activate_backward");
    refuse_second_derivative("activate");
    const variable_list saved = context->get_saved_variables();
    const variable_list raw(saved.begin(), saved.begin() + 3), values(saved.begin() + 3, saved.end());
    const auto optional = [](const at::Tensor& tensor) {
      return tensor.defined() ? OptionalTensor(tensor) : OptionalTensor();
    };
    const auto [first, second, third] = call_op<ActivatedTensors(at::TensorList, at::TensorList, const OptionalTensor&,
                                                                 const OptionalTensor&, const OptionalTensor&)>(
        op, at::TensorList(raw), at::TensorList(values), optional(gradients[0]), optional(gradients[1]),
        optional(gradients[2]));
    return {first, second, third};
  }
};

// offset + l1_weight mean |image - target| + ssim_weight mean SSIM; its gradient is computed with the value.
struct ImageLoss : torch::autograd::Function<ImageLoss> {
  static at::Tensor forward(AutogradContext* context, const at::Tensor& image, const at::Tensor& target,
                            double l1_weight, double ssim_weight, double offset, bool with_gradient) {
    static const c10::OperatorHandle op = find_op("image_loss");
    using Signature = std::tuple<at::Tensor, at::Tensor>(const at::Tensor&, const at::Tensor&, double, double, double,
                                                         double, int64_t, bool);
    const auto [loss, gradient] =
        call_op<Signature>(op, image, target, l1_weight, 0.0, ssim_weight, offset, int64_t(0), with_gradient);
    context->save_for_backward({gradient});
    return loss;
  }

  static variable_list backward(AutogradContext* context, variable_list dL_dloss) {
    refuse_second_derivative("the image loss");
    return {context->get_saved_variables()[0] * dL_dloss[0], {}, {}, {}, {}, {}};
  }
};

at::Tensor image_loss(const char* function, const at::Tensor& image, const at::Tensor& target, double l1_weight,
                      double ssim_weight, double offset) {
  const bool differentiated = at::GradMode::is_enabled();
  TORCH_CHECK_VALUE(!differentiated || !target.requires_grad(), function,
                    ": the second image requires a gradient, which only the first gets; detach it");
  return ImageLoss::apply(image, target, l1_weight, ssim_weight, offset, differentiated && image.requires_grad());
}

}  // namespace

Activated activate(const at::Tensor& opacities, const at::Tensor& scales, const at::Tensor& rotations) {
  const variable_list values = Activate::apply(opacities, scales, rotations);
  return {values[0], values[1], values[2]};
}

at::Tensor l1_ssim_loss(const at::Tensor& image, const at::Tensor& target, double lambda_dssim) {
  return image_loss("l1_ssim_loss", image, target, 1 - lambda_dssim, -lambda_dssim, lambda_dssim);
}

at::Tensor fused_ssim(const at::Tensor& img1, const at::Tensor& img2) {
  return image_loss("fused_ssim", img1, img2, 0, 1, 0);
}

void adam_step(std::vector<AdamParameter>& parameters, double epsilon, double beta1, double beta2) {
  static const c10::OperatorHandle op = find_op("adam");
  using Signature = void(at::TensorList, at::TensorList, at::TensorList, at::TensorList, at::ArrayRef<double>,
                         at::ArrayRef<double>, double, double, double, const OptionalTensor&);
  std::vector<at::Tensor> values, gradients, moments, squares;
  std::vector<double> rates, root_scales;
  for (AdamParameter& parameter : parameters) {
    const at::Tensor gradient = parameter.value.grad();
    if (!gradient.defined()) continue;
    for (at::Tensor* moment : {&parameter.moment, &parameter.square}) {
      if (!moment->defined()) *moment = at::zeros(parameter.value.sizes(), gradient.options());
    }
    const auto corrected = adam_rates<double>(parameter.lr, ++parameter.step, beta1, beta2);
    values.push_back(parameter.value.detach());
    gradients.push_back(gradient);
    moments.push_back(parameter.moment);
    squares.push_back(parameter.square);
    rates.push_back(corrected.rate);
    root_scales.push_back(corrected.root_scale);
  }
  if (values.empty()) return;
  call_op<Signature>(op, at::TensorList(values), at::TensorList(gradients), at::TensorList(moments),
                     at::TensorList(squares), at::ArrayRef<double>(rates), at::ArrayRef<double>(root_scales), beta1,
                     beta2, epsilon, OptionalTensor());
}

void add_view(const at::Tensor& dL_dmeans2D, const at::Tensor& radii, const at::Tensor& gradient_sum,
              const at::Tensor& view_count) {
  static const c10::OperatorHandle op = find_op("add_view");
  call_op<void(const at::Tensor&, const at::Tensor&, const at::Tensor&, const at::Tensor&)>(op, dL_dmeans2D, radii,
                                                                                            gradient_sum, view_count);
}

at::Tensor distCUDA2(const at::Tensor& points) {
  static const c10::OperatorHandle op = find_op("mean_squared_neighbour_distances");
  return call_op<at::Tensor(const at::Tensor&)>(op, points.detach());
}

}  // namespace dsmoe
