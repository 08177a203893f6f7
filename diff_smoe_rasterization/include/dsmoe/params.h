// What goes in and out of the rasterizer, as plain structs of pointers. Every array is dense and row-major; N is the
// number of Gaussians, F the number of features (colour channels, then z and 1/z on request), I of tile instances.
//
// A pointer may be null if its comment or its struct's says so, and if its array has no elements. No other
// may: the passes of rasterize.h and rasterize_cuda.h refuse it.
#pragma once

#include <cstdint>
#include <limits>
#include <optional>
#include <string_view>
#include <vector>

#include "dsmoe/blend.h"
#include "dsmoe/project.h"

namespace dsmoe {

// How many tiles an image of these pixels has.
inline int64_t num_tiles(int width, int height) {
  const TileGrid grid(width, height);
  return static_cast<int64_t>(grid.columns) * grid.rows;
}

// No more tile instances than this are listed at once, unless a caller says so: 3 to 13 GB of memory, as backend and
// pass are. A rendering with more is made in bands: rows of tiles, half-open, by default all that an image has.
constexpr int64_t kMostInstances = int64_t(1) << 28;
struct TileBand {
  int begin = 0, end = std::numeric_limits<int>::max();
};

// How many tiles a band has.
inline int64_t band_tiles(const TileGrid& grid, const TileBand& band) {
  return static_cast<int64_t>(grid.columns) * (min(band.end, grid.rows) - band.begin);
}

// The mode of that name, as settings and files have it; absent if there is none.
inline std::optional<BlendMode> blend_mode_of(std::string_view name) {
  std::optional<BlendMode> found;
  BlendModes::for_each([&](auto mode) {
    if (name == Blend<decltype(mode)::value>::kName) found = mode();
  });
  return found;
}

template <class S> struct GaussianInputs {
  int64_t num_gaussians = 0;
  const S* means3D = nullptr;         // [N, 3] world
  const S* opacities = nullptr;       // [N] may exceed 1, up to kMaxOpacity
  const S* scales = nullptr;          // [N, 3], null with cov3D_precomp
  const S* rotations = nullptr;       // [N, 4] (w, x, y, z), used as given; null with cov3D_precomp
  const S* cov3D_precomp = nullptr;   // [N, 6] (xx, xy, xz, yy, yz, zz), or null
  const S* colors_precomp = nullptr;  // [N, C], null with shs or dc
  const S* dc = nullptr;              // [N, 3] degree 0, or null if shs holds it
  const S* shs = nullptr;             // [N, K, 3]; null with colors_precomp, and if dc has all there is
  int num_sh = 0;                     // K
  int sh_degree = 0;                  // active degree, 0 to 3; dc and shs have (degree + 1)^2 coefficients or more
};

// Features that may follow the colour's channels: the flags of RasterConfig that its num_features counts.
constexpr int kMostFurtherFeatures = 2;

template <class S> struct RasterConfig {
  BlendRules<S> blend;
  int num_channels = 3;           // C
  const S* background = nullptr;  // [C]
  S scale_modifier = 1;
  S low_pass = S(kLowPass);  // px^2 added to the projected variances
  bool antialiasing = false;
  bool clamp_color = true;  // colours from shs are at least 0
  bool depth = false;       // the expected depth is asked for
  bool inverse_depth = false;
  int num_threads = 1;                      // CPU backend; below 1 counts as 1
  int64_t most_instances = kMostInstances;  // that are listed at once, 1 or more

  DSMOE_HD ProjectionRules<S> projection_rules() const {
    return {blend.mode, scale_modifier, blend.alpha_cut(), low_pass, antialiasing, inverse_depth};
  }
  DSMOE_HD int num_features() const { return num_channels + depth + inverse_depth; }
  DSMOE_HD void leave_out_further_features() { depth = inverse_depth = false; }
};

// One (Gaussian, tile) pair, in a tile's list from front to back.
struct TileInstance {
  int32_t gaussian;  // or ~i, if only wide pixels may have pairs of Gaussian i here
  uint32_t slot;     // where its gradient goes: the Gaussian's instances lie side by side

  DSMOE_HD bool has_near_pairs() const { return gaussian >= 0; }
  DSMOE_HD int32_t index() const { return gaussian >= 0 ? gaussian : ~gaussian; }
};

// What the CPU's forward pass leaves for the backward pass; rows of culled Gaussians are zero.
template <class S> struct SavedForward {
  ProjectedGaussian<S>* projected = nullptr;  // [N]
  S* features = nullptr;                      // [N, F]
  int64_t* instance_offsets = nullptr;        // [N + 1] first slot of each Gaussian; the last entry: how many there are
  int64_t* tile_offsets = nullptr;            // [tiles + 1] first instance of each tile
  TileInstance* instances = nullptr;          // [I], or null: no lists are kept, each pass makes them band by band
  S* final_transmittance = nullptr;           // [H, W] T_{N+1}; negative in wide pixels
  S* gate_sum = nullptr;                      // [H, W] W; the caller's alpha image but in a mode with tails
  S* tails = nullptr;                         // [H, W] B, in a mode with tails
  S* sums = nullptr;                          // [2, H, W] gate_sum and tails, in a mode with tails
  int32_t* last_contributor = nullptr;        // [H, W] how many entries of the tile's list the numerator has seen
  TileBand band;                              // the rows of tiles that tile_offsets and instances are of
};

// The numbers that decide how long those arrays are.
struct SavedSizes {
  int64_t num_gaussians = 0;   // N
  int64_t num_features = 0;    // F; -1: not known
  int64_t tiles = 0;           // of the image
  int64_t pixels = 0;          // H W
  int64_t num_instances = -1;  // I if lists are kept; -1: not known yet
  bool tails = false;          // the mode has them
};

// Calls visit(name, pointer, number of elements or -1) for each array; set_sums makes the others. All code that
// allocates, checks or passes on these arrays uses this list and its order.
template <class S, class Visit> void for_each_array(SavedForward<S>& saved, const SavedSizes& sizes, Visit visit) {
  visit("projected", saved.projected, sizes.num_gaussians);
  visit("features", saved.features, sizes.num_features < 0 ? -1 : sizes.num_gaussians * sizes.num_features);
  visit("instance_offsets", saved.instance_offsets, sizes.num_gaussians + 1);
  visit("tile_offsets", saved.tile_offsets, sizes.tiles + 1);
  visit("final_transmittance", saved.final_transmittance, sizes.pixels);
  visit("last_contributor", saved.last_contributor, sizes.pixels);
  visit("sums", saved.sums, sizes.tails ? 2 * sizes.pixels : 0);
  visit("instances", saved.instances, sizes.num_instances);
}

// Sets where a pixel's sums lie, for either backend. alpha: the caller's image, [H, W].
template <class Saved, class Sizes, class S> void set_sums(Saved& saved, const Sizes& sizes, S* alpha) {
  saved.gate_sum = sizes.tails ? saved.sums : alpha;
  saved.tails = sizes.tails ? saved.sums + sizes.pixels : nullptr;
}

// Seconds of each stage, and how much work the blend did. Each call that is given this struct adds to it.
struct StageTimes {
  double project = 0, sort = 0, bin = 0, blend = 0;
  double blend_backward = 0, project_backward = 0;
  int64_t forward_pairs = 0, backward_pairs = 0;  // (Gaussian, pixel) pairs whose exponent was evaluated
};

template <class S> struct ImageOutputs {
  S* color = nullptr;          // [C, H, W]
  S* depth = nullptr;          // [H, W], or null if the config does not ask for it
  S* inverse_depth = nullptr;  // [H, W], likewise
  int32_t* radii = nullptr;    // [N] pixels
  S* gate_sum = nullptr;       // [H, W] the alpha image: W, or W / D in a mode with tails
};

// Sums over the pixels of each Gaussian, as removal.h says; written whole.
template <class S> struct ImportanceSums {
  S* shares = nullptr;          // [N]
  S* squared_shares = nullptr;  // [N]
  S* removal_costs = nullptr;   // [N]
};

// From a rendering's image and maps over it to what each Gaussian is worth.
template <class S> struct ImportanceMap {
  const S* color = nullptr;          // [C, H, W] as it was rendered
  const S* pixel_weights = nullptr;  // [H, W] of squared shares and removal costs
  const S* share_weights = nullptr;  // [H, W] of shares
  ImportanceSums<S> sums;
};

// Any of these may be null. Then that output was not used.
template <class S> struct ImageGradients {
  const S* color = nullptr;          // [C, H, W]
  const S* gate_sum = nullptr;       // [H, W]; gradient on the alpha image
  const S* depth = nullptr;          // [H, W]
  const S* inverse_depth = nullptr;  // [H, W]
};

// Any of these may be null. Then that gradient is not wanted. The others are written whole, or in the rows of Gaussians
// whose radius is above 0.
template <class S> struct GaussianGradients {
  S* means3D = nullptr;         // [N, 3]
  S* means2D = nullptr;         // [N, 3] dL/dpixel times (W/2, H/2), z = 0: what densification reads
  S* opacities = nullptr;       // [N]
  S* scales = nullptr;          // [N, 3]
  S* rotations = nullptr;       // [N, 4]
  S* cov3D_precomp = nullptr;   // [N, 6]
  S* colors_precomp = nullptr;  // [N, C]
  S* dc = nullptr;              // [N, 3]
  S* shs = nullptr;             // [N, K, 3]
  S* background = nullptr;      // [C + 1] by the colour, then by its gate
  CameraGradient<S>* camera = nullptr;
  S* means2D_abs = nullptr;  // [N, 2] sum over pixels of |dL/dpixel| times (W/2, H/2)
  bool seen_only = false;    // whether the other rows stay as they are, in place of zeros
};

// The gradients by the footprints of N Gaussians: what goes from the backward pass of the blend to that of the
// projection. A footprint is what SavedForward has of a Gaussian in `projected` and `features`, and its radius.
constexpr int kNumGateGradients = 6;  // by the centre's x and y, the conic's xx, xy and yy, and the opacity
template <class S> struct FootprintGradients {
  S* records = nullptr;       // [N, kNumGateGradients + F] those of the gate, then by the features
  const S* depths = nullptr;  // [N] by the view depth, added to the features' gradient; or null. No blend writes it.
};

// One rendering, from its inputs to what it leaves for the backward pass. The backends differ in where the camera lies
// and in what they save: cpu::Frame and cuda::Frame.
template <class S, class BackendCamera, class BackendSaved> struct RenderingFrame {
  GaussianInputs<S> inputs;  // what is rendered
  BackendCamera camera;      // from where, and the size of the image
  RasterConfig<S> config;    // how
  ImageOutputs<S> images;    // where the results go
  BackendSaved saved;        // filled by `forward`
};

// A batch: several views of the same Gaussians. The footprints that a view sees lie side by side in rows, in the order
// of the Gaussians, so that they can be sent and blended as they are. Rows are counted by blocks of Gaussians: a
// Gaussian finds its own by those before it in its block.
constexpr int kViewBlock = 128;  // Gaussians
constexpr int kMostViews = 16;   // of one batch
constexpr int kRowFeatures = 4;  // numbers: a colour, and the bits of the radius
inline int64_t num_view_blocks(int64_t num_gaussians) { return (num_gaussians + kViewBlock - 1) / kViewBlock; }

// The radius of a Gaussian that has a row, and is culled all the same, mostly because its colour is not finite. Its row
// is zero.
constexpr int32_t kCulledInRow = -1;

template <class BackendCamera> struct BatchView {
  BackendCamera camera;
  int32_t* radii = nullptr;        // [N] pixels; 0 if the Gaussian has no row
  int32_t* offsets = nullptr;      // [num_view_blocks(N) + 1] first row of each block; the last entry: how many rows
  int64_t num_rows = 0;            // M, as the caller has read it there
  float* gates = nullptr;          // [M, kProjectedGaussianSize]; on a device 16-byte aligned, as are the features
  float* features = nullptr;       // [M, kRowFeatures]
  const float* records = nullptr;  // [M, kNumGateGradients + 3] as FootprintGradients has them
  float* means2D = nullptr;        // [N, 3] gradients, written where the radius is above 0
};

template <class BackendCamera> struct ViewBatch {
  GaussianInputs<float> inputs;  // with scales, rotations and spherical harmonics
  RasterConfig<float> config;    // of colours alone
  std::vector<BatchView<BackendCamera>> views;
};

// What a backward pass is given and what it writes.
template <class S> struct Gradients {
  ImageGradients<S> images;     // given, by the images
  GaussianGradients<S> inputs;  // written, by the inputs
};

}  // namespace dsmoe
