// Views in json files; without nlohmann's library (Debian, Ubuntu: nlohmann-json3-dev) an error that says so.
#include "io/cursor.h"
#include "views.h"

#if DSMOE_WITH_JSON
#include <algorithm>
#include <cmath>
#include <nlohmann/json.hpp>
#include <utility>

namespace dsmoe::tools {
namespace {

using Json = nlohmann::json;
using Vector = std::array<double, 3>;

constexpr double kLargest = 1e9;          // of all numbers, pixels or world units: float32 would overflow
constexpr double kLargestSide = 1 << 20;  // pixels
constexpr double kMaxSkew = 1e-3;         // of a rotation, as far as rounded numbers may leave it

/// A part of the file, and the words that errors name it with.
struct Node {
  const Json& json;
  std::string place;

  [[noreturn]] void fail(const std::string& reason) const { throw io::FormatError(place + ": " + reason); }

  bool has(const char* key) const { return json.is_object() && json.contains(key); }
  Node at(const char* key) const {
    if (!has(key)) fail("`" + std::string(key) + "` is missing");
    return {json.at(key), place + ": `" + key + "`"};
  }

  double number(double least, double most) const {
    const double value = json.is_number() ? json.get<double>() : NAN;
    if (!(value >= least && value <= most)) {
      fail("must be a number from " + io::shortest_text(least) + " to " + io::shortest_text(most) + ", and is " +
           shown());
    }
    return value;
  }
  double number() const { return number(-kLargest, kLargest); }
  double positive() const { return number(1 / kLargest, kLargest); }
  int side() const {
    const double value = number(1, kLargestSide);
    if (value != std::floor(value)) fail("must be a whole number of pixels, and is " + shown());
    return static_cast<int>(value);
  }
  std::string text() const {
    if (!json.is_string()) fail("must be a text, and is " + shown());
    return json.get<std::string>();
  }

  std::vector<double> numbers(std::size_t count) const {
    if (!json.is_array() || json.size() != count) fail("must be a list of " + std::to_string(count) + " numbers");
    return numbers();
  }
  std::vector<double> numbers() const {
    if (!json.is_array()) fail("must be a list of numbers, and is " + shown());
    std::vector<double> values;
    for (const Json& value : json) values.push_back(Node{value, place}.number());
    return values;
  }

  /// Row by row.
  std::vector<double> matrix(std::size_t rows, std::size_t columns) const {
    if (!json.is_array() || json.size() != rows) fail("must be a list of " + std::to_string(rows) + " rows");
    std::vector<double> values;
    for (const Json& row : json) {
      for (const double value : Node{row, place}.numbers(columns)) values.push_back(value);
    }
    return values;
  }

 private:
  std::string shown() const { return io::printable(json.dump(-1, ' ', false, Json::error_handler_t::replace)); }
};

using Rotation = std::array<double, 9>;

/// Throws if the rows are not those of a rotation.
void check_rotation(const Node& node, const Rotation& r) {
  const auto row = [&](int i) { return Vector{r[3 * i], r[3 * i + 1], r[3 * i + 2]}; };
  const auto dot = [](const Vector& a, const Vector& b) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; };
  for (int i = 0; i < 3; ++i) {
    for (int j = 0; j < 3; ++j) {
      if (!(std::abs(dot(row(i), row(j)) - (i == j ? 1 : 0)) <= kMaxSkew)) node.fail("is not a rotation");
    }
  }
  const double determinant =
      r[0] * (r[4] * r[8] - r[5] * r[7]) - r[1] * (r[3] * r[8] - r[5] * r[6]) + r[2] * (r[3] * r[7] - r[4] * r[6]);
  if (determinant < 0) node.fail("mirrors (its determinant is -1); it must be a rotation");
}

/// From the camera's axes in the world (columns of `to_world`) and its position.
void set_pose(View& view, const Rotation& to_world, const Vector& position) {
  for (int row = 0; row < 3; ++row) {
    view.translation[row] = 0;
    for (int column = 0; column < 3; ++column) {
      view.rotation[3 * row + column] = to_world[3 * column + row];
      view.translation[row] -= to_world[3 * column + row] * position[column];
    }
  }
}

/// By the `camera_model` of transforms.json. find, has: for the keys of a frame.
template <class Find, class Has>
void set_distortion(View& view, const std::string& model, const Find& find, const Has& has) {
  const bool is_fisheye = model == "OPENCV_FISHEYE", is_around = model == "EQUIRECTANGULAR";
  const std::vector<std::string> perspectives = {"SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV"};
  if (!is_fisheye && !is_around && std::find(perspectives.begin(), perspectives.end(), model) == perspectives.end()) {
    find("camera_model")
        .fail("must be OPENCV, OPENCV_FISHEYE, EQUIRECTANGULAR or a simpler one, and is " + io::printable(model));
  }
  bool bends = is_fisheye;
  for (const char* key : {"k1", "k2", "p1", "p2", "k3", "k4"}) {
    const double value = has(key) ? find(key).number() : 0;
    const bool is_tangential = key[0] == 'p', is_fourth = key == std::string("k4");
    if (value != 0 && (is_around || (is_fisheye ? is_tangential : is_fourth))) {
      find(key).fail("must be 0 for `camera_model` " + model);
    }
    if (is_fisheye ? !is_tangential : !is_around && !is_fourth) view.distortion.push_back(value);
    bends = bends || value != 0;
  }
  if (is_around) return;
  view.model = is_fisheye ? LensModel::kFisheye : bends ? LensModel::kOpencv : LensModel::kPinhole;
  if (!bends) view.distortion.clear();
}

/// A frame of transforms.json. Its camera axes are OpenGL's: y up, z backward.
View transforms_view(const Node& file, const Node& frame, ImageSize size) {
  const auto has = [&](const char* key) { return frame.has(key) || file.has(key); };
  const auto find = [&](const char* key) { return frame.has(key) ? frame.at(key) : file.at(key); };
  View view;
  view.name = frame.at("file_path").text();
  if (!has("w") && size.width == 0) frame.fail("`w` and `h` are missing; --size WIDTHxHEIGHT says them instead");
  view.width = has("w") ? find("w").side() : size.width;
  view.height = has("w") ? find("h").side() : size.height;
  const std::string model = has("camera_model")                                         ? find("camera_model").text()
                            : file.has("is_fisheye") && file.json["is_fisheye"] == true ? "OPENCV_FISHEYE"
                                                                                        : "OPENCV";
  if (model == "EQUIRECTANGULAR") {
    set_panorama(view);
  } else if (has("fl_x")) {
    view.fx = find("fl_x").positive();
  } else {
    view.fx = view.width / (2 * std::tan(find("camera_angle_x").number(1 / kLargest, 3.1415) / 2));
  }
  if (model != "EQUIRECTANGULAR") {
    view.fy = has("fl_y") ? find("fl_y").positive() : view.fx;
    view.cx = has("cx") ? find("cx").number() : view.width / 2.0;
    view.cy = has("cy") ? find("cy").number() : view.height / 2.0;
  }
  set_distortion(view, model, find, has);

  const Node pose = frame.at("transform_matrix");
  const std::vector<double> m = pose.matrix(4, 4);
  const Rotation to_world = {m[0], -m[1], -m[2], m[4], -m[5], -m[6], m[8], -m[9], -m[10]};
  check_rotation(pose, to_world);
  set_pose(view, to_world, {m[3], m[7], m[11]});
  return view;
}

/// An entry of cameras.json: position and rotation of the camera in the world.
View inria_view(const Node& camera) {
  View view;
  view.name = camera.at("img_name").text();
  view.width = camera.at("width").side(), view.height = camera.at("height").side();
  view.fx = camera.at("fx").positive(), view.fy = camera.at("fy").positive();
  view.cx = camera.has("cx") ? camera.at("cx").number() : view.width / 2.0;
  view.cy = camera.has("cy") ? camera.at("cy").number() : view.height / 2.0;
  if (camera.has("camera_model")) {
    const std::string model = camera.at("camera_model").text();
    const auto found = std::find(std::begin(kLensNames), std::end(kLensNames), model);
    if (found == std::end(kLensNames)) {
      std::string names;
      for (const char* name : kLensNames) names += std::string(names.empty() ? "" : ", ") + name;
      camera.at("camera_model").fail("must be one of " + names + ", and is " + io::printable(model));
    }
    view.model = static_cast<LensModel>(found - std::begin(kLensNames));
  }
  if (camera.has("distortion")) view.distortion = camera.at("distortion").numbers();
  const Node rotation = camera.at("rotation"), position = camera.at("position");
  const std::vector<double> r = rotation.matrix(3, 3);
  Rotation to_world;
  std::copy(r.begin(), r.end(), to_world.begin());
  check_rotation(rotation, to_world);
  const std::vector<double> p = position.numbers(3);
  set_pose(view, to_world, {p[0], p[1], p[2]});
  return view;
}

}  // namespace

std::vector<View> parse_json_views(std::string_view bytes, const std::string& file, ImageSize size) {
  Json json;
  try {
    json = Json::parse(bytes);
  } catch (const Json::parse_error& error) {
    throw io::FormatError(file + ", byte " + std::to_string(error.byte) + ": not valid json: " + error.what());
  } catch (const Json::exception& error) {  // a number that no double is
    throw io::FormatError(file + ": not valid json: " + error.what());
  }
  const Node root = {json, file};
  std::vector<View> views;
  const bool is_list = json.is_array();
  const Node list = is_list ? root : root.at("frames");
  if (!list.json.is_array() || list.json.empty()) list.fail("must be a list of one camera at least");
  for (std::size_t i = 0; i < list.json.size(); ++i) {
    const Node entry = {list.json[i], file + ": " + (is_list ? "camera " : "frame ") + std::to_string(i)};
    if (!entry.json.is_object()) entry.fail("must be an object");
    views.push_back(is_list ? inria_view(entry) : transforms_view(root, entry, size));
    check_lens(views.back(), file);
  }
  return views;
}

}  // namespace dsmoe::tools

#else

namespace dsmoe::tools {

std::vector<View> parse_json_views(std::string_view, const std::string& file, ImageSize) {
  throw io::FormatError(file +
                        ": this build cannot read json: CMake found no nlohmann_json (Debian, Ubuntu: apt-get "
                        "install nlohmann-json3-dev)");
}

}  // namespace dsmoe::tools

#endif
