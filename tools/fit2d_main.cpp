// dsmoe_fit2d: a picture as a few kernels, or as thousands.
#include <algorithm>
#include <cmath>
#include <cstdio>
#include <filesystem>
#include <thread>

#include "command_line.h"
#include "errors.h"
#include "gates2d.h"
#include "io/cursor.h"
#include "io/file.h"
#include "picture.h"
#include "progress.h"

namespace dsmoe::tools {
namespace {

namespace fs = std::filesystem;

constexpr char kHelp[] = R"(usage: dsmoe_fit2d (PICTURE | --edge SIZE) -o FOLDER [OPTION...]

Fits Gaussian kernels to a picture by gradient descent, and shows what each of them does.

  PICTURE             any file that OpenCV reads
  --edge SIZE         a made-up picture instead: red above the diagonal, blue below, SIZE pixels a side
  -o FOLDER           for the results; it is made where it is missing
  --overwrite         replace results that are there

Options
  --kernels N         how many. Default: 2
  --shape NAME        equal: round, with one bandwidth for all; round: each with its own; steered: ellipses (default)
  --mixture NAME      gated: each pixel is the experts' mean, weighted by their gates (default);
                      sum: each pixel is the sum of experts times kernels
  --iterations N      Default: 2000
  --rate X            step of the optimizer (Adam). Default: 0.02
  --seed N            of the random beginning. Default: 0
  --width W           makes the picture so many pixels wide first. Default: as it is
  --line X0,Y0,X1,Y1  of the profile, in pixels. Default: across the middle
  --threads N         Default: all processors. The result does not depend on it

Results in FOLDER
  reconstruction.png  the picture as the kernels draw it
  gates.png           up to 16 kernels: the gate of each, side by side, black is 0 and white is 1
  segments.png        the kernel with the largest gate in each pixel, each in a colour of its own
  profile.png, .csv   picture, reconstruction and (up to 16) gates along the line
  kernels.csv         the parameters

The last line on the terminal is the PSNR.

Figure 2 of the paper:   dsmoe_fit2d --edge 128 --kernels 2 --shape equal --rate 0.05 -o figure2
Figure 3:                dsmoe_fit2d --edge 128 --kernels 6 --mixture sum --rate 0.05 -o figure3
Figure 10:               dsmoe_fit2d photo.jpg --width 300 --kernels 2000 --iterations 1000 -o figure10
)";

const std::vector<OptionRule> kOptions = {{"help", 'h', false},
                                          {"output", 'o'},
                                          {"overwrite", 0, false},
                                          {"edge"},
                                          {"kernels"},
                                          {"shape"},
                                          {"mixture"},
                                          {"iterations"},
                                          {"rate"},
                                          {"seed"},
                                          {"width"},
                                          {"line"},
                                          {"threads"}};

constexpr int kMostShown = 16;  // kernels whose gates are drawn one by one

/// Red above the diagonal, blue on it and below.
Picture edge_picture(int size) {
  Picture picture = {size, size, 3, std::vector<float>(3 * static_cast<std::size_t>(size) * size)};
  for (int y = 0; y < size; ++y) {
    for (int x = 0; x < size; ++x) picture.values[(x > y ? 0 : 2) * picture.pixels() + y * size + x] = 1;
  }
  return picture;
}

/// The gates of all kernels, side by side.
Picture draw_gates(const Mixture2d& model) {
  const std::size_t pixels = static_cast<std::size_t>(model.width) * model.height;
  std::vector<Picture> pictures(model.kernels.size(), {model.width, model.height, 3, std::vector<float>(3 * pixels)});
  for (std::size_t pixel = 0; pixel < pixels; ++pixel) {
    const std::vector<double> gates = gates_at(model, pixel % model.width, pixel / model.width);
    for (std::size_t k = 0; k < gates.size(); ++k) {
      for (int c = 0; c < 3; ++c) pictures[k].values[c * pixels + pixel] = static_cast<float>(gates[k]);
    }
  }
  return side_by_side(pictures);
}

/// Curves along a line of pixels.
std::vector<Curve> profile(const Mixture2d& model, const Picture& picture, const Drawing& drawing,
                           const std::vector<double>& line) {
  const int steps = std::max(1, static_cast<int>(std::max(std::abs(line[2] - line[0]), std::abs(line[3] - line[1]))));
  std::vector<Curve> curves;
  const Color colors[3] = {{0.9f, 0, 0}, {0, 0.6f, 0}, {0, 0, 0.9f}};
  const char* names[3] = {"red", "green", "blue"};
  for (int c = 0; c < 3; ++c) {
    const Color pale = {0.6f + 0.4f * colors[c][0], 0.6f + 0.4f * colors[c][1], 0.6f + 0.4f * colors[c][2]};
    curves.push_back({std::string("picture ") + names[c], pale, {}});
    curves.push_back({std::string("fit ") + names[c], colors[c], {}});
  }
  const bool with_gates = model.kernels.size() <= kMostShown;
  for (std::size_t k = 0; with_gates && k < model.kernels.size(); ++k) {
    curves.push_back({"gate " + std::to_string(k), distinct_color(static_cast<int64_t>(k)), {}});
  }
  for (int i = 0; i <= steps; ++i) {
    const double along = double(i) / steps;
    const auto at = [&](double from, double to, int end) {
      return std::clamp(static_cast<int>(std::lround(from + along * (to - from))), 0, end - 1);
    };
    const int x = at(line[0], line[2], picture.width), y = at(line[1], line[3], picture.height);
    const std::size_t pixel = static_cast<std::size_t>(y) * picture.width + x;
    for (int c = 0; c < 3; ++c) {
      curves[2 * c].values.push_back(picture.values[c * picture.pixels() + pixel]);
      curves[2 * c + 1].values.push_back(drawing.color[c * picture.pixels() + pixel]);
    }
    if (!with_gates) continue;
    const std::vector<double> gates = gates_at(model, x, y);
    for (std::size_t k = 0; k < gates.size(); ++k) curves[6 + k].values.push_back(static_cast<float>(gates[k]));
  }
  return curves;
}

void write_profile(const std::string& path, const std::vector<Curve>& curves) {
  io::OutputFile file(path);
  for (std::size_t k = 0; k < curves.size(); ++k) file.write((k == 0 ? "" : ",") + curves[k].name);
  file.write("\n");
  for (std::size_t i = 0; i < curves[0].values.size(); ++i) {
    for (std::size_t k = 0; k < curves.size(); ++k) {
      file.write((k == 0 ? "" : ",") + io::shortest_text(curves[k].values[i]));
    }
    file.write("\n");
  }
  file.commit();
}

void write_kernels(const std::string& path, const std::vector<Kernel>& kernels) {
  io::OutputFile file(path);
  file.write("x,y,log_xx,yx,log_yy,log_weight,red,green,blue\n");
  for (const Kernel& k : kernels) {
    std::string row;
    for (const double value : {k.x, k.y, k.log_xx, k.yx, k.log_yy, k.log_weight, k.red, k.green, k.blue}) {
      row += (row.empty() ? "" : ",") + io::shortest_text(value);
    }
    file.write(row + "\n");
  }
  file.commit();
}

Picture choose_picture(const CommandLine& line) {
  if (line.has("edge") != line.arguments().empty() || line.arguments().size() > 1) {
    throw UsageError("one PICTURE or --edge SIZE is needed");
  }
  if (line.has("edge")) return edge_picture(line.whole("edge", 0, 2, 4096));
  const Picture picture = read_picture(line.arguments()[0]);
  const int width = line.whole("width", picture.width, 1, 16384);
  return width == picture.width ? picture : scaled_to_width(picture, width);
}

constexpr const char* kResults[] = {"reconstruction.png", "segments.png", "gates.png",
                                    "profile.csv",        "profile.png",  "kernels.csv"};

int run(int argc, char** argv) {
  const CommandLine line(argc, argv, kOptions);
  if (line.has("help") || argc == 1) {
    std::fputs(kHelp, stdout);
    return 0;
  }
  const std::string output = line.text("output", "");
  if (output.empty()) throw UsageError("-o FOLDER is needed");
  const auto file = [&](const char* name) { return (fs::path(output) / name).string(); };
  for (const char* name : kResults) line.check_output(file(name), output);
  const Picture picture = choose_picture(line);
  FitOptions options;
  options.kernels = line.whole("kernels", options.kernels, 1, 1000000);
  const std::vector<std::string> shapes = {"equal", "round", "steered"}, mixtures = {"gated", "sum"};
  const auto place = [](const std::vector<std::string>& names, const std::string& name) {
    return std::find(names.begin(), names.end(), name) - names.begin();
  };
  options.shape = static_cast<KernelShape>(place(shapes, line.choice("shape", "steered", shapes)));
  options.mixture = static_cast<Mixture>(place(mixtures, line.choice("mixture", "gated", mixtures)));
  options.iterations = line.whole("iterations", options.iterations, 1, 1000000000);
  options.rate = line.number("rate", options.rate, 1e-9, 10);
  options.seed = static_cast<unsigned>(line.whole("seed", 0, 0, INT32_MAX));
  options.num_threads = line.whole("threads", static_cast<int>(std::thread::hardware_concurrency()), 1, 4096);
  const double middle = picture.height / 2;
  const std::vector<double> profile_line = line.numbers("line", {0, middle, picture.width - 1.0, middle}, 4);

  Fit fit(picture.values, picture.width, picture.height, options);
  {
    Progress progress("fitting", options.iterations);
    for (int i = 1; i <= options.iterations; ++i) {
      char note[32];
      std::snprintf(note, sizeof(note), "%.2f dB", psnr(fit.step()));
      progress.show(i, note);
    }
  }
  const Drawing drawing = draw(fit.model(), options.num_threads);
  double error = 0;
  for (std::size_t i = 0; i < drawing.color.size(); ++i) error += std::pow(drawing.color[i] - picture.values[i], 2);

  fs::create_directories(output);
  write_picture(file("reconstruction.png"), {picture.width, picture.height, 3, drawing.color});
  write_picture(file("segments.png"), label_colors(drawing.greatest, picture.width, picture.height));
  if (options.kernels <= kMostShown) write_picture(file("gates.png"), draw_gates(fit.model()));
  const std::vector<Curve> curves = profile(fit.model(), picture, drawing, profile_line);
  write_profile(file("profile.csv"), curves);
  write_picture(file("profile.png"), plot(curves, -0.25f, 1.25f));
  write_kernels(file("kernels.csv"), fit.model().kernels);
  std::printf("PSNR %.2f dB with %d kernels\n", psnr(error / drawing.color.size()), options.kernels);
  return 0;
}

}  // namespace
}  // namespace dsmoe::tools

int main(int argc, char** argv) {
  return dsmoe::tools::run_tool("dsmoe_fit2d", [&] { return dsmoe::tools::run(argc, argv); });
}
