// dsmoe_render: a trained model to pictures or a video.
#include <algorithm>
#include <cmath>
#include <cstdio>
#include <filesystem>
#include <map>
#include <optional>
#include <set>
#include <thread>

#include "command_line.h"
#include "errors.h"
#include "io/cursor.h"
#include "model.h"
#include "picture.h"
#include "progress.h"
#include "renderer.h"
#include "views.h"

namespace dsmoe::tools {
namespace {

namespace fs = std::filesystem;

constexpr char kHelp[] = R"(usage: dsmoe_render MODEL (--cameras PATH | --orbit) -o OUTPUT [OPTION...]

Draws a trained Gaussian model.

  MODEL               a .ply of 3DGS (Inria's layout), or a .splat

Where it is seen from: one of
  --cameras PATH      a COLMAP folder (or a scene folder with sparse/0 in it), a transforms.json, or the
                      cameras.json that 3DGS writes
  --orbit             a circle around the model; the options below change it

Where the result goes: the end of the name says what it becomes
  -o video.mp4        a frame for each camera
  -o picture.png      one camera, 8 bits a channel
  -o picture.exr      one camera, numbers as they are (float32)
  -o folder/          a file for each camera, named after its image; --format png (the default) or exr
  --overwrite         replace such files where they are there

What is drawn: --show
  color               what the model looks like (the default)
  alpha               how much of each pixel the Gaussians cover, 0 to 1 (the gate sum)
  depth               the expected distance along the view axis, in units of the scene
  gates               the Gaussian with the largest gate in each pixel, each in a colour of its own
  count               how many Gaussians each pixel blends
In PNG and MP4 depth and count become colours from blue (least) to red (most); the span is that of the first
picture, and is printed. In EXR they are numbers, and gates the Gaussian's number, -1 where there is none.

Further options
  --view NAME|NUMBER  only this camera: its image name, or its place in the list or on the orbit, from 0
  --size WxH          of the pictures in pixels; only W keeps the shape. Default: as the cameras say; orbit 1280x720
  --blend NAME        alpha, smoe, smoe_eq7, smoe_tn or smoe_std. Default: as the model was trained, if its file says so
  --background-gate X of smoe and smoe_eq7. Default: that of the .ply, else 0
  --background R,G,B  colour behind the Gaussians, 0 to 1. Default: 0,0,0
  --antialiasing      for models that were trained with it
  --device NAME       cpu or cuda. Default: cuda where this build has it, else cpu, as for panoramas
  --threads N         on the CPU. Default: all processors
  --fps X             frames a second of a video. Default: 30

Orbit
  --frames N          pictures. Default: 120
  --target X,Y,Z      its centre. Default: the median of the Gaussians
  --distance X        from the target. Default: 3 times the median distance of a Gaussian from it
  --elevation X       degrees above the target. Default: 20
  --up X,Y,Z          which way is up. Default: 0,-1,0, as in COLMAP scenes
  --fov X             angle of view across, in degrees. Default: 50

Example: dsmoe_render point_cloud.ply --orbit -o orbit.mp4
)";

const std::vector<OptionRule> kOptions = {{"help", 'h', false},
                                          {"output", 'o'},
                                          {"overwrite", 0, false},
                                          {"cameras"},
                                          {"orbit", 0, false},
                                          {"show"},
                                          {"format"},
                                          {"view"},
                                          {"size"},
                                          {"blend"},
                                          {"background-gate"},
                                          {"background"},
                                          {"antialiasing", 0, false},
                                          {"device"},
                                          {"threads"},
                                          {"fps"},
                                          {"frames"},
                                          {"target"},
                                          {"distance"},
                                          {"elevation"},
                                          {"up"},
                                          {"fov"}};

constexpr int kLargestSide = 16384;  // pixels of a picture; a typing error is not to take all memory

/// "W" or "WxH"; zeros if it is absent, a height of 0 if it is not said.
ImageSize read_size(const CommandLine& line) {
  if (!line.has("size")) return {};
  ImageSize size;
  char behind = 0;
  const std::string text = line.text("size", "");
  const int found = std::sscanf(text.c_str(), "%dx%d%c", &size.width, &size.height, &behind);
  const bool with_height = text.find('x') != std::string::npos;
  if (found != (with_height ? 2 : 1) || std::sscanf(text.c_str(), with_height ? "%*dx%*d%c" : "%*d%c", &behind) == 1 ||
      size.width < 1 || (with_height && size.height < 1)) {
    throw UsageError("--size is \"" + text + "\"; it must be like 1280x720 or 1280");
  }
  if (size.width > kLargestSide || size.height > kLargestSide) {
    throw UsageError("--size is \"" + text + "\"; it must be at most " + std::to_string(kLargestSide) +
                     " pixels a side");
  }
  return size;
}

std::array<double, 3> vector_option(const CommandLine& line, const char* name, const std::array<double, 3>& missing) {
  const std::vector<double> v = line.numbers(name, {missing.begin(), missing.end()}, 3);
  return {v[0], v[1], v[2]};
}

Orbit read_orbit(const CommandLine& line, const Extent& extent, ImageSize size) {
  Orbit orbit;
  orbit.count = line.whole("frames", orbit.count, 1, 1000000);
  orbit.target = vector_option(line, "target", extent.centre);
  orbit.distance = line.number("distance", 3 * extent.radius, 1e-9, 1e9);
  orbit.elevation = line.number("elevation", orbit.elevation, -89.9, 89.9);
  orbit.up = vector_option(line, "up", orbit.up);
  orbit.field_of_view = line.number("fov", orbit.field_of_view, 1, 170);
  if (size.width > 0) orbit.width = size.width;
  orbit.height = size.height > 0 ? size.height : std::max(1, orbit.width * 9 / 16);
  return orbit;
}

[[noreturn]] void throw_no_view(const std::string& wanted, const std::vector<View>& views) {
  constexpr std::size_t kShown = 3;
  std::string names;
  for (std::size_t i = 0; i < std::min(kShown, views.size()); ++i) {
    names += (i == 0 ? "" : ", ") + io::printable(views[i].name, views[i].name.size());
  }
  throw UsageError("--view is " + io::printable(wanted) +
                   ", and there is no such view; it must be a number from 0 to " + std::to_string(views.size() - 1) +
                   ", or a name: " + names + (views.size() > kShown ? ", ..." : ""));
}

/// The views that the command line asks for, of their final size.
std::vector<View> choose_views(const CommandLine& line, const Model& model) {
  const ImageSize size = read_size(line);
  if (line.has("cameras") == line.has("orbit")) throw UsageError("one of --cameras and --orbit is needed");
  const bool orbit = line.has("orbit");
  std::vector<View> views = orbit ? orbit_views(read_orbit(line, extent_of(model), size))
                                  : read_views(line.text("cameras", ""), size.height > 0 ? size : ImageSize{});
  if (line.has("view")) {
    const std::string wanted = line.text("view", "");
    auto found = std::find_if(views.begin(), views.end(), [&](const View& view) { return view.name == wanted; });
    if (found == views.end()) {
      if (double number = 0; !io::parse_number(wanted, number)) throw_no_view(wanted, views);
      found = views.begin() + line.whole("view", 0, 0, static_cast<int>(views.size()) - 1);
    }
    views = {*found};
  }
  if (orbit) return views;  // they have their size
  for (View& view : views) {
    const int width = size.width > 0 ? size.width : view.width;
    const double shape = double(view.height) / view.width;
    const double height = size.height > 0 ? size.height : size.width > 0 ? std::round(width * shape) : view.height;
    if (width > kLargestSide || height > kLargestSide) {
      throw UsageError("camera " + view.name + " has " + std::to_string(view.width) + "x" +
                       std::to_string(view.height) + " pixels; pass a --size of at most " +
                       std::to_string(kLargestSide) + " pixels a side");
    }
    view = resized(view, width, std::max(1, static_cast<int>(height)));
  }
  return views;
}

/// What is drawn of a view.
enum class Show { kColor, kAlpha, kDepth, kGates, kCount };
const std::vector<std::string> kShowNames = {"color", "alpha", "depth", "gates", "count"};

/// Makes pictures of what a view shows. Colours of numbers span those of the first picture that has a Gaussian.
class Painter {
 public:
  Painter(Show show, bool numbers) : show_(show), numbers_(numbers) {}

  Picture operator()(const Images& images) {
    if (show_ == Show::kColor) return {images.width, images.height, 3, images.color};
    if (show_ == Show::kGates && !numbers_) return label_colors(images.gaussians, images.width, images.height);
    Picture picture = {images.width, images.height, 1, {}};
    switch (show_) {
      case Show::kAlpha:
        picture.values = images.alpha;
        break;
      case Show::kDepth:
        picture.values = images.depth;
        break;
      case Show::kGates:
        picture.values.assign(images.gaussians.begin(), images.gaussians.end());
        break;
      default:
        picture.values.assign(images.counts.begin(), images.counts.end());
    }
    return numbers_ || show_ == Show::kAlpha ? picture : in_colors(picture, images.alpha);
  }

 private:
  /// Pixels without a Gaussian are black, and do not count for the span.
  Picture in_colors(const Picture& numbers, const std::vector<float>& alpha) {
    if (!span_) find_span(numbers.values, alpha);
    const auto [low, high] = span_.value_or(std::pair(0.0f, 1.0f));
    Picture colors = heat_map(numbers, low, high);
    for (std::size_t i = 0; i < alpha.size(); ++i) {
      for (int c = 0; c < 3 && !(alpha[i] > 0); ++c) colors.values[c * alpha.size() + i] = 0;
    }
    return colors;
  }

  /// Stays empty if the picture is.
  void find_span(const std::vector<float>& numbers, const std::vector<float>& alpha) {
    for (std::size_t i = 0; i < alpha.size(); ++i) {
      if (!(alpha[i] > 0)) continue;
      if (!span_) span_ = {numbers[i], numbers[i]};
      span_ = {std::min(span_->first, numbers[i]), std::max(span_->second, numbers[i])};
    }
    if (!span_) return;
    std::printf("%s: blue is %g, red is %g\n", kShowNames[static_cast<std::size_t>(show_)].c_str(), span_->first,
                span_->second);
  }

  Show show_;
  bool numbers_;  // the file keeps numbers; no colours for them
  std::optional<std::pair<float, float>> span_;
};

/// Where the picture of a name goes in `folder`; folders of the name are made.
fs::path picture_path(const fs::path& folder, const std::string& name, const std::string& format) {
  // No part of a name in a file may lead out of the folder.
  fs::path path = folder;
  for (const fs::path& part : fs::path(name).relative_path()) {
    if (part != ".." && part != ".") path /= part;
  }
  if (path == folder) path /= "view";
  return path.replace_extension("." + format);
}

/// The path of each view's picture. Equal ones get a number: a cameras.json of 3DGS names images by their first word,
/// without folders.
std::vector<std::string> picture_paths(const fs::path& folder, const std::vector<View>& views,
                                       const std::string& format) {
  std::vector<std::string> paths;
  std::set<std::string> taken;
  std::map<std::string, int> counts;
  for (const View& view : views) {
    const fs::path first = picture_path(folder, view.name, format);
    fs::path path = first;
    for (int& count = counts[first.string()]; !taken.insert(path.string()).second;) {
      count = std::max(count, 1) + 1;
      path = first.parent_path() / (first.stem().string() + "_" + std::to_string(count) + "." + format);
    }
    paths.push_back(path.string());
  }
  return paths;
}

std::unique_ptr<Renderer> make_renderer(const CommandLine& line, const Model& model, const std::vector<View>& views,
                                        RenderOptions options) {
  const std::vector<double> background = line.numbers("background", {0, 0, 0}, 3);
  for (int c = 0; c < 3; ++c) options.background[c] = static_cast<float>(background[c]);
  options.antialiasing = line.has("antialiasing");
  const int processors = static_cast<int>(std::max(1u, std::thread::hardware_concurrency()));
  options.num_threads = line.whole("threads", processors, 1, 4096);
  const bool panorama = std::any_of(views.begin(), views.end(), [](const View& view) {
    return view.model == LensModel::kEquirectangular;  // only the CPU's renderer closes its seam
  });
  const std::string device = line.choice("device", has_cuda_renderer() && !panorama ? "cuda" : "cpu", {"cpu", "cuda"});
  if (panorama && device == "cuda") throw UsageError("--device is \"cuda\"; panoramas are rendered by cpu");
  return device == "cuda" ? make_cuda_renderer(model, options) : make_cpu_renderer(model, options);
}

int run(int argc, char** argv) {
  const CommandLine line(argc, argv, kOptions);
  if (line.has("help") || argc == 1) {
    std::fputs(kHelp, stdout);
    return 0;
  }
  if (line.arguments().size() != 1) throw UsageError("exactly one MODEL is needed");
  const std::string file = line.arguments()[0], output = line.text("output", "");
  if (output.empty()) throw UsageError("-o OUTPUT is needed");
  const std::string extension = fs::path(output).extension().string();
  const bool is_video = extension == ".mp4", is_picture = extension == ".png" || extension == ".exr";
  if (!is_video && !is_picture && !extension.empty()) {
    throw UsageError("-o is \"" + output + "\"; it must end in .mp4, .png or .exr, or name a folder");
  }
  const std::string format = is_picture ? extension.substr(1) : line.choice("format", "png", {"png", "exr"});
  const std::string shown = line.choice("show", "color", kShowNames);
  const auto show = static_cast<Show>(std::find(kShowNames.begin(), kShowNames.end(), shown) - kShowNames.begin());
  const double frames_per_second = line.number("fps", 30, 0.1, 1000);
  std::optional<double> background_gate;
  if (line.has("background-gate")) background_gate = line.number("background-gate", 0, 0, 1e30);
  const std::string blend = line.choice("blend", "", blend_names());

  io::GaussianModel raw = read_model(file);
  RenderOptions options;
  options.blend = choose_blend(raw, file, blend, background_gate);
  options.depth = show == Show::kDepth;
  options.gate_map = show == Show::kGates || show == Show::kCount;
  const Model model = activated(std::move(raw));
  const std::vector<View> views = choose_views(line, model);
  if (is_picture && views.size() != 1) {
    throw UsageError("there are " + std::to_string(views.size()) +
                     " cameras and one picture; --view chooses one, or "
                     "-o names a folder or an .mp4");
  }
  if (is_video || is_picture) line.check_output(output);
  const std::vector<std::string> paths = is_video     ? std::vector<std::string>{}
                                         : is_picture ? std::vector{output}
                                                      : picture_paths(output, views, format);
  for (const std::string& path : paths) {
    if (!is_picture) line.check_output(path, output);
  }
  const std::unique_ptr<Renderer> renderer = make_renderer(line, model, views, options);
  Painter paint(show, format == "exr" && !is_video);
  std::unique_ptr<VideoFile> video;
  if (is_video) video = std::make_unique<VideoFile>(output, views[0].width, views[0].height, frames_per_second);
  Progress progress("rendering", static_cast<int>(views.size()));
  for (std::size_t i = 0; i < views.size(); ++i) {
    const View view = is_video ? resized(views[i], views[0].width, views[0].height) : views[i];
    const Picture picture = paint(renderer->render(view));
    if (is_video) {
      video->write(picture);
    } else {
      if (!is_picture) fs::create_directories(fs::path(paths[i]).parent_path());
      write_picture(paths[i], picture);
    }
    progress.show(static_cast<int>(i) + 1);
  }
  return 0;
}

}  // namespace
}  // namespace dsmoe::tools

int main(int argc, char** argv) {
  return dsmoe::tools::run_tool("dsmoe_render", [&] { return dsmoe::tools::run(argc, argv); });
}
