#include <pybind11/numpy.h>
#include <pybind11/pybind11.h>
#include <pybind11/stl.h>

#include <array>
#include <cstdint>
#include <memory>
#include <new>
#include <optional>
#include <stdexcept>
#include <string>
#include <tuple>
#include <utility>
#include <vector>

#include "io/colmap.h"
#include "io/cursor.h"
#include "io/file.h"
#include "io/ply.h"
#include "python/python.h"

namespace py = pybind11;

namespace dsmoe {

namespace python {

py::str text(const std::string& utf8) {
  return py::reinterpret_steal<py::str>(
      PyUnicode_DecodeUTF8(utf8.data(), static_cast<Py_ssize_t>(utf8.size()), "backslashreplace"));
}

void translate_exception(std::exception_ptr exception) {
  try {
    std::rethrow_exception(std::move(exception));
  } catch (const py::builtin_exception&) {  // of pybind11 itself, which translates it
    throw;
  } catch (const py::error_already_set&) {
    throw;
  } catch (const io::FileError& error) {
    // Made here, because Python 3.8 does not turn a bare OSError into its subclass (FileNotFoundError ...) by itself.
    const py::object made =
        py::reinterpret_borrow<py::object>(PyExc_OSError)(error.error_number, text(error.reason), text(error.path));
    PyErr_SetObject(py::type::handle_of(made).ptr(), made.ptr());
  } catch (const std::bad_alloc&) {
    PyErr_NoMemory();
  } catch (const std::exception& error) {
    const bool is_value_error = dynamic_cast<const io::FormatError*>(&error) != nullptr ||
                                dynamic_cast<const std::invalid_argument*>(&error) != nullptr;
    PyErr_SetObject(is_value_error ? PyExc_ValueError : PyExc_RuntimeError, text(error.what()).ptr());
  }
}

}  // namespace python

namespace io {

namespace {

using python::text;
using Unlocked = py::gil_scoped_release;  // other threads run Python meanwhile

template <class T> using Array = py::array_t<T, py::array::c_style>;
template <class T> using OptionalArray = std::optional<Array<T>>;

// Paths and names travel as bytes, since a file's name need not be UTF-8; io.py encodes and decodes them.

// Hands a vector over to numpy without a copy.
template <class T> py::array to_numpy(std::vector<T>&& values, const std::vector<int64_t>& shape) {
  auto owned = std::make_unique<std::vector<T>>(std::move(values));
  const T* data = owned->data();
  const py::capsule owner(owned.release(), [](void* vector) { delete static_cast<std::vector<T>*>(vector); });
  return Array<T>(shape, data, owner);
}

template <class T> py::object to_numpy_or_none(std::vector<T>&& values, const std::vector<int64_t>& shape) {
  if (values.empty() && shape[0] != 0) return py::none();
  return to_numpy(std::move(values), shape);
}

template <class T> std::vector<T> to_vector(const Array<T>& array) {
  return std::vector<T>(array.data(), array.data() + array.size());
}

template <class T> std::vector<T> to_vector(const OptionalArray<T>& array) {
  return array ? to_vector(*array) : std::vector<T>();
}

py::tuple to_tuple(const std::vector<std::string>& lines) {
  py::tuple out(lines.size());
  for (size_t i = 0; i < lines.size(); ++i) out[i] = text(lines[i]);
  return out;
}

py::dict read_gaussians_python(const std::string& path) {
  GaussianModel model;
  {
    const Unlocked unlocked;
    model = read_gaussians(path);
  }
  const auto n = static_cast<int64_t>(model.count);
  const int64_t rest = (model.sh_degree + 1) * (model.sh_degree + 1) - 1;
  py::dict result;
  result["means3D"] = to_numpy(std::move(model.means3D), {n, 3});
  result["dc"] = to_numpy(std::move(model.dc), {n, 1, 3});
  result["shs"] = to_numpy(std::move(model.shs), {n, rest, 3});
  result["opacity_logits"] = to_numpy(std::move(model.opacity_logits), {n, 1});
  result["log_scales"] = to_numpy(std::move(model.log_scales), {n, 3});
  result["rotations"] = to_numpy(std::move(model.rotations), {n, 4});
  result["blend_mode"] = model.blend_mode.empty() ? py::object(py::none()) : text(model.blend_mode);
  result["background_gate"] = model.background_gate;
  result["comments"] = to_tuple(model.comments);
  return result;
}

void write_gaussians_python(const std::string& path, int sh_degree, const Array<float>& means3D, const Array<float>& dc,
                            const Array<float>& shs, const Array<float>& opacity_logits, const Array<float>& log_scales,
                            const Array<float>& rotations, const std::string& blend_mode,
                            std::optional<double> background_gate, const std::vector<std::string>& comments) {
  const GaussianModel model{static_cast<size_t>(means3D.shape(0)),
                            sh_degree,
                            to_vector(means3D),
                            to_vector(dc),
                            to_vector(shs),
                            to_vector(opacity_logits),
                            to_vector(log_scales),
                            to_vector(rotations),
                            blend_mode,
                            background_gate,
                            std::nullopt,  // which the comments record
                            comments};
  const Unlocked unlocked;
  write_gaussians(path, model);
}

py::dict to_dict(PointCloud&& cloud) {
  const auto n = static_cast<int64_t>(cloud.count);
  py::dict result;
  result["positions"] = to_numpy(std::move(cloud.positions), {n, 3});
  result["colors"] = to_numpy_or_none(std::move(cloud.colors), {n, 3});
  result["normals"] = to_numpy_or_none(std::move(cloud.normals), {n, 3});
  result["comments"] = to_tuple(cloud.comments);
  return result;
}

py::dict read_points_python(const std::string& path) {
  PointCloud cloud;
  {
    const Unlocked unlocked;
    cloud = read_points(path);
  }
  return to_dict(std::move(cloud));
}

PointCloud to_cloud(const Array<double>& positions, const OptionalArray<uint8_t>& colors) {
  PointCloud cloud;
  cloud.count = static_cast<size_t>(positions.shape(0));
  cloud.positions = to_vector(positions);
  cloud.colors = to_vector(colors);
  return cloud;
}

void write_points_python(const std::string& path, const Array<double>& positions, const OptionalArray<uint8_t>& colors,
                         const OptionalArray<float>& normals, const std::vector<std::string>& comments) {
  PointCloud cloud = to_cloud(positions, colors);
  cloud.normals = to_vector(normals);
  cloud.comments = comments;
  const Unlocked unlocked;
  write_points(path, cloud);
}

// A copy: these are few numbers.
template <class Numbers> py::array to_numpy(const Numbers& values) {
  return to_numpy(std::vector<double>(values.begin(), values.end()), {static_cast<int64_t>(values.size())});
}

py::list to_list(const std::vector<ColmapCamera>& cameras) {
  py::list result;
  for (const ColmapCamera& camera : cameras) {
    result.append(py::make_tuple(camera.id, camera.model->name, camera.width, camera.height, to_numpy(camera.params)));
  }
  return result;
}

py::dict read_colmap_python(const std::string& folder) {
  ColmapModel model;
  {
    const Unlocked unlocked;
    model = read_colmap(folder);
  }
  py::list images;
  for (const ColmapImage& image : model.images) {
    images.append(
        py::make_tuple(image.id, py::bytes(image.name), image.camera_id, to_numpy(image.qvec), to_numpy(image.tvec)));
  }
  const auto n = static_cast<int64_t>(model.points.cloud.count);
  py::dict result;
  result["cameras"] = to_list(model.cameras);
  result["images"] = images;
  result["point_errors"] = to_numpy(std::move(model.points.errors), {n});
  result["points"] = to_dict(std::move(model.points.cloud));
  return result;
}

using CameraTuple = std::tuple<std::uint32_t, std::string, std::uint64_t, std::uint64_t, std::vector<double>>;
using ImageTuple = std::tuple<std::uint32_t, std::string, std::uint32_t, std::array<double, 4>, std::array<double, 3>>;

void write_colmap_python(const std::string& folder, const std::vector<CameraTuple>& cameras,
                         const std::vector<ImageTuple>& images, const Array<double>& positions,
                         const OptionalArray<uint8_t>& colors, const OptionalArray<double>& point_errors,
                         bool as_text) {
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
  const Unlocked unlocked;
  write_colmap(folder, model, as_text ? ColmapFormat::kText : ColmapFormat::kBinary);
}

}  // namespace

void add_to(py::module_ module) {
  module.def("read_gaussians", &read_gaussians_python);
  module.def("write_gaussians", &write_gaussians_python);
  module.def("read_points", &read_points_python);
  module.def("write_points", &write_points_python);
  module.def("find_colmap_folder", [](const std::string& folder) { return py::bytes(find_colmap_folder(folder)); });
  module.def("read_colmap", &read_colmap_python);
  module.def("read_colmap_cameras", [](const std::string& path) { return to_list(read_colmap_cameras(path)); });
  module.def("write_colmap", &write_colmap_python);
}

}  // namespace io

}  // namespace dsmoe
