#include "io/python_bindings.h"

#include <pybind11/numpy.h>
#include <pybind11/stl.h>

#include <array>
#include <cstdint>
#include <exception>
#include <memory>
#include <optional>
#include <string>
#include <tuple>
#include <utility>
#include <vector>

#include "io/colmap.h"
#include "io/file.h"
#include "io/ply.h"

namespace dsmoe::io {

namespace py = pybind11;

namespace {

// Paths and names travel as bytes, since a file's name need not be UTF-8; io.py encodes and decodes them.

template <typename T> using InputArray = py::array_t<T, py::array::c_style | py::array::forcecast>;

/// Hands a vector over to numpy without a copy.
template <typename T> py::array_t<T> to_numpy(std::vector<T>&& values, std::vector<py::ssize_t> shape) {
  auto owned = std::make_unique<std::vector<T>>(std::move(values));
  const T* data = owned->data();
  const py::capsule owner(owned.get(), [](void* vector) { delete static_cast<std::vector<T>*>(vector); });
  owned.release();
  return py::array_t<T>(std::move(shape), data, owner);
}

template <typename T> py::object to_numpy_or_none(std::vector<T>&& values, std::vector<py::ssize_t> shape) {
  if (values.empty() && shape[0] != 0) return py::none();
  return to_numpy(std::move(values), std::move(shape));
}

template <typename T> std::vector<T> to_vector(const InputArray<T>& array) {
  return std::vector<T>(array.data(), array.data() + array.size());
}

template <typename T> std::vector<T> to_vector(const std::optional<InputArray<T>>& array) {
  return array ? to_vector(*array) : std::vector<T>();
}

py::str decode_utf8(const std::string& text) {
  PyObject* decoded = PyUnicode_DecodeUTF8(text.data(), static_cast<py::ssize_t>(text.size()), "backslashreplace");
  if (decoded == nullptr) throw py::error_already_set();
  return py::reinterpret_steal<py::str>(decoded);
}

py::tuple decode_comments(const std::vector<std::string>& comments) {
  py::tuple decoded(comments.size());
  for (std::size_t i = 0; i < comments.size(); ++i) decoded[i] = decode_utf8(comments[i]);
  return decoded;
}

void translate_errors(std::exception_ptr pointer) {
  try {
    std::rethrow_exception(pointer);
  } catch (const FileError& error) {
    // Made here, because Python 3.8 does not turn a bare OSError into its subclass (FileNotFoundError ...) by itself.
    const py::object instance = py::reinterpret_borrow<py::object>(PyExc_OSError)(
        error.error_number, decode_utf8(error.reason), decode_utf8(error.path));
    PyErr_SetObject(instance.get_type().ptr(), instance.ptr());
  } catch (const FormatError& error) {
    PyErr_SetObject(PyExc_ValueError, decode_utf8(error.what()).ptr());
  }
}

py::dict read_gaussians_python(const std::string& path) {
  GaussianModel model;
  {
    const py::gil_scoped_release unlocked;
    model = read_gaussians(path);
  }
  const auto n = static_cast<py::ssize_t>(model.count);
  const py::ssize_t rest = (model.sh_degree + 1) * (model.sh_degree + 1) - 1;
  py::dict result;
  result["means3D"] = to_numpy(std::move(model.means3D), {n, 3});
  result["dc"] = to_numpy(std::move(model.dc), {n, 1, 3});
  result["shs"] = to_numpy(std::move(model.shs), {n, rest, 3});
  result["opacity_logits"] = to_numpy(std::move(model.opacity_logits), {n, 1});
  result["log_scales"] = to_numpy(std::move(model.log_scales), {n, 3});
  result["rotations"] = to_numpy(std::move(model.rotations), {n, 4});
  result["blend_mode"] = model.blend_mode.empty() ? py::object(py::none()) : decode_utf8(model.blend_mode);
  result["background_gate"] = model.background_gate;
  result["comments"] = decode_comments(model.comments);
  return result;
}

void write_gaussians_python(const std::string& path, int sh_degree, const InputArray<float>& means3D,
                            const InputArray<float>& dc, const InputArray<float>& shs,
                            const InputArray<float>& opacity_logits, const InputArray<float>& log_scales,
                            const InputArray<float>& rotations, const std::string& blend_mode,
                            std::optional<double> background_gate, const std::vector<std::string>& comments) {
  GaussianModel model;
  model.count = static_cast<std::size_t>(means3D.size() / 3);
  model.sh_degree = sh_degree;
  model.means3D = to_vector(means3D);
  model.dc = to_vector(dc);
  model.shs = to_vector(shs);
  model.opacity_logits = to_vector(opacity_logits);
  model.log_scales = to_vector(log_scales);
  model.rotations = to_vector(rotations);
  model.blend_mode = blend_mode;
  model.background_gate = background_gate;
  model.comments = comments;
  const py::gil_scoped_release unlocked;
  write_gaussians(path, model);
}

py::dict to_dict(PointCloud&& cloud) {
  const auto n = static_cast<py::ssize_t>(cloud.count);
  py::dict result;
  result["positions"] = to_numpy(std::move(cloud.positions), {n, 3});
  result["colors"] = to_numpy_or_none(std::move(cloud.colors), {n, 3});
  result["normals"] = to_numpy_or_none(std::move(cloud.normals), {n, 3});
  result["comments"] = decode_comments(cloud.comments);
  return result;
}

py::dict read_points_python(const std::string& path) {
  PointCloud cloud;
  {
    const py::gil_scoped_release unlocked;
    cloud = read_points(path);
  }
  return to_dict(std::move(cloud));
}

PointCloud to_cloud(const InputArray<double>& positions, const std::optional<InputArray<std::uint8_t>>& colors) {
  PointCloud cloud;
  cloud.count = static_cast<std::size_t>(positions.size() / 3);
  cloud.positions = to_vector(positions);
  cloud.colors = to_vector(colors);
  return cloud;
}

void write_points_python(const std::string& path, const InputArray<double>& positions,
                         const std::optional<InputArray<std::uint8_t>>& colors,
                         const std::optional<InputArray<float>>& normals, const std::vector<std::string>& comments) {
  PointCloud cloud = to_cloud(positions, colors);
  cloud.normals = to_vector(normals);
  cloud.comments = comments;
  const py::gil_scoped_release unlocked;
  write_points(path, cloud);
}

py::list to_list(const std::vector<ColmapCamera>& cameras) {
  py::list result;
  for (const ColmapCamera& camera : cameras) {
    const auto count = static_cast<py::ssize_t>(camera.params.size());
    result.append(py::make_tuple(camera.id, camera.model->name, camera.width, camera.height,
                                 py::array_t<double>(count, camera.params.data())));
  }
  return result;
}

py::list read_colmap_cameras_python(const std::string& path) { return to_list(read_colmap_cameras(path)); }

py::dict read_colmap_python(const std::string& folder) {
  ColmapModel model;
  {
    const py::gil_scoped_release unlocked;
    model = read_colmap(folder);
  }
  py::list images;
  for (const ColmapImage& image : model.images) {
    images.append(py::make_tuple(image.id, py::bytes(image.name), image.camera_id,
                                 py::array_t<double>(py::ssize_t{4}, image.qvec.data()),
                                 py::array_t<double>(py::ssize_t{3}, image.tvec.data())));
  }
  py::dict result;
  result["cameras"] = to_list(model.cameras);
  result["images"] = images;
  const auto n = static_cast<py::ssize_t>(model.points.cloud.count);
  result["point_errors"] = to_numpy(std::move(model.points.errors), {n});
  result["points"] = to_dict(std::move(model.points.cloud));
  return result;
}

using CameraTuple = std::tuple<std::uint32_t, std::string, std::uint64_t, std::uint64_t, std::vector<double>>;
using ImageTuple = std::tuple<std::uint32_t, std::string, std::uint32_t, std::array<double, 4>, std::array<double, 3>>;

void write_colmap_python(const std::string& folder, const std::vector<CameraTuple>& cameras,
                         const std::vector<ImageTuple>& images, const InputArray<double>& positions,
                         const std::optional<InputArray<std::uint8_t>>& colors,
                         const std::optional<InputArray<double>>& point_errors, bool text) {
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
  model.points.cloud = to_cloud(positions, colors);
  model.points.errors = to_vector(point_errors);
  const py::gil_scoped_release unlocked;
  write_colmap(folder, model, text ? ColmapFormat::kText : ColmapFormat::kBinary);
}

}  // namespace

void bind_io(py::module_& module) {
  py::register_local_exception_translator(&translate_errors);
  module.def("read_gaussians", &read_gaussians_python);
  module.def("write_gaussians", &write_gaussians_python);
  module.def("read_points", &read_points_python);
  module.def("write_points", &write_points_python);
  module.def("find_colmap_folder", [](const std::string& folder) { return py::bytes(find_colmap_folder(folder)); });
  module.def("read_colmap", &read_colmap_python);
  module.def("read_colmap_cameras", &read_colmap_cameras_python);
  module.def("write_colmap", &write_colmap_python);
}

}  // namespace dsmoe::io
