// From where a scene is seen: views of COLMAP scenes and of json files, and an orbit around a model.
#pragma once

#include <array>
#include <string>
#include <string_view>
#include <vector>

#include "dsmoe/camera.h"
#include "dsmoe/lens.h"
#include "io/colmap.h"

namespace dsmoe::tools {

struct View : Pinhole {
  std::string name;
  LensModel model = LensModel::kPinhole;
  std::vector<double> distortion;  // of a lens, as LensCalibration has it
};

/// The camera that the rasterizer takes. Throws std::invalid_argument for what cannot be a lens.
Camera<float> camera_of(const View& view);

/// Gives a view of that size all directions.
void set_panorama(View& view);

/// Throws FormatError, with the file and the view's name, for what cannot be a lens.
void check_lens(const View& view, const std::string& file);

/// The same view at another image size; intrinsics scale with the axes.
View resized(const View& view, int width, int height);

/// Of images whose file does not say it; 0: not known.
struct ImageSize {
  int width = 0, height = 0;  // pixels
};

/// Reads a COLMAP folder, a transforms.json (NeRF, instant-ngp, Nerfstudio) or a cameras.json (Inria's 3DGS).
/// Throws io::IoError: file, place and reason.
std::vector<View> read_views(const std::string& path, ImageSize size);

/// Throws FormatError for camera models that no lens of the rasterizer is.
std::vector<View> views_of(const io::ColmapModel& model, const std::string& folder);

/// The bytes of a json file, which `file` names in errors: a list is a cameras.json, an object a transforms.json.
/// Throws FormatError, also if neither the file nor `size` says how large the images are.
std::vector<View> parse_json_views(std::string_view bytes, const std::string& file, ImageSize size);

struct Orbit {
  int count = 120;                           // views
  std::array<double, 3> target = {0, 0, 0};  // world
  double distance = 1;                       // world
  double elevation = 20;                     // degrees above the plane
  std::array<double, 3> up = {0, -1, 0};     // world
  double field_of_view = 50;                 // degrees, across
  int width = 1280, height = 720;            // pixels
};

/// Views on a circle around the target. Throws std::invalid_argument if `up` is zero.
std::vector<View> orbit_views(const Orbit& orbit);

}  // namespace dsmoe::tools
