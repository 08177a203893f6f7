// dsmoe::core and dsmoe::io: render MODEL.ply IMAGE.ppm, in the blend that the file records.
#include <dsmoe/rasterize.h>
#include <dsmoe/training/gaussians.h>
#include <io/ply.h>

#include <algorithm>
#include <cstdio>
#include <exception>
#include <fstream>
#include <vector>

int render(const char* model_path, const char* image_path) {
  const dsmoe::io::GaussianModel model = dsmoe::io::read_gaussians(model_path);
  std::vector<float> opacities(model.count), scales(3 * model.count), rotations(4 * model.count);
  const dsmoe::Activate<float> activate = {
      {model.opacity_logits.data(), model.log_scales.data(), model.rotations.data()},  // as files have them
      {opacities.data(), scales.data(), rotations.data()}};                            // as `forward` takes them
  for (std::size_t i = 0; i < model.count; ++i) activate(i);

  dsmoe::Pinhole pinhole;  // at (0, 0, -4): x right, y down, z forward; a file of cameras has the same numbers
  pinhole.width = 400, pinhole.height = 300;
  pinhole.fx = pinhole.fy = 400, pinhole.cx = 200, pinhole.cy = 150;
  pinhole.rotation = {1, 0, 0, 0, 1, 0, 0, 0, 1};
  pinhole.translation = {0, 0, 4};

  const std::size_t pixels = std::size_t(pinhole.width) * pinhole.height;
  const float background[] = {0, 0, 0};
  std::vector<float> image(3 * pixels), gate_sum(pixels);  // [3, H, W], [H, W]
  std::vector<int> radii(model.count);
  dsmoe::cpu::Frame<float> frame;
  frame.inputs.num_gaussians = model.count;
  frame.inputs.means3D = model.means3D.data(), frame.inputs.opacities = opacities.data();
  frame.inputs.scales = scales.data(), frame.inputs.rotations = rotations.data();
  frame.inputs.dc = model.dc.data(), frame.inputs.shs = model.shs.data();
  frame.inputs.sh_degree = model.sh_degree;
  frame.inputs.num_sh = (model.sh_degree + 1) * (model.sh_degree + 1) - 1;
  frame.camera = dsmoe::pinhole_camera<float>(pinhole);
  // A file of another program records nothing: alpha. value() throws for a mode that there is not.
  frame.config.blend.mode = dsmoe::blend_mode_of(model.blend_mode.empty() ? "alpha" : model.blend_mode).value();
  frame.config.blend.background_gate = float(model.background_gate.value_or(0));
  if (model.faint_below) frame.config.blend.faint_below = float(*model.faint_below);
  frame.config.background = background;
  frame.config.num_threads = 4;
  frame.images.color = image.data(), frame.images.gate_sum = gate_sum.data(), frame.images.radii = radii.data();
  dsmoe::cpu::Heap heap;
  dsmoe::cpu::forward(frame, heap);

  std::ofstream file(image_path, std::ios::binary);
  file << "P6\n" << pinhole.width << " " << pinhole.height << "\n255\n";
  for (std::size_t pixel = 0; pixel < pixels; ++pixel) {
    for (std::size_t channel = 0; channel < 3; ++channel) {
      const float value = std::clamp(image[channel * pixels + pixel], 0.0f, 1.0f);
      file.put(static_cast<char>(static_cast<unsigned char>(value * 255 + 0.5f)));
    }
  }
  return file.good() ? 0 : 1;
}

int main(int count, char** words) {
  if (count != 3) return std::fprintf(stderr, "usage: render MODEL.ply IMAGE.ppm\n"), 2;
  try {
    return render(words[1], words[2]);
  } catch (const std::exception& error) {
    return std::fprintf(stderr, "render: %s\n", error.what()), 1;
  }
}
