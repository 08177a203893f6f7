// dsmoe::torch: one Gaussian, rendered and differentiated.
#include <dsmoe/torch.h>

#include <iostream>

int main() {
  const at::Tensor K = at::diag(at::tensor({50.0, 50.0, 1.0})), R = at::eye(3), t = at::zeros(3);
  K[0][2].fill_(32), K[1][2].fill_(32);
  auto settings = dsmoe::settings_from_camera(K, R, t, /*width=*/64, /*height=*/64, /*bg=*/at::zeros(3));
  settings.blend_mode = "smoe";
  settings.background_gate = 0.03;  // or a tensor, which then gets a gradient

  const at::Tensor means3D = at::tensor({0.0f, 0.0f, 2.0f}).view({1, 3}), opacities = at::full({1, 1}, 0.8f);
  dsmoe::RasterizeArguments arguments;
  arguments.colors_precomp = at::tensor({0.9f, 0.5f, 0.1f}).view({1, 3}).requires_grad_();
  arguments.scales = at::full({1, 3}, 0.1f);
  arguments.rotations = at::eye(1, 4);
  arguments.outputs = {"alpha"};
  const dsmoe::Rendering rendering = dsmoe::rasterize(means3D, opacities, settings, arguments);
  rendering.color.sum().backward();
  std::cout << rendering.color.sizes() << rendering.alpha.max() << arguments.colors_precomp.grad() << "\n";
}
