// From a calibrated pinhole camera to the settings of a rendering, as camera.py does it for Python. The matrices are
// those of `pinhole_camera` (camera.h). Here tensors make them, through which gradients reach K, R and t.
#include "dsmoe/camera.h"

#include "check_tensor.h"
#include "dsmoe/torch.h"

namespace dsmoe {

GaussianRasterizationSettings settings_from_camera(const at::Tensor& K, const at::Tensor& R, const at::Tensor& t,
                                                   int64_t width, int64_t height, const at::Tensor& bg,
                                                   int64_t sh_degree, double scale_modifier) {
  const char* function = "settings_from_camera";
  TORCH_CHECK_VALUE(binding::matches(K, {3, 3}) && binding::matches(R, {3, 3}) && binding::matches(t, {3}), function,
                    ": K, R and t have shapes ", K.sizes(), ", ", R.sizes(), " and ", t.sizes(),
                    "; they must be [3, 3], [3, 3] and [3]");
  const at::Tensor intrinsics = K.to(at::kDouble), rotation = R.to(at::kDouble), translation = t.to(at::kDouble);
  const double fx = intrinsics[0][0].item<double>(), fy = intrinsics[1][1].item<double>();
  const at::Tensor pinhole = intrinsics.clone();
  pinhole[0][1].fill_(0), pinhole[1][0].fill_(0), pinhole[2].copy_(at::eye(3, intrinsics.options())[2]);
  TORCH_CHECK_VALUE(fx > 0 && fy > 0 && at::equal(intrinsics, pinhole), function, ": K is ", intrinsics,
                    "; it must be [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] with fx and fy above 0");
  const at::Tensor identity = at::eye(3, rotation.options());
  const double error = (rotation.mm(rotation.t()) - identity).abs().max().item<double>();
  TORCH_CHECK_VALUE(error < 1e-3 && at::det(rotation).item<double>() > 0, function, ": R must be a rotation");

  const at::Tensor last = identity.new_zeros({1, 4});
  last[0][3].fill_(1);
  const at::Tensor view = at::cat({at::cat({rotation, translation.unsqueeze(1)}, 1), last}, 0);
  const at::Tensor size = identity.new_ones({2, 1}), centre = identity.new_zeros({1, 3});
  size[0].fill_(static_cast<double>(width));
  size[1].fill_(static_cast<double>(height));
  centre[0][2].fill_(1);
  const at::Tensor image = 2 * intrinsics.narrow(0, 0, 2) / size - centre;
  const at::Tensor lower = identity.new_zeros({2, 4});
  lower[0][2].fill_(kClipFar / (kClipFar - kClipNear));
  lower[0][3].fill_(-kClipNear * kClipFar / (kClipFar - kClipNear));
  lower[1][2].fill_(1);
  const at::Tensor clip = at::cat({at::cat({image, identity.new_zeros({2, 1})}, 1), lower}, 0);

  const auto place = [&](const at::Tensor& matrix) { return matrix.contiguous().to(bg.device(), bg.scalar_type()); };
  GaussianRasterizationSettings settings;
  settings.image_height = height, settings.image_width = width;
  settings.tanfovx = static_cast<double>(width) / (2 * fx), settings.tanfovy = static_cast<double>(height) / (2 * fy);
  settings.bg = bg;
  settings.scale_modifier = scale_modifier;
  settings.viewmatrix = place(view.t());
  settings.projmatrix = place(clip.mm(view).t());
  settings.sh_degree = sh_degree;
  settings.campos = place(-rotation.t().mv(translation));
  return settings;
}

}  // namespace dsmoe
