// Gaussian models in .splat files: 32 bytes each, without spherical harmonics, as viewers on the web take them.
// Format: https://github.com/antimatter15/splat
#pragma once

#include <string>
#include <string_view>

#include "io/ply.h"

namespace dsmoe::io {

/// Reads a model of degree 0. The file holds rounded colours and opacities behind their activations; the outermost
/// levels of opacity stand for half a level inside them, so that logits are finite. It records no blend mode.
/// Throws FileError; FormatError if the size is not a multiple of 32, and for a position or scale that is NaN or
/// infinite, and a scale below 0.
GaussianModel read_splat(const std::string& path);

/// The same from the bytes of a file, which `file` names in errors.
GaussianModel parse_splat(std::string_view bytes, const std::string& file);

}  // namespace dsmoe::io
