#include "views.h"

#include <cmath>
#include <filesystem>
#include <map>
#include <optional>
#include <stdexcept>

#include "dsmoe/covariance.h"
#include "io/cursor.h"
#include "io/file.h"

namespace dsmoe::tools {
namespace {

using Vector = std::array<double, 3>;

Vector cross(const Vector& a, const Vector& b) {
  return {a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]};
}

double dot(const Vector& a, const Vector& b) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }

Vector scaled(const Vector& a, double factor) { return {factor * a[0], factor * a[1], factor * a[2]}; }

Vector sum(const Vector& a, const Vector& b) { return {a[0] + b[0], a[1] + b[1], a[2] + b[2]}; }

Vector unit(const Vector& a) { return scaled(a, 1 / std::sqrt(dot(a, a))); }

/// By rows, of a quaternion (w, x, y, z) of unit length.
std::array<double, 9> rotation_matrix(const std::array<double, 4>& q) {
  const auto [x, y, z] = quaternion_to_rotation<double>({q[0], q[1], q[2], q[3]});
  return {x.x, x.y, x.z, y.x, y.y, y.z, z.x, z.y, z.z};
}

/// -R p, for the translation of a camera at p.
Vector translation_of(const std::array<double, 9>& r, const Vector& p) {
  return {-dot({r[0], r[1], r[2]}, p), -dot({r[3], r[4], r[5]}, p), -dot({r[6], r[7], r[8]}, p)};
}

/// The rasterizer's lens of a COLMAP camera; none for the models that it does not have.
std::optional<LensModel> lens_model_of(const io::CameraModel& model) {
  const std::string name = model.name;
  if (name == "SIMPLE_PINHOLE" || name == "PINHOLE") return LensModel::kPinhole;
  if (name == "THIN_PRISM_FISHEYE") return LensModel::kThinPrismFisheye;
  if (name == "EQUIRECTANGULAR") return LensModel::kEquirectangular;
  for (const char* perspective : {"SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV"}) {
    if (name == perspective) return LensModel::kOpencv;
  }
  for (const char* fisheye :
       {"SIMPLE_FISHEYE", "FISHEYE", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE", "OPENCV_FISHEYE"}) {
    if (name == fisheye) return LensModel::kFisheye;
  }
  return std::nullopt;
}

}  // namespace

Camera<float> camera_of(const View& view) {
  Camera<float> camera = pinhole_camera<float>(view);
  LensCalibration lens{view.model, view.width, view.height, view.fx, view.fy, view.cx, view.cy, view.distortion};
  camera.lens = lens_of(lens).as<float>();
  return camera;
}

void set_panorama(View& view) {
  constexpr double kPi = 3.14159265358979323846;
  view.model = LensModel::kEquirectangular;
  view.fx = view.width / (2 * kPi), view.fy = view.height / kPi;
  view.cx = view.width / 2.0, view.cy = view.height / 2.0;
}

void check_lens(const View& view, const std::string& file) {
  try {
    camera_of(view);
  } catch (const std::invalid_argument& error) {
    const std::string reason = error.what();  // behind the name of the function
    throw io::FormatError(file + ": " + io::printable(view.name) + ": " + reason.substr(reason.find(": ") + 2));
  }
}

View resized(const View& view, int width, int height) {
  const double across = double(width) / view.width, down = double(height) / view.height;
  View out = view;
  out.width = width, out.height = height;
  out.fx *= across, out.cx *= across;
  out.fy *= down, out.cy *= down;
  return out;
}

std::vector<View> read_views(const std::string& path, ImageSize size) {
  if (std::filesystem::is_directory(path)) {
    const std::string folder = io::find_colmap_folder(path);
    return views_of(io::read_colmap(folder), folder);
  }
  return parse_json_views(io::read_file(path), path, size);
}

std::vector<View> views_of(const io::ColmapModel& model, const std::string& folder) {
  std::map<std::uint32_t, const io::ColmapCamera*> cameras;
  for (const io::ColmapCamera& camera : model.cameras) {
    if (!lens_model_of(*camera.model)) {
      throw io::FormatError(folder + ": camera " + std::to_string(camera.id) + " has the model " + camera.model->name +
                            ", which cannot be rendered; `colmap image_undistorter` makes a PINHOLE of it");
    }
    cameras[camera.id] = &camera;
  }
  std::vector<View> views;
  for (const io::ColmapImage& image : model.images) {
    const io::ColmapCamera& camera = *cameras.at(image.camera_id);
    View view;
    view.name = image.name;
    view.model = *lens_model_of(*camera.model);
    view.width = static_cast<int>(camera.width), view.height = static_cast<int>(camera.height);
    if (view.model == LensModel::kEquirectangular) {
      set_panorama(view);
    } else {  // one or two focal lengths, cx, cy and the lens's numbers, as the rasterizer takes them
      const auto focal_lengths = static_cast<std::size_t>(camera.model->num_focal_lengths);
      view.fx = camera.params[0], view.fy = camera.params[focal_lengths - 1];
      view.cx = camera.params[focal_lengths], view.cy = camera.params[focal_lengths + 1];
      view.distortion.assign(camera.params.begin() + focal_lengths + 2, camera.params.end());
    }
    view.rotation = rotation_matrix(image.qvec);
    view.translation = image.tvec;
    check_lens(view, folder);
    views.push_back(view);
  }
  return views;
}

std::vector<View> orbit_views(const Orbit& orbit) {
  constexpr double kPi = 3.14159265358979323846;
  if (!(dot(orbit.up, orbit.up) > 0)) throw std::invalid_argument("the up direction of an orbit must not be zero");
  // The plane of the circle: any two directions across `up`.
  const Vector up = unit(orbit.up);
  const Vector helper = std::abs(up[2]) < 0.9 ? Vector{0, 0, 1} : Vector{1, 0, 0};
  const Vector ahead = unit(cross(cross(up, helper), up)), aside = cross(up, ahead);
  const double elevation = orbit.elevation * kPi / 180;

  std::vector<View> views;
  for (int i = 0; i < orbit.count; ++i) {
    const double angle = 2 * kPi * i / orbit.count;
    const Vector around = sum(scaled(ahead, -std::cos(angle)), scaled(aside, std::sin(angle)));
    const Vector outward = sum(scaled(around, std::cos(elevation)), scaled(up, std::sin(elevation)));
    const Vector z = scaled(outward, -1), x = unit(cross(z, up)), y = cross(z, x);
    View view;
    view.name = "orbit_" + std::to_string(i);
    view.width = orbit.width, view.height = orbit.height;
    view.fx = view.fy = orbit.width / (2 * std::tan(orbit.field_of_view * kPi / 360));
    view.cx = orbit.width / 2.0, view.cy = orbit.height / 2.0;
    view.rotation = {x[0], x[1], x[2], y[0], y[1], y[2], z[0], z[1], z[2]};
    view.translation = translation_of(view.rotation, sum(orbit.target, scaled(outward, orbit.distance)));
    views.push_back(view);
  }
  return views;
}

}  // namespace dsmoe::tools
