// Trains Gaussians on a COLMAP scene: the recipe of 3DGS, with any blend mode and background gate.
#include <chrono>
#include <cstdio>
#include <filesystem>
#include <random>

#include "dsmoe/blend.h"
#include "gaussians.h"
#include "io/cursor.h"
#include "io/file.h"

namespace {

using Options = std::map<std::string, std::string>;

// A whole number from `least` to `most`; throws if the option is anything else.
uint64_t whole(const Options& options, const std::string& name, uint64_t least, uint64_t most) {
  uint64_t value = 0;
  if (dsmoe::io::parse_whole(options.at(name), value) && value >= least && value <= most) return value;
  throw std::invalid_argument(name + " is " + dsmoe::io::printable(options.at(name)) +
                              "; it must be a whole number from " + std::to_string(least) + " to " +
                              std::to_string(most));
}

void check_mode(const std::string& mode) {
  std::string names;
  bool known = false;
  dsmoe::BlendModes::for_each([&](auto one) {
    const std::string name = dsmoe::Blend<decltype(one)::value>::kName;
    known = known || name == mode;
    names += (names.empty() ? "" : ", ") + name;
  });
  if (known) return;
  throw std::invalid_argument("--blend-mode is " + dsmoe::io::printable(mode) + "; it must be one of " + names);
}

// Makes the folder of the file. Throws if the file cannot be written there.
void prepare_output(const std::filesystem::path& file) {
  std::error_code error;
  std::filesystem::create_directories(file.parent_path(), error);
  const std::string folder = file.parent_path();
  if (error) {
    throw std::invalid_argument(dsmoe::io::printable(folder, folder.size()) + " cannot be made: " + error.message() +
                                "; OUT must be a folder to write in");
  }
  dsmoe::io::OutputFile{file.string()};  // throws if it cannot be written, and leaves nothing
}

// Blend mode, and the background's gate lambda: a number, or learned with the scene as bound + exp(p). As in `dsmoe
// train` it starts at 0.1 without a bound in `smoe`, with the rate 0.03, and at 1 with the bound 0.03 and the rate 0.01
// in `smoe_eq7`.
struct Blend {
  std::string mode;
  bool has_gate;
  double number = 0, bound, start, rate;
  std::vector<dsmoe::AdamParameter> logarithm;  // p, if it is learned

  Blend(const std::string& mode, const std::string& gate, torch::Device device)
      : mode(mode),
        has_gate(mode == "smoe" || mode == "smoe_eq7"),
        bound(mode == "smoe" ? 0 : 0.03),
        start(mode == "smoe" ? 0.1 : 1),
        rate(mode == "smoe" ? 0.03 : 0.01) {
    check_mode(mode);
    if (!has_gate) {
      if (!gate.empty()) throw std::invalid_argument("--background-gate is for --blend-mode smoe and smoe_eq7 only");
      return;
    }
    if (!gate.empty() && gate != "learned") {
      if (dsmoe::io::parse_number(gate, number) && number >= 0 && number <= 1e30) return;
      throw std::invalid_argument("--background-gate is " + dsmoe::io::printable(gate) +
                                  "; it must be learned, or a number from 0 to 1e30");
    }
    logarithm.push_back({torch::full({1}, std::log(start - bound), device).requires_grad_(), rate});
  }

  dsmoe::GaussianRasterizationSettings settings(const View& view) const {
    auto result = view.settings;
    result.blend_mode = mode;
    if (has_gate) result.background_gate = number;
    if (!logarithm.empty()) result.background_gate = bound + logarithm[0].value.exp();
    return result;
  }

  double gate() const { return logarithm.empty() ? number : bound + logarithm[0].value.exp().item<double>(); }
};

// Prints mean PSNR and SSIM over the views, of images as an 8-bit file would hold them.
void evaluate(const std::vector<View>& views, const Gaussians& gaussians, const Blend& blend) {
  const torch::NoGradGuard no_grad;
  double psnr = 0, ssim = 0;
  for (const View& view : views) {
    const auto image = (gaussians.render(blend.settings(view)).color.clamp(0, 1) * 255).round() / 255;
    const auto target = view.image.to(torch::kFloat) / 255;
    psnr -= 10 * std::log10((image - target).square().mean().item<double>()) / views.size();
    ssim += dsmoe::fused_ssim(image, target).item<double>() / views.size();
  }
  std::printf("\ntest PSNR %.2f dB, SSIM %.4f, background gate %.4f\n", psnr, ssim, blend.gate());
}

void show_progress(int iteration, int iterations, double seconds, double loss, int64_t count) {
  const std::string bar(30 * static_cast<int64_t>(iteration) / iterations, '=');
  std::fprintf(stderr, "\r[%-30s] %d/%d, %.1f it/s, loss %.4f, %lld Gaussians  ", bar.c_str(), iteration, iterations,
               iteration / seconds, loss, static_cast<long long>(count));
}

void train(const std::string& folder, const std::string& output, Options options) {
  const auto iterations = static_cast<int>(whole(options, "--iterations", 1, INT32_MAX));
  const auto divisor = static_cast<int>(whole(options, "--divisor", 1, INT32_MAX));
  const uint64_t seed = whole(options, "--seed", 0, UINT64_MAX);
  const auto path = std::filesystem::path(output) / "point_cloud" / ("iteration_" + std::to_string(iterations));
  const std::string file = path / "point_cloud.ply";
  if (std::filesystem::exists(file) && options.count("--overwrite") == 0)
    throw std::invalid_argument(dsmoe::io::printable(file, file.size()) +
                                " is there already; --overwrite replaces it, another OUT keeps it");
  const torch::Device device(options["--device"]);
  torch::manual_seed(seed);
  std::mt19937_64 random(seed);
  Blend blend(options["--blend-mode"], options["--background-gate"], device);
  const Recipe recipe = Recipe::of(iterations);
  const Scene scene = load_scene(folder, options["--images"], divisor, device);
  Gaussians gaussians(scene, recipe);
  prepare_output(file);

  std::vector<const View*> left;  // of an epoch: each view is seen once before any comes again
  const auto begin = std::chrono::steady_clock::now();
  for (int iteration = 1; iteration <= recipe.iterations; ++iteration) {
    if (left.empty()) {
      for (const View& view : scene.train) left.push_back(&view);
      std::shuffle(left.begin(), left.end(), random);
    }
    const View& view = *left.back();
    left.pop_back();
    gaussians.begin_iteration(iteration);
    const auto means2D = torch::zeros({gaussians.count(), 3}, device).requires_grad_();
    const auto rendering = gaussians.render(blend.settings(view), means2D);
    const auto loss = dsmoe::l1_ssim_loss(rendering.color, view.image, recipe.lambda_dssim);
    loss.backward();
    const bool last = iteration == recipe.iterations;  // it changes nothing: no reset may touch what is saved
    if (!last) {
      gaussians.control_density(iteration, means2D.grad(), rendering.radii);
      gaussians.step();
      step_and_forget_gradients(blend.logarithm);
    }
    if (last || iteration % 100 == 0 || (device.is_cpu() && iteration % 10 == 0)) {
      const std::chrono::duration<double> seconds = std::chrono::steady_clock::now() - begin;
      show_progress(iteration, recipe.iterations, seconds.count(), loss.item<double>(), gaussians.count());
    }
  }

  gaussians.save(file, blend.mode, blend.gate());
  evaluate(scene.test, gaussians, blend);
}

}  // namespace

int main(int argc, char** argv) {
  Options options = {{"--blend-mode", "alpha"},
                     {"--background-gate", ""},
                     {"--iterations", "30000"},
                     {"--divisor", "1"},
                     {"--images", "images"},
                     {"--device", "cpu"},
                     {"--seed", "0"}};
  try {
    if (argc < 3) throw std::invalid_argument("usage: train SCENE OUT [--overwrite] [--OPTION VALUE]...");
    for (int i = 3; i < argc; ++i) {
      const std::string name = argv[i];
      const bool is_flag = name == "--overwrite";
      if (!is_flag && options.count(name) == 0) throw std::invalid_argument("there is no option " + name);
      if (!is_flag && ++i == argc) throw std::invalid_argument(name + " needs a value");
      options[name] = argv[i];
    }
    train(argv[1], argv[2], options);
  } catch (const c10::Error& error) {
    std::fprintf(stderr, "%s\n", error.what_without_backtrace());
    return 1;
  } catch (const std::exception& error) {
    std::fprintf(stderr, "%s\n", error.what());
    return 1;
  }
}
