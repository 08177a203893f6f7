// The tile walk: how a warp goes through the list of a tile. Every pass over pixels is a visitor of it.
//
// A warp owns a square of pixels, a quarter of a tile. Each lane owns two of them, one below the other, which share a
// Gaussian's terms in x. (HiGS, arXiv:2606.00352, also has small squares for warps inside larger tiles.) Two
// warps may also walk for one square; the visitor then knows which pixel of each lane is its own.
//
//   find    the warp looks ahead in the list for entries that may meet its pixels. In most lists entries are marked
//           with the quarters that they may meet
//   load    32 of those that it has found, one a lane, while the 32 before them are visited. If entries are not
//           marked, each lane tests the footprint of its entry against the warp's pixels
//   stage   those that meet them go to shared memory
//   visit   all lanes read the staged entries one after the other, and the visitor does the work of its pass
//
// In the walk, warps do not wait for each other.
#pragma once

#include <type_traits>

#include "device.cuh"
#include "dsmoe/features.h"
#include "tile_rows.cuh"
#include "tuning.cuh"

namespace dsmoe {
namespace cuda {

// What every walk needs to know of a rendering.
template <class S> struct BlendArguments {
  int64_t num_gaussians;      // N
  int width, height;          // of the image, pixels
  int tile_columns;           // tiles side by side
  RasterConfig<S> config;     // mode, features, background
  SavedForward<S> saved;      // what the forward pass leaves, and reads itself
  ImageOutputs<S> images;     // [features, H, W], and the radii [N]
  bool marked;                // entries of lists are marked with quarters
  bool near_first;            // marks, and walks that are not wide, are only of near pairs
  S wide_below, tail_alpha;   // of BlendRules
  S tail_reach;               // of BlendRules
  unsigned long long* pairs;  // [1] (Gaussian, pixel) pairs that were evaluated are added to it, or null
};

template <class S> BlendArguments<S> blend_arguments(const Frame<S>& frame, const Work& work) {
  BlendArguments<S> arguments = {};
  arguments.num_gaussians = frame.inputs.num_gaussians;
  arguments.width = frame.camera.width;
  arguments.height = frame.camera.height;
  arguments.tile_columns = TileGrid(frame.camera.width, frame.camera.height).columns;
  arguments.config = frame.config;
  arguments.saved = frame.saved;
  arguments.images = frame.images;
  arguments.marked = marks_quarters(frame.inputs.num_gaussians);
  arguments.near_first = frame.config.blend.blends_near_first();
  arguments.wide_below = frame.config.blend.wide_below();
  arguments.tail_alpha = frame.config.blend.tail_alpha();
  arguments.tail_reach = frame.config.blend.tail_reach();
  arguments.pairs = work.pairs;
  return arguments;
}

// Where a tile's walk gets its entries: from the list of the tile, or, if the instances outgrew their memory, from
// the depth order of all Gaussians. Both lead front to back.
template <class S> class EntrySource {
 public:
  EntrySource() = default;
  __device__ EntrySource(const BlendArguments<S>& arguments, int tile, int quarter) {
    const SavedForward<S>& saved = arguments.saved;
    listed = !overflows(saved);
    marked = listed && arguments.marked;
    begin = listed ? saved.tile_offsets[tile] : 0;
    length = static_cast<int32_t>(listed ? saved.tile_offsets[tile + 1] - begin : *saved.num_ordered);
    entries_ = listed ? saved.instances + begin : saved.order;
    wanted_ = marked ? 1u << (kMarkShift + quarter) : kSign;
  }

  __device__ uint32_t entry(int32_t position) const { return static_cast<uint32_t>(entries_[position]); }

  // Stands for an entry, and meets no pixels.
  __device__ uint32_t no_entry() const { return marked ? (1u << kMarkShift) - 1 : kSign; }

  // Whether an entry may meet the quarter's pixels. False for a culled Gaussian, which only the depth order has. kWide:
  // also by pairs that the marks leave out.
  template <bool kWide> __device__ bool may_meet(uint32_t entry) const {
    if (kWide && marked) return entry != no_entry();
    return ((marked ? entry : ~entry) & wanted_) != 0;
  }
  __device__ int32_t gaussian(uint32_t entry) const {
    return static_cast<int32_t>(marked ? entry & ((1u << kMarkShift) - 1) : entry);
  }

  bool listed;     // the entries are the tile's list; else the depth order, which knows nothing of tiles
  bool marked;     // an entry says which quarters it may meet
  int64_t begin;   // the list's first instance
  int32_t length;  // entries

 private:
  static constexpr uint32_t kSign = 1u << 31;

  const int32_t* entries_;  // [length]
  uint32_t wanted_;         // the bit that decides: the quarter's mark, or the sign
};

// The square of pixels of a warp, or of two that share it, and the entries that may meet them.
template <class S> class WarpTile {
 public:
  __device__ explicit WarpTile(const BlendArguments<S>& arguments)
      : WarpTile(arguments, blockIdx.x, threadIdx.x / kWarp) {}

  __device__ WarpTile(const BlendArguments<S>& arguments, int tile, int quarter) : quarter(quarter) {
    lane = threadIdx.x % kWarp;
    index = tile;
    tile_x = tile % arguments.tile_columns, tile_y = arguments.saved.band.begin + tile / arguments.tile_columns;
    constexpr int kAcross = kTileSize / kWarpTile;
    const int x0 = tile_x * kTileSize + quarter % kAcross * kWarpTile;
    const int y0 = tile_y * kTileSize + quarter / kAcross * kWarpTile;
    x = x0 + lane % kWarpTile, y = y0 + lane / kWarpTile;
    empty = x0 >= arguments.width || y0 >= arguments.height;
    rect = {S(x0), S(y0), S(min(x0 + kWarpTile, arguments.width) - 1), S(min(y0 + kWarpTile, arguments.height) - 1)};
    source = EntrySource<S>(arguments, tile, quarter);
  }

  __device__ bool inside(const BlendArguments<S>& arguments, int k) const {
    return x < arguments.width && y + k * kLaneStep < arguments.height;
  }
  __device__ int64_t pixel_index(const BlendArguments<S>& arguments, int k) const {
    return int64_t(y + k * kLaneStep) * arguments.width + x;
  }

  int quarter;  // of the tile, row by row
  int lane;
  int index;           // of the tile in the band
  int tile_x, tile_y;  // of the tile, in tiles
  int x, y;            // of the lane's first pixel, in a lane that has all of them
  bool empty;          // no pixel of the warp lies in the image
  PixelRect<S> rect;   // the warp's pixels in the image
  EntrySource<S> source;
};

// A Gaussian that meets the warp's pixels, as the visitors read it.
template <class S> struct alignas(16) StagedShape {
  Vec2<S> mean;     // pixels
  LogGate<S> gate;  // per px^2
  int32_t seen;     // entries of the list up to this one, itself too
};
template <class S, bool kWithFeatures> struct alignas(16) StagedGaussian : StagedShape<S> {
  S features[kFeatureChunk];
};
template <class S> struct alignas(16) StagedGaussian<S, false> : StagedShape<S> {};

// An entry that has been found.
struct FoundEntry {
  int32_t gaussian, position;
};

// Where a warp keeps what it has found and what it visits, in shared memory.
template <class S, bool kWithFeatures> struct Stage {
  FoundEntry found[kFoundEntries];  // a ring
  StagedGaussian<S, kWithFeatures> gaussians[kWarp];
  int32_t numbers[kWarp];  // of these Gaussians
};
template <class S, class Visitor> using WarpStage = Stage<S, Visitor::kReadsFeatures>;

// The vertical distance of the lane's pixel k; dy: of its first pixel.
template <class S> __device__ __forceinline__ S below(S dy, int k) { return k == 0 ? dy : dy + S(k * kLaneStep); }

// The part of a list that a warp walks.
struct WalkRange {
  int32_t begin, end;     // entries of the list, half-open
  int first_feature = 0;  // the kFeatureChunk features from here on come along, if the visitor reads features
};

// Looks ahead in a list.
template <class S, bool kBackToFront, bool kWide> class EntryFinder {
 public:
  __device__ EntryFinder(const WarpTile<S>& tile, const WalkRange& range, FoundEntry* ring)
      : tile_(tile), range_(range), ring_(ring), cursor_(kBackToFront ? range.end - 1 : range.begin) {
    read();
  }

  // Takes the next 32 entries, or as many as are left; with kInSegments only those in the segment of the first of them.
  // Returns how many. The lane gets entry `lane`, if there is one.
  template <bool kInSegments> __device__ int take(FoundEntry& own) {
    while (found_ - taken_ < kWarp && (kBackToFront ? cursor_ >= range_.begin : cursor_ < range_.end)) find();
    __syncwarp();
    own = ring_[(taken_ + tile_.lane) % kFoundEntries];
    int count = min(kWarp, found_ - taken_);
    if constexpr (kInSegments) {
      const int32_t segment = own.position / kSegmentLength, first = __shfl_sync(kAllLanes, segment, 0);
      count = __popc(__ballot_sync(kAllLanes, tile_.lane < count && segment == first));
    }
    taken_ += count;
    __syncwarp();
    return count;
  }

 private:
  __device__ int32_t position(int i) const {
    const int32_t step = i * kWarp + tile_.lane;
    return kBackToFront ? cursor_ - step : cursor_ + step;
  }

  // Reads the entries that will be looked at next.
  __device__ void read() {
#pragma unroll
    for (int i = 0; i < kReadAhead; ++i) {
      const int32_t at = position(i);
      const bool exists = kBackToFront ? at >= range_.begin : at < range_.end;
      entries_[i] = exists ? tile_.source.entry(at) : tile_.source.no_entry();
    }
  }

  __device__ void find() {
#pragma unroll
    for (int i = 0; i < kReadAhead; ++i) {
      const bool meets = tile_.source.template may_meet<kWide>(entries_[i]);
      const unsigned meet = __ballot_sync(kAllLanes, meets);
      if (meets) {
        ring_[(found_ + __popc(meet & ((1u << tile_.lane) - 1))) % kFoundEntries] = {tile_.source.gaussian(entries_[i]),
                                                                                     position(i)};
      }
      found_ += __popc(meet);
    }
    cursor_ += kBackToFront ? -kReadAhead * kWarp : kReadAhead * kWarp;
    read();
  }

  const WarpTile<S>& tile_;
  const WalkRange& range_;
  FoundEntry* ring_;  // [kFoundEntries]
  int32_t cursor_;    // position of the first entry that was read
  uint32_t entries_[kReadAhead];
  int found_ = 0, taken_ = 0;  // entries so far
};

// Which pairs a walk is for.
enum class Pairs {
  kNarrow,    // those that count in every pixel: the near ones if the rendering blends them first
  kWide,      // all that count in wide pixels
  kWithTails  // and their tails
};

// Calls walk(Constant<kPairs>), with kWide if the mode has wide pixels and some lane has one.
template <Pairs kPairs> using PairsConstant = std::integral_constant<Pairs, kPairs>;
template <BlendMode kMode, class Walk> __device__ __forceinline__ void walk_pairs(bool wide, Walk walk) {
  if constexpr (Blend<kMode>::kNearFirst) {
    if (__any_sync(kAllLanes, wide)) return walk(PairsConstant<Pairs::kWide>{});
  }
  walk(PairsConstant<Pairs::kNarrow>{});
}

// The gate of a pair in a walk. wide: whether the pixel is; read in a wide walk only.
template <Pairs kPairs, class S>
__device__ __forceinline__ Gate<S> evaluate_pair(const LogGate<S>& gate, S log_logit, bool wide) {
  if constexpr (kPairs == Pairs::kNarrow) return gate.evaluate(log_logit);
  return gate.evaluate(log_logit, wide ? gate.least : gate.near_least());
}

// What a lane has loaded of an entry.
template <class S, bool kWithFeatures> struct LoadedEntry {
  StagedGaussian<S, kWithFeatures> staged;
  bool meets;  // the warp's pixels
};

// Whether a visitor has end_visits.
template <class Visitor, class = void> constexpr bool kEndsVisits = false;
template <class Visitor> constexpr bool kEndsVisits<Visitor, std::void_t<decltype(&Visitor::end_visits)>> = true;

// Whether a visitor asks each pixel which of its pairs count, and whether it wants pairs that are tails too.
template <class Visitor> constexpr bool kVisitsFaint = Visitor::kPairs != Pairs::kNarrow;
template <class Visitor> constexpr bool kVisitsTails = Visitor::kPairs == Pairs::kWithTails;

template <class Visitor, class S>
__device__ __forceinline__ auto load_entry(const Visitor& visitor, const FoundEntry& entry, bool exists,
                                           const WalkRange& range) {
  const BlendArguments<S>& arguments = visitor.arguments;
  const WarpTile<S>& tile = visitor.tile;
  LoadedEntry<S, Visitor::kReadsFeatures> loaded;
  loaded.meets = exists;
  if (!exists) return loaded;
  const ProjectedGaussian<S> gaussian = arguments.saved.projected[entry.gaussian];
  if constexpr (Visitor::kReadsFeatures) {
    const S* features =
        arguments.saved.features + int64_t(entry.gaussian) * feature_stride(arguments.config.num_features());
    struct alignas(16) Chunk {
      S values[kFeatureChunk];
    };
    *reinterpret_cast<Chunk*>(loaded.staged.features) = *reinterpret_cast<const Chunk*>(features + range.first_feature);
  }
  StagedShape<S>& shape = loaded.staged;
  shape = {gaussian.mean, LogGate<S>(gaussian.conic, gaussian.opacity, gaussian.squared_reach), entry.position + 1};
  const bool near = Visitor::kNearFirst && !kVisitsFaint<Visitor> && arguments.near_first;
  if (near) shape.gate.least = shape.gate.near_least();
  if (tile.source.marked && !kVisitsFaint<Visitor>) return loaded;
  S reach = near ? near_reach(gaussian.opacity, gaussian.squared_reach) : gaussian.squared_reach;
  if (kVisitsTails<Visitor>) reach += arguments.tail_reach;
  loaded.meets = may_meet(gaussian.conic, gaussian.mean, reach, tile.rect);
  if (!tile.source.listed) {
    const BlendMode mode = arguments.config.blend.mode;
    const TileRect bounds = tile_bounds(mode, TileGrid(arguments.width, arguments.height), gaussian.mean,
                                        bounding_radius<S>(mode, arguments.images.radii, entry.gaussian));
    loaded.meets &=
        bounds.x0 <= tile.tile_x && tile.tile_x < bounds.x1 && bounds.y0 <= tile.tile_y && tile.tile_y < bounds.y1;
  }
  return loaded;
}

// The walk itself. Returns how many entries met the warp's pixels. A visitor has
//
//   kBackToFront, kStopsEarly, kReadsFeatures   what it wants of the walk, static
//   kNearFirst, kPairs            whether the mode has wide pixels, and which pairs it wants, static
//   kInSegments                   entries of two segments are never staged together, static
//   kUnroll                       visits that the compiler may interleave, static
//   arguments, tile               the rendering, and the warp's place in it
//   begin_batch(position)         called before the staged entries are visited, whose first one was at `position`
//   visit(staged, number)         one staged entry, for all lanes, and the number of its Gaussian
//   end_visits(staged, numbers, count)   called after up to kVisitsPerCheck visits, of these staged entries; may be
//                                 left out
//   is_done()                     the walk may end; called after end_visits, if the visitor stops early
template <class S, class Visitor>
__device__ __forceinline__ unsigned walk_tile(WarpStage<S, Visitor>& stage, const WalkRange& range, Visitor& visitor) {
  const int lane = visitor.tile.lane;
  EntryFinder<S, Visitor::kBackToFront, kVisitsFaint<Visitor>> finder(visitor.tile, range, stage.found);
  unsigned met = 0;
  FoundEntry entry;
  int count = finder.template take<Visitor::kInSegments>(entry);
  auto next = load_entry<Visitor, S>(visitor, entry, lane < count, range);
  while (count > 0) {
    const unsigned meet = __ballot_sync(kAllLanes, next.meets);
    if (next.meets) {
      const int slot = __popc(meet & ((1u << lane) - 1));
      stage.gaussians[slot] = next.staged;
      stage.numbers[slot] = entry.gaussian;
    }
    const int32_t first = __shfl_sync(kAllLanes, entry.position, 0);
    const int staged = __popc(meet);
    count = finder.template take<Visitor::kInSegments>(entry);  // waits for the stage too
    next = load_entry<Visitor, S>(visitor, entry, lane < count, range);
    visitor.begin_batch(first);
    met += staged;
    for (int j = 0; j < staged; j += kVisitsPerCheck) {
      const int end = min(j + kVisitsPerCheck, staged);
#pragma unroll(Visitor::kUnroll)
      for (int i = j; i < end; ++i) visitor.visit(stage.gaussians[i], stage.numbers[i]);
      if constexpr (kEndsVisits<Visitor>) visitor.end_visits(stage.gaussians + j, stage.numbers + j, end - j);
      if constexpr (Visitor::kStopsEarly) {
        if (visitor.is_done()) return met - staged + end;
      }
    }
    __syncwarp();
  }
  return met;
}

// Adds the pairs that a warp evaluated to the rendering's count. pixels: for how many the warp walked.
template <class S>
__device__ void count_pairs(const BlendArguments<S>& arguments, int lane, unsigned met,
                            int pixels = kWarpTile * kWarpTile) {
  if (arguments.pairs != nullptr && lane == 0)
    atomicAdd(arguments.pairs, static_cast<unsigned long long>(met) * pixels);
}

}  // namespace cuda
}  // namespace dsmoe
