// COLMAP sparse models: cameras, posed images and points, binary and text.
// Format: https://colmap.github.io/format.html
#pragma once

#include <array>
#include <cstdint>
#include <string>
#include <string_view>
#include <vector>

#include "io/ply.h"

namespace dsmoe::io {

struct CameraModel {
  int id;
  const char* name;
  int num_params;
  int num_focal_lengths;  // they come first in the parameters; 0 if the model has none
};

/// Returns COLMAP's camera model of that number or name, or null.
const CameraModel* find_camera_model(int id);
const CameraModel* find_camera_model(std::string_view name);

struct ColmapCamera {
  std::uint32_t id = 0;
  const CameraModel* model = nullptr;
  std::uint64_t width = 0;  // pixels
  std::uint64_t height = 0;
  std::vector<double> params;  // finite, in the model's order: PINHOLE has fx, fy, cx, cy in pixels
};

struct ColmapImage {
  std::uint32_t id = 0;
  std::array<double, 4> qvec = {1, 0, 0, 0};  // (w, x, y, z), world to camera; of unit length when read
  std::array<double, 3> tvec = {0, 0, 0};     // world to camera: x_camera = R(qvec) x_world + tvec
  std::uint32_t camera_id = 0;
  std::string name;  // path below the folder of images
};

struct ColmapPoints {
  PointCloud cloud;
  std::vector<double> errors;  // [N] mean reprojection error in pixels
};

/// 2D observations, tracks and point numbers are not kept.
struct ColmapModel {
  std::vector<ColmapCamera> cameras;  // in the file's order, every id once
  std::vector<ColmapImage> images;    // in the file's order, every id once; every camera_id is in cameras
  ColmapPoints points;
};

enum class ColmapFormat { kBinary, kText };

/// Returns the first of folder, folder/sparse/0 and folder/sparse that holds cameras.bin or cameras.txt.
/// Throws FileError naming all three if none does.
std::string find_colmap_folder(const std::string& folder);

/// Reads the three files of exactly this folder; binary if cameras.bin is there, text otherwise.
/// Throws FileError for a missing file, FormatError for a malformed one and for a model without cameras or images.
ColmapModel read_colmap(const std::string& folder);

/// Reads one file of cameras, text if the name ends in ".txt". Throws FileError, FormatError.
std::vector<ColmapCamera> read_colmap_cameras(const std::string& path);

/// The three readers on the bytes of a file, which `file` names in errors. Throw FormatError.
std::vector<ColmapCamera> parse_colmap_cameras(std::string_view bytes, const std::string& file, ColmapFormat format);
std::vector<ColmapImage> parse_colmap_images(std::string_view bytes, const std::string& file, ColmapFormat format);
ColmapPoints parse_colmap_points(std::string_view bytes, const std::string& file, ColmapFormat format);

/// Writes the three files into a folder, which is made if it is missing. Images get no observations, points no
/// tracks, black if the cloud has no colours and COLMAP's -1 if it has no errors. Throws FileError, FormatError.
void write_colmap(const std::string& folder, const ColmapModel& model, ColmapFormat format);

}  // namespace dsmoe::io
