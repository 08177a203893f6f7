// Why a gate needs transmittance: red bars behind an opaque panel (the paper's Figure 8). Without T in numerator and
// denominator the bars are seen through the panel, as ghosts.
#pragma once

#include "model.h"
#include "picture.h"
#include "renderer.h"
#include "views.h"

namespace dsmoe::tools {

/// Parts of the scene, from front to back.
struct OccluderParts {
  bool panel = true;     // blue, opaque, in the middle
  bool bars = true;      // red, longer than the panel
  bool backdrop = true;  // pale, everywhere
};
Model occluder_scene(const OccluderParts& parts);
View occluder_view(int size);

/// What the bars do to the pixels in which the panel hides them.
struct Ghost {
  double leak = 0;    // mean gain of red, the bars' own colour
  double change = 0;  // mean absolute change over the three channels
  int pixels = 0;     // that count
};

/// A rendering of the whole scene, and its ghost.
struct OccluderRendering {
  Images images;
  Ghost ghost;
};
OccluderRendering render_occluder(BlendMode mode, int size, int num_threads);

}  // namespace dsmoe::tools
