#include "io/splat.h"

#include <algorithm>
#include <cmath>

#include "dsmoe/sh.h"
#include "io/cursor.h"

namespace dsmoe::io {

namespace {

constexpr std::size_t kRecordBytes = 32;  // 3 float32, 3 float32, 4 bytes, 4 bytes
constexpr double kLevels = 255;

double logit(double x) { return std::log(x / (1 - x)); }

}  // namespace

GaussianModel read_splat(const std::string& path) { return parse_splat(read_file(path), path); }

GaussianModel parse_splat(std::string_view bytes, const std::string& file) {
  if (bytes.size() % kRecordBytes != 0) {
    throw FormatError(file + ": has " + std::to_string(bytes.size()) +
                      " bytes, which is not a multiple of 32 (truncated file, or no .splat?)");
  }
  ByteCursor cursor(bytes, file);
  GaussianModel model;
  model.count = bytes.size() / kRecordBytes;
  model.means3D.reserve(3 * model.count);
  model.log_scales.reserve(3 * model.count);
  model.dc.reserve(3 * model.count);
  model.opacity_logits.reserve(model.count);
  model.rotations.reserve(4 * model.count);
  const auto read_finite = [&](const char* what, float least) {
    const std::size_t offset = cursor.offset();
    const auto value = cursor.read<float>(what);
    if (!std::isfinite(value) || value < least)
      ByteCursor(bytes, file, offset).fail(what, "is " + shortest_text(value));
    return value;
  };
  for (std::size_t i = 0; i < model.count; ++i) {
    for (int k = 0; k < 3; ++k) model.means3D.push_back(read_finite("a position", -INFINITY));
    for (int k = 0; k < 3; ++k) model.log_scales.push_back(std::log(read_finite("a scale", 0)));
    for (int k = 0; k < 3; ++k) {
      const double color = cursor.read<std::uint8_t>("a colour") / kLevels;
      model.dc.push_back(static_cast<float>((color - 0.5) / kSh0));
    }
    const double opacity = cursor.read<std::uint8_t>("an opacity") / kLevels;
    model.opacity_logits.push_back(static_cast<float>(logit(std::clamp(opacity, 0.5 / kLevels, 1 - 0.5 / kLevels))));
    for (int k = 0; k < 4; ++k) {
      model.rotations.push_back(static_cast<float>((cursor.read<std::uint8_t>("a rotation") - 128) / 128.0));
    }
  }
  return model;
}

}  // namespace dsmoe::io
