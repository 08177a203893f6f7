// Renders one Gaussian through the installed library: gated blending of a single expert gives its colour, exactly.
#include <cstdio>
#include <vector>

#include "dsmoe/rasterize.h"

int main() {
  const float mean[3] = {0, 0, 2}, opacity[1] = {0.5f}, scale[3] = {0.2f, 0.2f, 0.2f}, rotation[4] = {1, 0, 0, 0};
  const float expert[3] = {0.25f, 0.5f, 0.75f}, background[3] = {0, 0, 0};
  dsmoe::GaussianInputs<float> inputs;
  inputs.num_gaussians = 1;
  inputs.means3D = mean;
  inputs.opacities = opacity;
  inputs.scales = scale;
  inputs.rotations = rotation;
  inputs.colors_precomp = expert;

  constexpr int kSize = 33, kPixels = kSize * kSize;
  dsmoe::Camera<float> camera;
  camera.width = camera.height = kSize;
  camera.tan_fov_x = camera.tan_fov_y = 1;
  for (int i = 0; i < 4; ++i) camera.view[5 * i] = 1;
  camera.projection[0] = camera.projection[5] = camera.projection[10] = camera.projection[11] = 1;

  dsmoe::RasterConfig<float> config;
  config.mode = dsmoe::BlendMode::kSmoe;
  config.background = background;

  dsmoe::ProjectedGaussian<float> projected;
  std::vector<int64_t> instance_offsets(2), tile_offsets(dsmoe::num_tiles(kSize, kSize) + 1);
  std::vector<float> features(3), transmittance(kPixels), gate_sum(kPixels), color(3 * kPixels);
  std::vector<int32_t> last_contributor(kPixels), radii(1);
  dsmoe::SavedForward<float> saved;
  saved.projected = &projected;
  saved.features = features.data();
  saved.instance_offsets = instance_offsets.data();
  saved.tile_offsets = tile_offsets.data();
  saved.final_transmittance = transmittance.data();
  saved.gate_sum = gate_sum.data();
  saved.last_contributor = last_contributor.data();
  dsmoe::ImageOutputs<float> images;
  images.color = color.data();
  images.radii = radii.data();

  std::vector<dsmoe::TileInstance> instances(dsmoe::cpu::project(inputs, camera, config, saved, images));
  saved.instances = instances.data();
  dsmoe::cpu::bin(inputs.num_gaussians, camera, config, saved, images.radii);
  dsmoe::cpu::blend(camera, config, saved, images);

  const int centre = kPixels / 2;
  for (int channel = 0; channel < 3; ++channel) {
    const float centre_color = color[channel * kPixels + centre];
    std::printf("channel %d: centre %g, expert %g\n", channel, centre_color, expert[channel]);
    // One rounding of the product with the weight and one of the quotient: two units in the last place at most.
    if (!(centre_color > expert[channel] * (1 - 2.4e-7f) && centre_color < expert[channel] * (1 + 2.4e-7f))) return 1;
    if (color[channel * kPixels] != 0) return 1;  // the corner lies 13 standard deviations away: background
  }
  return radii[0] > 0 ? 0 : 1;
}
