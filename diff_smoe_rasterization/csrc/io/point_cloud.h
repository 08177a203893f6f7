#pragma once

#include <cstddef>
#include <cstdint>
#include <string>
#include <vector>

namespace dsmoe::io {

/// Points of a PLY file or of a COLMAP model, in the file's order; every position is finite.
struct PointCloud {
  std::size_t count = 0;
  std::vector<double> positions;      // [N, 3] world
  std::vector<std::uint8_t> colors;   // [N, 3] red, green, blue; empty where the file has none
  std::vector<float> normals;         // [N, 3]; empty where the file has none
  std::vector<std::string> comments;  // of the PLY header
};

}  // namespace dsmoe::io
