// dsmoe::core: one Gaussian on the CPU, without torch: its image, gradients, and a step of Adam.
#include <dsmoe/rasterize.h>
#include <dsmoe/training/adam.h>

#include <cstdio>
#include <vector>

int main() {
  constexpr int kSize = 64;
  const float mean[] = {0, 0, 2}, opacity[] = {0.8f}, scale[] = {0.1f, 0.1f, 0.1f}, rotation[] = {1, 0, 0, 0};
  const float background[] = {0, 0, 0}, gate = 0.03f;
  std::vector<float> image(3 * kSize * kSize), gate_sum(kSize * kSize), dL_dimage(image.size(), 1);
  int radius = 0;
  float color[] = {0.9f, 0.5f, 0.1f}, dL_dcolor[3], moment[3] = {}, square[3] = {};
  float dL_dbackground[4];  // by its colour, then by its gate

  dsmoe::Pinhole pinhole;  // at the origin, along z, with 90 degrees
  pinhole.width = pinhole.height = kSize;
  pinhole.fx = pinhole.fy = pinhole.cx = pinhole.cy = kSize / 2;
  pinhole.rotation = {1, 0, 0, 0, 1, 0, 0, 0, 1};

  dsmoe::cpu::Frame<float> frame;
  frame.inputs.num_gaussians = 1;
  frame.inputs.means3D = mean, frame.inputs.opacities = opacity, frame.inputs.colors_precomp = color;
  frame.inputs.scales = scale, frame.inputs.rotations = rotation;
  frame.camera = dsmoe::pinhole_camera<float>(pinhole);
  frame.config.blend.mode = dsmoe::blend_mode_of("smoe").value();
  frame.config.background = background, frame.config.blend.background_gate_at = &gate;
  frame.images.color = image.data(), frame.images.gate_sum = gate_sum.data(), frame.images.radii = &radius;

  dsmoe::cpu::Heap heap;             // or an Allocator of your own
  dsmoe::cpu::forward(frame, heap);  // the images, and what the backward pass needs
  dsmoe::cpu::Gradients<float> gradients;
  gradients.images.color = dL_dimage.data();
  gradients.inputs.colors_precomp = dL_dcolor, gradients.inputs.background = dL_dbackground;
  dsmoe::cpu::backward(frame, gradients);
  std::printf("radius %d pixels, dL/dcolor %g, dL/dgate %g\n", radius, dL_dcolor[0], dL_dbackground[3]);

  dsmoe::cpu::adam<float>({{color, dL_dcolor, moment, square, 3, 3, dsmoe::adam_rates<float>(0.01, /*step=*/1)}},
                          {dsmoe::adam_constants<float>(), /*visible=*/nullptr}, /*num_threads=*/1);
  std::printf("red %g\n", color[0]);
}
