// Writes a model and reads it back through the installed library.
#include <cstdio>

#include "io/ply.h"

int main() {
  dsmoe::io::GaussianModel model;
  model.count = 1;
  model.means3D = {1, 2, 3};
  model.dc = {0.25f, 0.5f, 0.75f};
  model.opacity_logits = {0.5f};
  model.log_scales = {-1, -2, -3};
  model.rotations = {1, 0, 0, 0};
  model.blend_mode = "smoe";
  const char* path = "consumer_io.ply";
  dsmoe::io::write_gaussians(path, model);
  const dsmoe::io::GaussianModel read = dsmoe::io::read_gaussians(path);
  std::remove(path);
  std::printf("%zu Gaussian, blend mode %s\n", read.count, read.blend_mode.c_str());
  const bool same = read.count == 1 && read.means3D == model.means3D && read.dc == model.dc &&
                    read.log_scales == model.log_scales && read.blend_mode == model.blend_mode;
  return same ? 0 : 1;
}
