// dsmoe::io: a model in Inria's layout, with what it was trained with.
#include <io/ply.h>

#include <iostream>

int main() {
  dsmoe::io::GaussianModel model;
  model.count = 1;
  model.means3D = {1, 2, 3};
  model.dc = {0.25f, 0.5f, 0.75f};
  model.opacity_logits = {0.5f};
  model.log_scales = {-1, -2, -3};
  model.rotations = {1, 0, 0, 0};
  model.blend_mode = "smoe";
  model.background_gate = 0.03;
  dsmoe::io::write_gaussians("model.ply", model);
  const auto read = dsmoe::io::read_gaussians("model.ply");
  std::cout << read.count << " Gaussian, " << read.blend_mode << ", gate " << *read.background_gate << "\n";
}
