// Gaussian models and point clouds in PLY files.
#pragma once

#include <cstddef>
#include <cstdint>
#include <optional>
#include <string>
#include <vector>

namespace dsmoe::io {

/// Points of a PLY file or of a COLMAP model, in the file's order; every position is finite.
struct PointCloud {
  std::size_t count = 0;
  std::vector<double> positions;      // [N, 3] world
  std::vector<std::uint8_t> colors;   // [N, 3] red, green, blue; empty if the file has none
  std::vector<float> normals;         // [N, 3]; empty if the file has none
  std::vector<std::string> comments;  // of the PLY header
};

/// A trained model as Inria's 3DGS stores it: raw parameters, before sigmoid, exp and normalisation.
/// Values may be NaN or infinite; the rasterizer culls such Gaussians.
struct GaussianModel {
  std::size_t count = 0;
  int sh_degree = 0;                       // 0 to 3; K = (sh_degree + 1)^2 coefficients per channel
  std::vector<float> means3D;              // [N, 3] world
  std::vector<float> dc;                   // [N, 1, 3] SH coefficient 0
  std::vector<float> shs;                  // [N, K-1, 3] SH coefficients 1 to K-1
  std::vector<float> opacity_logits;       // [N, 1]
  std::vector<float> log_scales;           // [N, 3]
  std::vector<float> rotations;            // [N, 4] (w, x, y, z), not normalised
  std::string blend_mode;                  // what "comment blend_mode NAME" records, or empty
  std::optional<double> background_gate;   // what "comment background_gate VALUE" records, likewise
  std::optional<double> faint_below;       // likewise; a file has it where it is not the blend mode's usual one
  std::vector<std::string> comments = {};  // all comment lines, these included
};

/// Reads a model; columns are found by name, in any order and scalar type, and others are ignored.
/// The degree follows from the number of f_rest columns: 0, 9, 24 or 45. Throws FileError, FormatError.
GaussianModel read_gaussians(const std::string& path);

/// The same from the bytes of a file, which `file` names in errors.
GaussianModel parse_gaussians(std::string bytes, const std::string& file);

/// Writes binary little endian float32 columns in Inria's order, normals zero. Blend mode, background gate and
/// faint_below become comment lines; numbers are read back as the same doubles. Throws FileError; FormatError if a
/// vector has not the size that count and sh_degree ask for, and if the comments record something else.
void write_gaussians(const std::string& path, const GaussianModel& model);

/// Reads x y z and, if present, red green blue (whole numbers 0 to 255) and nx ny nz.
/// Throws FileError; FormatError, also for a position that is NaN or infinite.
PointCloud read_points(const std::string& path);
PointCloud parse_points(std::string bytes, const std::string& file);

/// Writes x y z (float32), nx ny nz (float32) and red green blue (uchar) if the cloud has them.
void write_points(const std::string& path, const PointCloud& points);

}  // namespace dsmoe::io
