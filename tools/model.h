// A model as the rasterizer takes it, from a file, and the blend that it is rendered with.
#pragma once

#include <array>
#include <optional>
#include <string>
#include <vector>

#include "dsmoe/params.h"
#include "io/ply.h"

namespace dsmoe::tools {

/// N Gaussians behind their activations.
struct Model {
  int64_t count = 0;
  int sh_degree = 0;
  std::vector<float> means3D;    // [N, 3] world
  std::vector<float> dc;         // [N, 3]
  std::vector<float> shs;        // [N, K - 1, 3]
  std::vector<float> opacities;  // [N]
  std::vector<float> scales;     // [N, 3] world
  std::vector<float> rotations;  // [N, 4] (w, x, y, z), of unit length

  int num_rest() const { return (sh_degree + 1) * (sh_degree + 1) - 1; }  // K - 1
};

Model activated(io::GaussianModel raw);

/// Reads a .ply of Inria's layout or a .splat, by its name. Throws io::IoError, also if no Gaussian is finite.
io::GaussianModel read_model(const std::string& path);

std::vector<std::string> blend_names();

/// The blend that a file records, or the one that is asked for (empty, nullopt: nothing is). Notes go to stderr if
/// they disagree. Throws UsageError if neither says.
BlendRules<double> choose_blend(const io::GaussianModel& model, const std::string& file, const std::string& mode,
                                std::optional<double> background_gate);

/// A place in the middle of the Gaussians, and how far they reach: medians, which outliers do not move.
struct Extent {
  std::array<double, 3> centre;  // world
  double radius;                 // world; the median distance from the centre
};
Extent extent_of(const Model& model);

}  // namespace dsmoe::tools
