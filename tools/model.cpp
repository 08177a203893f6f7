#include "model.h"

#include <algorithm>
#include <cctype>
#include <cmath>
#include <cstdio>
#include <filesystem>
#include <utility>

#include "dsmoe/blend.h"
#include "dsmoe/training/gaussians.h"
#include "errors.h"
#include "io/cursor.h"
#include "io/splat.h"

namespace dsmoe::tools {
namespace {

template <class T> T median(std::vector<T> values) {
  const auto middle = values.begin() + values.size() / 2;
  std::nth_element(values.begin(), middle, values.end());
  return *middle;
}

std::string file_extension(const std::string& path) {
  std::string extension = std::filesystem::path(path).extension().string();
  for (char& c : extension) c = static_cast<char>(std::tolower(static_cast<unsigned char>(c)));
  return extension;
}

io::GaussianModel read_any(const std::string& path) {
  const std::string extension = file_extension(path);
  if (extension == ".splat") return io::read_splat(path);
  if (extension == ".spz") {
    throw UsageError(path + ": .spz is not read, as its library is in no Debian package; convert it to .ply first");
  }
  return io::read_gaussians(path);
}

bool is_finite_row(const std::vector<float>& numbers, std::size_t count, std::size_t row) {
  const std::size_t size = numbers.size() / count;
  const auto begin = numbers.begin() + static_cast<std::ptrdiff_t>(row * size);
  return std::all_of(begin, begin + static_cast<std::ptrdiff_t>(size), [](float x) { return std::isfinite(x); });
}

bool is_finite_gaussian(const io::GaussianModel& model, std::size_t row) {
  for (const auto* numbers :
       {&model.means3D, &model.dc, &model.shs, &model.opacity_logits, &model.log_scales, &model.rotations}) {
    if (!is_finite_row(*numbers, model.count, row)) return false;
  }
  return true;
}

}  // namespace

Model activated(io::GaussianModel raw) {
  Model model;
  model.count = static_cast<int64_t>(raw.count);
  model.sh_degree = raw.sh_degree;
  model.opacities.resize(raw.count);
  model.scales.resize(3 * raw.count);
  model.rotations.resize(4 * raw.count);
  const GaussianParameters<const float> from = {raw.opacity_logits.data(), raw.log_scales.data(), raw.rotations.data()};
  const GaussianParameters<float> to = {model.opacities.data(), model.scales.data(), model.rotations.data()};
  const Activate<float> activate = {from, to};
  for (int64_t i = 0; i < model.count; ++i) activate(i);
  model.means3D = std::move(raw.means3D);
  model.dc = std::move(raw.dc);
  model.shs = std::move(raw.shs);
  return model;
}

io::GaussianModel read_model(const std::string& path) {
  io::GaussianModel model = read_any(path);
  std::size_t row = 0;
  while (row < model.count && !is_finite_gaussian(model, row)) ++row;
  if (model.count > 0 && row == model.count) {
    throw io::FormatError(path + ": each of its " + std::to_string(model.count) +
                          " Gaussians has a number that is NaN or infinite, so none can be shown");
  }
  return model;
}

std::vector<std::string> blend_names() {
  std::vector<std::string> names;
  BlendModes::for_each([&](auto mode) { names.emplace_back(Blend<mode()>::kName); });
  return names;
}

BlendRules<double> choose_blend(const io::GaussianModel& model, const std::string& file, const std::string& mode,
                                std::optional<double> background_gate) {
  std::string record = model.blend_mode;
  if (mode.empty() && record.empty()) {
    std::fprintf(stderr,
                 "note: %s records no blend, so it is alpha, as other 3DGS programs blend; --blend says otherwise\n",
                 file.c_str());
    record = "alpha";
  }
  const std::optional<BlendMode> recorded = blend_mode_of(record);
  const std::optional<BlendMode> chosen = mode.empty() ? recorded : blend_mode_of(mode);
  if (!chosen) {
    throw io::FormatError(file + ": records the blend mode " + io::printable(record) + ", which is none of ours");
  }
  BlendRules<double> choice;
  choice.mode = *chosen;
  if (!record.empty() && chosen != recorded) {
    std::fprintf(stderr, "note: %s was trained with the blend %s; in another one Gaussians show another scene\n",
                 file.c_str(), io::printable(record).c_str());
  }
  if (choice.mode != BlendMode::kSmoe && choice.mode != BlendMode::kSmoeEq7) {
    if (background_gate) throw UsageError("--background-gate is for --blend smoe and smoe_eq7 only");
    return choice;
  }
  if (background_gate && model.background_gate && *background_gate != *model.background_gate) {
    std::fprintf(stderr, "note: %s was trained with the background gate %s; with %s its Gaussians show another scene\n",
                 file.c_str(), io::shortest_text(*model.background_gate).c_str(),
                 io::shortest_text(*background_gate).c_str());
  }
  // A file that records no gate was trained without one.
  choice.background_gate = background_gate.value_or(model.background_gate.value_or(0));
  if (model.faint_below && chosen == recorded) choice.faint_below = *model.faint_below;
  if (choice.mode == BlendMode::kSmoeEq7 && choice.background_gate == 1)
    choice = {};  // the family's member that alpha blending is
  return choice;
}

Extent extent_of(const Model& model) {
  Extent extent = {{0, 0, 0}, 1};
  std::vector<float> coordinates[3];
  for (int64_t i = 0; i < model.count; ++i) {
    const float* mean = &model.means3D[3 * i];
    if (!std::isfinite(mean[0]) || !std::isfinite(mean[1]) || !std::isfinite(mean[2])) continue;
    for (int axis = 0; axis < 3; ++axis) coordinates[axis].push_back(mean[axis]);
  }
  if (coordinates[0].empty()) return extent;
  for (int axis = 0; axis < 3; ++axis) extent.centre[axis] = median(coordinates[axis]);
  std::vector<double> distances;
  for (std::size_t i = 0; i < coordinates[0].size(); ++i) {
    double squared = 0;
    for (int axis = 0; axis < 3; ++axis) squared += std::pow(coordinates[axis][i] - extent.centre[axis], 2);
    distances.push_back(std::sqrt(squared));
  }
  const double radius = median(distances);
  if (radius > 0) extent.radius = radius;
  return extent;
}

}  // namespace dsmoe::tools
