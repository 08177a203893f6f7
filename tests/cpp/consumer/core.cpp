// Renders and differentiates on the CPU through the installed library.
#include <vector>

#include "dsmoe/rasterize.h"
#include "scene.h"

int main() {
  using namespace scene;
  std::vector<float> color(3 * kPixels), gate_sum(kPixels), dL_dcolor(3 * kPixels);
  float dL_dexpert[3];
  int32_t radius = -1;

  dsmoe::cpu::Frame<float> frame;
  frame.inputs.num_gaussians = 1;
  frame.inputs.means3D = kMean;
  frame.inputs.opacities = kOpacity;
  frame.inputs.scales = kScale;
  frame.inputs.rotations = kRotation;
  frame.inputs.colors_precomp = kExpert;
  frame.camera.width = frame.camera.height = kSize;
  frame.camera.tan_fov_x = frame.camera.tan_fov_y = kTanFov;
  for (int i = 0; i < 16; ++i) frame.camera.view[i] = kView[i], frame.camera.projection[i] = kProjection[i];
  frame.config.blend.mode = dsmoe::BlendMode::kSmoe;
  frame.config.background = kBackground;
  frame.images.color = color.data();
  frame.images.gate_sum = gate_sum.data();
  frame.images.radii = &radius;

  dsmoe::cpu::Heap heap;
  dsmoe::cpu::forward(frame, heap);

  for (int channel = 0; channel < 3; ++channel) dL_dcolor[channel * kPixels + kCentre] = 1;
  dsmoe::cpu::Gradients<float> gradients;
  gradients.images.color = dL_dcolor.data();
  gradients.inputs.colors_precomp = dL_dexpert;
  dsmoe::cpu::backward(frame, gradients);
  return is_right(color.data(), radius, dL_dexpert) ? 0 : 1;
}
