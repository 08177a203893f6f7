#include "io/ply.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <utility>

#include "dsmoe/sh.h"
#include "io/cursor.h"
#include "io/ply_vertices.h"

namespace dsmoe::io {

namespace {

constexpr std::string_view kBlendModeKey = "blend_mode ";

/// A number that comments record: the word before it, and its name in errors.
struct NumberInComments {
  std::string_view key;
  const char* name;
};
constexpr NumberInComments kBackgroundGate = {"background_gate", "background gate"};
constexpr NumberInComments kFaintBelow = {"faint_below", "faint_below value"};

std::size_t num_rest(int sh_degree) { return static_cast<std::size_t>(sh_coefficients(sh_degree) - 1); }

using Columns = std::vector<const PlyProperty*>;

/// Returns the columns prefix0, prefix1, ...
Columns numbered_columns(const PlyVertices& vertices, const std::string& prefix, std::size_t count) {
  Columns columns;
  for (std::size_t i = 0; i < count; ++i) columns.push_back(&vertices.require(prefix + std::to_string(i)));
  return columns;
}

Columns named_columns(const PlyVertices& vertices, std::initializer_list<const char*> names) {
  Columns columns;
  for (const char* name : names) columns.push_back(&vertices.require(name));
  return columns;
}

int sh_degree_of(const PlyVertices& vertices) {
  std::size_t num_columns = 0;
  for (const PlyProperty& property : vertices.properties()) num_columns += property.name.rfind("f_rest_", 0) == 0;
  for (int degree = 0; degree <= kMaxShDegree; ++degree) {
    if (num_columns == 3 * num_rest(degree)) return degree;
  }
  vertices.fail("element vertex has " + std::to_string(num_columns) +
                " properties f_rest_*; it must have 0, 9, 24 or 45 (SH degree 0 to 3)");
}

/// Returns the blend mode that the comments record, or an empty string. Throws if they record two.
std::string recorded_blend_mode(const std::vector<std::string>& comments, const std::string& file) {
  std::string mode;
  for (const std::string& comment : comments) {
    if (comment.rfind(kBlendModeKey, 0) != 0) continue;
    const std::string found = comment.substr(kBlendModeKey.size());
    if (!mode.empty() && mode != found) {
      throw FormatError(file + ": the comments record two blend modes, " + printable(mode) + " and " +
                        printable(found));
    }
    mode = found;
  }
  return mode;
}

/// Returns the number that the comments record, if any. Throws if they record two, or one that is negative or infinite.
/// lines: the comments' line numbers, for errors; empty if they are not from a file.
std::optional<double> recorded_number(NumberInComments wanted, const std::vector<std::string>& comments,
                                      const std::vector<std::size_t>& lines, const std::string& file) {
  const std::string name = wanted.name;
  std::optional<double> recorded;
  for (std::size_t i = 0; i < comments.size(); ++i) {
    std::string_view text = comments[i];
    if (text.rfind(wanted.key, 0) != 0) continue;
    text.remove_prefix(wanted.key.size());
    const std::size_t begin = text.find_first_not_of(" \t");
    if (begin == 0) continue;  // another word
    text.remove_prefix(std::min(begin, text.size()));
    const std::string where = file + (lines.empty() ? "" : ", line " + std::to_string(lines[i]));
    double found = 0;
    if (!parse_number(text, found) || !(found >= 0 && std::isfinite(found))) {
      throw FormatError(where + ": the comment's " + name + " is " + printable(text) +
                        "; it must be a number, 0 or more and finite");
    }
    if (recorded && *recorded != found) {
      throw FormatError(where + ": the comments record two " + name + "s, " + shortest_text(*recorded) + " and " +
                        shortest_text(found));
    }
    recorded = found;
  }
  return recorded;
}

void check_size(const std::string& path, const char* name, std::size_t size, std::size_t expected) {
  if (size == expected) return;
  throw FormatError(path + ": " + name + " has " + std::to_string(size) + " values; it must have " +
                    std::to_string(expected));
}

template <typename T>
void append_row(std::string& bytes, const std::vector<T>& values, std::size_t row, std::size_t width) {
  for (std::size_t i = 0; i < width; ++i) append_little_endian(bytes, values[row * width + i]);
}

}  // namespace

GaussianModel read_gaussians(const std::string& path) { return parse_gaussians(read_file(path), path); }

GaussianModel parse_gaussians(std::string bytes, const std::string& file) {
  const PlyVertices vertices = PlyVertices::parse(std::move(bytes), file);
  GaussianModel model;
  model.count = vertices.count();
  model.sh_degree = sh_degree_of(vertices);
  model.comments = vertices.comments();
  model.blend_mode = recorded_blend_mode(model.comments, file);
  model.background_gate = recorded_number(kBackgroundGate, model.comments, vertices.comment_lines(), file);
  model.faint_below = recorded_number(kFaintBelow, model.comments, vertices.comment_lines(), file);

  // f_rest is stored channel by channel, the model coefficient by coefficient.
  const std::size_t rest = num_rest(model.sh_degree);
  const Columns stored_rest = numbered_columns(vertices, "f_rest_", 3 * rest);
  Columns rest_columns;
  for (std::size_t k = 0; k < rest; ++k) {
    for (std::size_t channel = 0; channel < 3; ++channel) rest_columns.push_back(stored_rest[channel * rest + k]);
  }

  const std::pair<std::vector<float>*, Columns> parts[] = {
      {&model.means3D, named_columns(vertices, {"x", "y", "z"})},
      {&model.dc, numbered_columns(vertices, "f_dc_", 3)},
      {&model.shs, rest_columns},
      {&model.opacity_logits, named_columns(vertices, {"opacity"})},
      {&model.log_scales, numbered_columns(vertices, "scale_", 3)},
      {&model.rotations, numbered_columns(vertices, "rot_", 4)}};
  for (const auto& [values, columns] : parts) values->reserve(model.count * columns.size());
  for (std::size_t row = 0; row < model.count; ++row) {
    for (const auto& [values, columns] : parts) {
      for (const PlyProperty* column : columns) values->push_back(static_cast<float>(vertices.value(row, *column)));
    }
  }
  return model;
}

void write_gaussians(const std::string& path, const GaussianModel& model) {
  if (model.sh_degree < 0 || model.sh_degree > kMaxShDegree) {
    throw FormatError(path + ": sh_degree is " + std::to_string(model.sh_degree) + "; it must be 0 to 3");
  }
  const std::size_t rest = num_rest(model.sh_degree);
  check_size(path, "means3D", model.means3D.size(), 3 * model.count);
  check_size(path, "dc", model.dc.size(), 3 * model.count);
  check_size(path, "shs", model.shs.size(), 3 * rest * model.count);
  check_size(path, "opacity_logits", model.opacity_logits.size(), model.count);
  check_size(path, "log_scales", model.log_scales.size(), 3 * model.count);
  check_size(path, "rotations", model.rotations.size(), 4 * model.count);

  std::vector<std::string> comments = model.comments;
  const auto record = [&comments](const std::string& line) {
    if (std::find(comments.begin(), comments.end(), line) == comments.end()) comments.push_back(line);
  };
  if (!model.blend_mode.empty()) record(std::string(kBlendModeKey) + model.blend_mode);
  for (const auto& [wanted, number] :
       {std::pair(kBackgroundGate, model.background_gate), std::pair(kFaintBelow, model.faint_below)}) {
    if (number) record(std::string(wanted.key) + " " + shortest_text(*number));
    recorded_number(wanted, comments, {}, path);  // throws if the caller's comments name another one
  }
  recorded_blend_mode(comments, path);

  std::vector<PlyColumn> columns;
  const auto add = [&](const std::string& name) { columns.push_back({name, PlyType::kFloat32}); };
  const auto add_numbered = [&](const std::string& prefix, std::size_t count) {
    for (std::size_t i = 0; i < count; ++i) add(prefix + std::to_string(i));
  };
  for (const char* name : {"x", "y", "z", "nx", "ny", "nz"}) add(name);
  add_numbered("f_dc_", 3);
  add_numbered("f_rest_", 3 * rest);
  add("opacity");
  add_numbered("scale_", 3);
  add_numbered("rot_", 4);

  OutputFile file(path);
  file.write(ply_header(path, model.count, columns, comments));
  constexpr std::array<char, 3 * sizeof(float)> kZeroNormal = {};
  std::string bytes;
  for (std::size_t row = 0; row < model.count; ++row) {
    bytes.clear();
    append_row(bytes, model.means3D, row, 3);
    bytes.append(kZeroNormal.data(), kZeroNormal.size());
    append_row(bytes, model.dc, row, 3);
    for (std::size_t channel = 0; channel < 3; ++channel) {
      for (std::size_t k = 0; k < rest; ++k) append_little_endian(bytes, model.shs[(row * rest + k) * 3 + channel]);
    }
    append_row(bytes, model.opacity_logits, row, 1);
    append_row(bytes, model.log_scales, row, 3);
    append_row(bytes, model.rotations, row, 4);
    file.write(bytes);
  }
  file.commit();
}

PointCloud read_points(const std::string& path) { return parse_points(read_file(path), path); }

PointCloud parse_points(std::string bytes, const std::string& file) {
  const PlyVertices vertices = PlyVertices::parse(std::move(bytes), file);
  const Columns positions = named_columns(vertices, {"x", "y", "z"});
  const Columns colors = vertices.find("red") ? named_columns(vertices, {"red", "green", "blue"}) : Columns();
  const Columns normals = vertices.find("nx") ? named_columns(vertices, {"nx", "ny", "nz"}) : Columns();
  const auto reject = [&](std::size_t row, const PlyProperty* column, double value, const char* required) {
    vertices.fail("vertex " + std::to_string(row) + ": " + column->name + " is " + shortest_text(value) +
                  "; it must be " + required);
  };

  PointCloud points;
  points.count = vertices.count();
  points.comments = vertices.comments();
  points.positions.reserve(points.count * positions.size());
  points.colors.reserve(points.count * colors.size());
  points.normals.reserve(points.count * normals.size());
  for (std::size_t row = 0; row < points.count; ++row) {
    for (const PlyProperty* column : positions) {
      const double value = vertices.value(row, *column);
      if (!std::isfinite(value)) reject(row, column, value, "finite");
      points.positions.push_back(value);
    }
    for (const PlyProperty* column : colors) {
      const double value = vertices.value(row, *column);
      if (!(value >= 0 && value <= 255 && value == std::floor(value))) {
        reject(row, column, value, "a whole number from 0 to 255");
      }
      points.colors.push_back(static_cast<std::uint8_t>(value));
    }
    for (const PlyProperty* column : normals) {
      points.normals.push_back(static_cast<float>(vertices.value(row, *column)));
    }
  }
  return points;
}

void write_points(const std::string& path, const PointCloud& points) {
  check_size(path, "positions", points.positions.size(), 3 * points.count);
  const bool has_colors = !points.colors.empty();
  const bool has_normals = !points.normals.empty();
  if (has_colors) check_size(path, "colors", points.colors.size(), 3 * points.count);
  if (has_normals) check_size(path, "normals", points.normals.size(), 3 * points.count);

  std::vector<PlyColumn> columns;
  for (const char* name : {"x", "y", "z"}) columns.push_back({name, PlyType::kFloat32});
  for (const char* name : {"nx", "ny", "nz"}) {
    if (has_normals) columns.push_back({name, PlyType::kFloat32});
  }
  for (const char* name : {"red", "green", "blue"}) {
    if (has_colors) columns.push_back({name, PlyType::kUint8});
  }

  OutputFile file(path);
  file.write(ply_header(path, points.count, columns, points.comments));
  std::string bytes;
  for (std::size_t row = 0; row < points.count; ++row) {
    bytes.clear();
    for (std::size_t i = 0; i < 3; ++i) append_little_endian(bytes, static_cast<float>(points.positions[row * 3 + i]));
    if (has_normals) append_row(bytes, points.normals, row, 3);
    if (has_colors) append_row(bytes, points.colors, row, 3);
    file.write(bytes);
  }
  file.commit();
}

}  // namespace dsmoe::io
