// Every reader of files, by name: what libFuzzer feeds, and what reads the kept corpus in the tests.
#pragma once

#include <string>
#include <vector>

#include "io/colmap.h"
#include "io/file.h"
#include "io/ply.h"
#include "io/splat.h"
#include "views.h"

namespace dsmoe::tools {

struct Reader {
  const char* name;                        // also the folder of its corpus
  void (*read)(const std::string& bytes);  // throws io::FormatError, and nothing else
};

inline const std::vector<Reader>& readers() {
  using namespace io;
  constexpr ColmapFormat kBinary = ColmapFormat::kBinary, kText = ColmapFormat::kText;
  static const std::vector<Reader> all = {
    {"ply_gaussians", [](const std::string& bytes) { parse_gaussians(bytes, "file"); }},
    {"ply_points", [](const std::string& bytes) { parse_points(bytes, "file"); }},
    {"splat", [](const std::string& bytes) { parse_splat(bytes, "file"); }},
    {"colmap_cameras_bin", [](const std::string& bytes) { parse_colmap_cameras(bytes, "file", kBinary); }},
    {"colmap_cameras_txt", [](const std::string& bytes) { parse_colmap_cameras(bytes, "file", kText); }},
    {"colmap_images_bin", [](const std::string& bytes) { parse_colmap_images(bytes, "file", kBinary); }},
    {"colmap_images_txt", [](const std::string& bytes) { parse_colmap_images(bytes, "file", kText); }},
    {"colmap_points_bin", [](const std::string& bytes) { parse_colmap_points(bytes, "file", kBinary); }},
    {"colmap_points_txt", [](const std::string& bytes) { parse_colmap_points(bytes, "file", kText); }},
#if DSMOE_WITH_JSON
    {"transforms_json",
     [](const std::string& bytes) {
       parse_json_views(bytes, "file", {64, 48});
     }},
    {"cameras_json", [](const std::string& bytes) { parse_json_views(bytes, "file", {}); }},
#endif
  };
  return all;
}

}  // namespace dsmoe::tools
