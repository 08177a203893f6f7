#include "python/io.h"

#include <array>
#include <cstdint>
#include <optional>
#include <string>
#include <tuple>
#include <utility>
#include <vector>

#include "io/colmap.h"
#include "io/file.h"
#include "io/ply.h"

namespace dsmoe::io {

namespace {

using python::Array;
using python::Dict;
using python::List;
using python::Object;
template <class T> using OptionalArray = std::optional<Array<T>>;

// Paths and names travel as bytes, since a file's name need not be UTF-8; io.py encodes and decodes them.

template <typename T> Object array_or_none(std::vector<T>&& values, const std::vector<int64_t>& shape) {
  if (values.empty() && shape[0] != 0) return python::to_python(std::nullopt);
  return python::array(std::move(values), shape);
}

template <typename T> std::vector<T> or_empty(OptionalArray<T>&& array) {
  return array ? std::move(*array) : std::vector<T>();
}

Object read_gaussians_python(const std::string& path) {
  GaussianModel model;
  {
    const python::Unlocked unlocked;
    model = read_gaussians(path);
  }
  const auto n = static_cast<int64_t>(model.count);
  const int64_t rest = (model.sh_degree + 1) * (model.sh_degree + 1) - 1;
  Dict result;
  result.set("means3D", python::array(std::move(model.means3D), {n, 3}));
  result.set("dc", python::array(std::move(model.dc), {n, 1, 3}));
  result.set("shs", python::array(std::move(model.shs), {n, rest, 3}));
  result.set("opacity_logits", python::array(std::move(model.opacity_logits), {n, 1}));
  result.set("log_scales", python::array(std::move(model.log_scales), {n, 3}));
  result.set("rotations", python::array(std::move(model.rotations), {n, 4}));
  if (model.blend_mode.empty()) {
    result.set("blend_mode", std::nullopt);
  } else {
    result.set("blend_mode", model.blend_mode);
  }
  result.set("background_gate", model.background_gate);
  result.set("comments", python::tuple_of(model.comments));
  return result;
}

void write_gaussians_python(const std::string& path, int64_t sh_degree, Array<float> means3D, Array<float> dc,
                            Array<float> shs, Array<float> opacity_logits, Array<float> log_scales,
                            Array<float> rotations, std::string blend_mode, std::optional<double> background_gate,
                            std::vector<std::string> comments) {
  GaussianModel model;
  model.count = means3D.size() / 3;
  model.sh_degree = static_cast<int>(sh_degree);
  model.means3D = std::move(means3D);
  model.dc = std::move(dc);
  model.shs = std::move(shs);
  model.opacity_logits = std::move(opacity_logits);
  model.log_scales = std::move(log_scales);
  model.rotations = std::move(rotations);
  model.blend_mode = std::move(blend_mode);
  model.background_gate = background_gate;
  model.comments = std::move(comments);
  const python::Unlocked unlocked;
  write_gaussians(path, model);
}

Object to_dict(PointCloud&& cloud) {
  const auto n = static_cast<int64_t>(cloud.count);
  Dict result;
  result.set("positions", python::array(std::move(cloud.positions), {n, 3}));
  result.set("colors", array_or_none(std::move(cloud.colors), {n, 3}));
  result.set("normals", array_or_none(std::move(cloud.normals), {n, 3}));
  result.set("comments", python::tuple_of(cloud.comments));
  return result;
}

Object read_points_python(const std::string& path) {
  PointCloud cloud;
  {
    const python::Unlocked unlocked;
    cloud = read_points(path);
  }
  return to_dict(std::move(cloud));
}

PointCloud to_cloud(Array<double>&& positions, OptionalArray<uint8_t>&& colors) {
  PointCloud cloud;
  cloud.count = positions.size() / 3;
  cloud.positions = std::move(positions);
  cloud.colors = or_empty(std::move(colors));
  return cloud;
}

void write_points_python(const std::string& path, Array<double> positions, OptionalArray<uint8_t> colors,
                         OptionalArray<float> normals, std::vector<std::string> comments) {
  PointCloud cloud = to_cloud(std::move(positions), std::move(colors));
  cloud.normals = or_empty(std::move(normals));
  cloud.comments = std::move(comments);
  const python::Unlocked unlocked;
  write_points(path, cloud);
}

// A copy: these are few numbers.
template <class Numbers> Object numbers(const Numbers& values) {
  return python::array(std::vector<double>(values.begin(), values.end()), {static_cast<int64_t>(values.size())});
}

Object to_list(const std::vector<ColmapCamera>& cameras) {
  List result;
  for (const ColmapCamera& camera : cameras) {
    result.append(python::tuple(camera.id, camera.model->name, camera.width, camera.height, numbers(camera.params)));
  }
  return result;
}

Object find_colmap_folder_python(const std::string& folder) { return python::bytes(find_colmap_folder(folder)); }

Object read_colmap_cameras_python(const std::string& path) { return to_list(read_colmap_cameras(path)); }

Object read_colmap_python(const std::string& folder) {
  ColmapModel model;
  {
    const python::Unlocked unlocked;
    model = read_colmap(folder);
  }
  List images;
  for (const ColmapImage& image : model.images) {
    images.append(
        python::tuple(image.id, python::bytes(image.name), image.camera_id, numbers(image.qvec), numbers(image.tvec)));
  }
  const auto n = static_cast<int64_t>(model.points.cloud.count);
  Dict result;
  result.set("cameras", to_list(model.cameras));
  result.set("images", Object(images));
  result.set("point_errors", python::array(std::move(model.points.errors), {n}));
  result.set("points", to_dict(std::move(model.points.cloud)));
  return result;
}

using CameraTuple = std::tuple<std::uint32_t, std::string, std::uint64_t, std::uint64_t, std::vector<double>>;
using ImageTuple = std::tuple<std::uint32_t, std::string, std::uint32_t, std::array<double, 4>, std::array<double, 3>>;

void write_colmap_python(const std::string& folder, const std::vector<CameraTuple>& cameras,
                         const std::vector<ImageTuple>& images, Array<double> positions, OptionalArray<uint8_t> colors,
                         OptionalArray<double> point_errors, bool text) {
  ColmapModel model;
  for (const auto& [id, name, width, height, params] : cameras) {
    const CameraModel* camera_model = find_camera_model(name);
    if (camera_model == nullptr) {
      throw FormatError(folder + ": camera " + std::to_string(id) + " has the unknown camera model " + name);
    }
    model.cameras.push_back({id, camera_model, width, height, params});
  }
  for (const auto& [id, name, camera_id, qvec, tvec] : images)
    model.images.push_back({id, qvec, tvec, camera_id, name});
  model.points.cloud = to_cloud(std::move(positions), std::move(colors));
  model.points.errors = or_empty(std::move(point_errors));
  const python::Unlocked unlocked;
  write_colmap(folder, model, text ? ColmapFormat::kText : ColmapFormat::kBinary);
}

PyMethodDef methods[] = {python::method<&read_gaussians_python>("read_gaussians"),
                         python::method<&write_gaussians_python>("write_gaussians"),
                         python::method<&read_points_python>("read_points"),
                         python::method<&write_points_python>("write_points"),
                         python::method<&find_colmap_folder_python>("find_colmap_folder"),
                         python::method<&read_colmap_python>("read_colmap"),
                         python::method<&read_colmap_cameras_python>("read_colmap_cameras"),
                         python::method<&write_colmap_python>("write_colmap"),
                         {nullptr, nullptr, 0, nullptr}};

PyModuleDef definition = {PyModuleDef_HEAD_INIT, "io", nullptr, -1, methods, nullptr, nullptr, nullptr, nullptr};

}  // namespace

python::Object make_module() { return Object(PyModule_Create(&definition)); }

}  // namespace dsmoe::io
