// The walk over a tile: Gaussians in list order, and the cells of the tile that each of them meets. Backward,
// contributions, importance and gate map are visitors of it. The forward pass walks cell by cell (tile_forward_impl.h),
// with the same parts. Included once per instruction set, after pack.h.
#pragma once

#include "../dispatch.h"
#include "dsmoe/features.h"
#include "dsmoe/tiles.h"
#include "pack.h"
#include "tile_kernels.h"

namespace dsmoe {
namespace cpu {
namespace DSMOE_SIMD {

template <class S> using Pack = ::dsmoe::DSMOE_SIMD::Pack<S>;

// A tile is made of square cells, row by row. A cell has as many pixels as the largest pack; smaller packs take a part
// of it each. Cells are square because fewer Gaussians meet a square than a row of as many pixels.
constexpr int kCellSize = 4;  // pixels
constexpr int kCellPixels = kCellSize * kCellSize;
constexpr int kCellColumns = kTileSize / kCellSize;
constexpr int kCells = kCellColumns * kCellColumns;
using CellBits = uint32_t;  // one bit a cell, the first cell's the lowest

// 0, 1, 2, 3, 0, 1, ... and 0, 0, 0, 0, 1, 1, ...: columns and rows of a cell's pixels, and of a tile's cells.
template <class S> struct SquareOfFour {
  alignas(64) S columns[16] = {0, 1, 2, 3, 0, 1, 2, 3, 0, 1, 2, 3, 0, 1, 2, 3};
  alignas(64) S rows[16] = {0, 0, 0, 0, 1, 1, 1, 1, 2, 2, 2, 2, 3, 3, 3, 3};
};
template <class S> constexpr SquareOfFour<S> kSquareOfFour = {};
static_assert(kCellSize == 4 && kCellColumns == 4, "kSquareOfFour");

// One number per pixel of the tile, cell by cell.
template <class S> struct PixelArray {
  S* values;

  DSMOE_HD Pack<S> load(int at) const { return Pack<S>::load(values + at); }
  DSMOE_HD void store(int at, Pack<S> value) const { value.store(values + at); }
  DSMOE_HD S& pixel(int x, int y) const {
    const int cell = y / kCellSize * kCellColumns + x / kCellSize;
    return values[cell * kCellPixels + y % kCellSize * kCellSize + x % kCellSize];
  }
};

// Hands out PixelArrays one after the other.
template <class S> struct Scratch {
  S* next;
  DSMOE_HD PixelArray<S> pixels() {
    S* values = next;
    next += kTilePixels;
    return {values};
  }
};

// The part of the tile that lies on the image.
struct TileExtent {
  int x0, y0, columns, rows;
  template <class S>
  DSMOE_HD explicit TileExtent(const Tile<S>& tile)
      : x0(tile.x * kTileSize),
        y0(tile.y * kTileSize),
        columns(min(kTileSize, tile.width - x0)),
        rows(min(kTileSize, tile.height - y0)) {}

  // Calls body(x, y, index into an [H, W] image).
  template <class Body> DSMOE_HD void for_each_pixel(int width, Body body) const {
    for (int y = 0; y < rows; ++y) {
      for (int x = 0; x < columns; ++x) body(x, y, static_cast<int64_t>(y0 + y) * width + x0 + x);
    }
  }

  // The cells with pixels on the image.
  DSMOE_HD CellBits cells() const {
    CellBits out = 0;
    for (int cell = 0; cell < kCells; ++cell) {
      const bool on_image = cell % kCellColumns * kCellSize < columns && cell / kCellColumns * kCellSize < rows;
      out |= CellBits(on_image) << cell;
    }
    return out;
  }
};

// Where the pixels of a tile lie in the image.
template <class S> struct PixelCenters {
  alignas(64) S x[kTilePixels];
  alignas(64) S y[kTilePixels];

  DSMOE_HD explicit PixelCenters(const TileExtent& extent) {
    using P = Pack<S>;
    for (int at = 0; at < kTilePixels; at += P::kLanes) {
      const int cell = at / kCellPixels, first = at % kCellPixels;
      const int row = cell / kCellColumns, column = cell % kCellColumns;
      const P left = S(extent.x0 + column * kCellSize), top = S(extent.y0 + row * kCellSize);
      (P::load(kSquareOfFour<S>.columns + first) + left).store(x + at);
      (P::load(kSquareOfFour<S>.rows + first) + top).store(y + at);
    }
  }
};

// A Gaussian of the list: all that its pairs need.
template <class S> struct ListedGaussian {
  Vec2<S> mean;
  ExponentFactors<S> exponent;
  S opacity;
  S least_alpha;  // of the pairs that the walk is for
  S near_alpha;   // of near pairs
  S position;     // in the list, from 0
  uint32_t slot;
  CellBits met;       // the cells that pairs of the walk lie in, or some more
  CellBits smooth;    // of these, the cells over which the Gaussian is smooth and which have no faint pairs
  const S* features;  // [F]

  // Of smooth cells: alpha at the centre, and its factors at the pixels, by the cell's column and by its row.
  alignas(64) S alpha[kCells];
  alignas(64) S column_factors[kCellColumns][kCellPixels];
  alignas(64) S row_factors[kCellColumns][kCellPixels];
};

// Which pairs a walk is for.
enum class Pairs {
  kNarrow,    // those that count in every pixel: the near ones if the rendering blends them first
  kWide,      // all that count in wide pixels
  kWithTails  // and their tails
};

// The Gaussians of a tile's list, one after the other.
template <class S> class GaussianList {
 public:
  DSMOE_HD GaussianList(const Tile<S>& tile, const TileExtent& extent, int num_features, Pairs pairs)
      : tile_(tile),
        extent_(extent),
        num_features_(num_features),
        near_first_(tile.config.blend.blends_near_first()),
        near_(near_first_ && pairs == Pairs::kNarrow),
        further_reach_(pairs == Pairs::kWithTails ? tile.config.blend.tail_reach() : S(0)),
        cut_(tile.config.blend.alpha_cut()) {}

  // Whether the walk wants entry i of all lists.
  DSMOE_HD bool wants(int64_t i) const { return !near_ || tile_.saved.instances[i].has_near_pairs(); }

  // Fills `listed` with entry i of all lists. next: an entry that will soon be wanted; the Gaussians of a list lie
  // anywhere in memory.
  DSMOE_HD void load(int64_t i, int64_t next, ListedGaussian<S>& listed) const {
    const SavedForward<S>& saved = tile_.saved;
    const int64_t soon = saved.instances[next].index();
    __builtin_prefetch(saved.projected + soon);
    __builtin_prefetch(saved.features + soon * num_features_);
    const TileInstance& instance = saved.instances[i];
    const ProjectedGaussian<S>& gaussian = saved.projected[instance.index()];
    listed.mean = gaussian.mean;
    listed.exponent = ExponentFactors<S>(gaussian.conic);
    listed.opacity = gaussian.opacity;
    listed.least_alpha = cut_.of(gaussian.opacity);
    listed.near_alpha = near_alpha(gaussian.opacity, listed.least_alpha);
    if (near_) listed.least_alpha = listed.near_alpha;
    listed.position = S(i - tile_.begin);
    listed.slot = instance.slot;
    listed.features = saved.features + static_cast<int64_t>(instance.index()) * num_features_;
    find_cells(gaussian, listed);
  }

 private:
  // Smooth cells lie inside the footprint, of the near pairs if they come first: each of their pairs counts. The
  // exponent changes by at most `spread` between a cell's centre and its pixels.
  DSMOE_HD void find_cells(const ProjectedGaussian<S>& gaussian, ListedGaussian<S>& listed) const {
    using P = Pack<S>;
    const Sym2<S>& conic = gaussian.conic;
    const ExponentFactors<S>& factors = listed.exponent;
    const S bend = kReach * kReach * (abs(factors.xy) - factors.xx - factors.yy);
    // If the determinant is all but lost, the exponent may be above 0. The clamp of alpha, at 0.99, is left out.
    const bool may_be_smooth = bend < S(0.25) * kLargestSpread && gaussian.opacity < S(0.98) &&
                               conic.xy * conic.xy < S(0.9999) * conic.xx * conic.yy;
    const S full_reach = near_first_ ? near_reach(gaussian.opacity, gaussian.squared_reach) : gaussian.squared_reach;
    const S reach = near_ ? full_reach : gaussian.squared_reach + further_reach_;
    // As in may_meet, on the other side of the border.
    const S least_power = S(-0.5) * (full_reach * S(1 - kFootprintSlack) - S(kFootprintSlack));
    listed.met = listed.smooth = 0;
    for (int first = 0; first < kCells; first += P::kLanes) {
      const P x = fma(P::load(kSquareOfFour<S>.columns + first), P(S(kCellSize)), P(S(extent_.x0)));
      const P y = fma(P::load(kSquareOfFour<S>.rows + first), P(S(kCellSize)), P(S(extent_.y0)));
      const PixelRect<P> rects = {x, y, x + P(S(kCellSize - 1)), y + P(S(kCellSize - 1))};
      listed.met |= bits_of(may_meet(conic, gaussian.mean, reach, rects)) << first;
      if (!may_be_smooth) continue;
      const P dx = x + P(kReach) - P(gaussian.mean.x), dy = y + P(kReach) - P(gaussian.mean.y);
      const P slope_x = fma(P(S(2) * factors.xx), dx, P(factors.xy) * dy);
      const P slope_y = fma(P(S(2) * factors.yy), dy, P(factors.xy) * dx);
      const P power = P(S(0.5)) * fma(slope_x, dx, slope_y * dy);
      const P spread = fma(P(kReach), abs(slope_x) + abs(slope_y), P(bend));
      listed.smooth |= bits_of((spread <= P(kLargestSpread)) & (power - spread >= P(least_power))) << first;
      power.store(listed.alpha + first);
    }
    listed.smooth &= listed.met;
    if (listed.smooth != 0) find_factors(listed);
  }

  // At (u, v) from a cell's centre the exponent differs by slope_x u + slope_y v + bend. From cell to cell the slopes
  // grow by constants, and bend stays. So the factors are products of three exponentials. Next to a smooth cell their
  // exponents are below 40, by the bounds on spread and bend. listed.alpha: the exponents at the cells' centres.
  DSMOE_HD void find_factors(ListedGaussian<S>& listed) const {
    using P = Pack<S>;
    const ExponentFactors<S>& factors = listed.exponent;
    const S dx = S(extent_.x0) + kReach - listed.mean.x, dy = S(extent_.y0) + kReach - listed.mean.y;
    const P slope_x = fma(S(2) * factors.xx, dx, factors.xy * dy);  // of the first cell
    const P slope_y = fma(S(2) * factors.yy, dy, factors.xy * dx);
    static_assert(kCells == kCellPixels, "one loop");
    for (int first = 0; first < kCellPixels; first += P::kLanes) {
      (P(listed.opacity) * exp(P::load(listed.alpha + first))).store(listed.alpha + first);
      const P u = P::load(kSquareOfFour<S>.columns + first) - P(kReach);
      const P v = P::load(kSquareOfFour<S>.rows + first) - P(kReach);
      const P bend = ColumnExponent<P, S>(factors, u).at(v);
      const P by_column = fma(P(S(2 * kCellSize) * factors.xx), u, P(S(kCellSize) * factors.xy) * v);
      const P by_row = fma(P(S(2 * kCellSize) * factors.yy), v, P(S(kCellSize) * factors.xy) * u);
      const P column_step = exp(by_column), row_step = exp(by_row);
      P column = exp(fma(slope_x, u, fma(slope_y, v, bend))), row = S(1);
      for (int k = 0; k < kCellColumns; ++k) {
        column.store(listed.column_factors[k] + first);
        row.store(listed.row_factors[k] + first);
        column = column * column_step;
        row = row * row_step;
      }
    }
  }

  static constexpr S kReach = S(kCellSize - 1) / 2;  // from a cell's centre to its outermost pixels
  static constexpr S kLargestSpread = S(3);          // a larger one adds few cells and rounding

  const Tile<S>& tile_;
  const TileExtent& extent_;
  const int num_features_;
  const bool near_first_, near_;
  const S further_reach_;
  const AlphaCut<S> cut_;
};

constexpr int64_t kPrefetchDistance = 8;  // list entries

// Which pixels of a tile are wide, as the forward pass has said, for passes that walk their pairs again.
template <BlendMode kMode, class S> class WidePixels {
 public:
  using P = Pack<S>;

  DSMOE_HD WidePixels(const Tile<S>& tile, PixelArray<S> covered) : covered_(covered) {
    if (!Blend<kMode>::kNearFirst) return;
    for (int i = 0; i < kTilePixels; ++i) covered_.values[i] = S(1);
    TileExtent(tile).for_each_pixel(tile.width, [&](int x, int y, int64_t index) {
      if (is_wide(tile.saved.final_transmittance[index])) covered_.pixel(x, y) = S(0), any_ = true;
    });
  }

  DSMOE_HD Pairs wanted() const { return any_ ? Pairs::kWide : Pairs::kNarrow; }

  // Removes the faint pairs of covered pixels from a pack of a wide walk. at: of the first pixel.
  DSMOE_HD void cut(Gate<P>& gate, const ListedGaussian<S>& gaussian, int at) const {
    if (!Blend<kMode>::kNearFirst || !any_) return;
    gate.counts = gate.counts & (gate.logit >= covered_.load(at) * P(gaussian.near_alpha));
  }

 private:
  const PixelArray<S> covered_;  // 1; 0 in wide pixels
  bool any_ = false;
};

// A pack of pairs of one Gaussian. at: of the first pixel in a PixelArray.
template <BlendMode kMode, class S, bool kSmooth> struct PackPairs {
  using P = Pack<S>;

  P dx, dy;  // pixel - mean
  std::conditional_t<kSmooth, UnclampedGate<P>, Gate<P>> gate;
  Mask<P> inside;  // the conic is an ellipse

  DSMOE_HD PackPairs(const ListedGaussian<S>& gaussian, const PixelCenters<S>& pixels, int at)
      : dx(P::load(pixels.x + at) - P(gaussian.mean.x)), dy(P::load(pixels.y + at) - P(gaussian.mean.y)) {
    if constexpr (kSmooth) {
      const int cell = at / kCellPixels, first = at % kCellPixels;
      const P column = P::load(gaussian.column_factors[cell % kCellColumns] + first);
      const P row = P::load(gaussian.row_factors[cell / kCellColumns] + first);
      gate.logit = gate.alpha = P(gaussian.alpha[cell]) * column * row;
      gate.counts = inside = Mask<P>::all();
    } else {
      const P power = ColumnExponent<P, S>(gaussian.exponent, dx).at(dy);
      gate = evaluate_gate<kMode>(power, gaussian.opacity, gaussian.least_alpha);
      inside = power <= P(S(0));
    }
  }
};

// Visits the pairs of the list entries [begin, end), and returns how many pairs it visited. A visitor has:
//   kMode, kBackToFront   how pairs are cut, and the direction
//   expect(slot)          the slot of a Gaussian that will soon come
//   begin(gaussian)       returns the sums of a Gaussian, in registers
//   wanted(at, pixels)    whether a pack's pairs are wanted, and for which pixels; at: the first in a PixelArray
//   take(at, pairs, pixels, sums)   a pack of pairs
//   end(gaussian, sums)
//   skip(slot)            in place of these two for a Gaussian without pairs in the walk
// Between `begin` and `end`, `wanted` is asked of each pack that the footprint may meet. If it says so, `take`
// follows.
template <class S, class Visitor>
DSMOE_HD int64_t walk_tile(const Tile<S>& tile, int64_t begin, int64_t end, int num_features,
                           const WidePixels<Visitor::kMode, S>& wide, Visitor& visitor) {
  const TileExtent extent(tile);
  const PixelCenters<S> pixels(extent);
  const GaussianList<S> list(tile, extent, num_features, wide.wanted());
  const CellBits on_image = extent.cells();
  ListedGaussian<S> gaussian;
  int64_t num_pairs = 0;
  const auto visit = [&](CellBits cells, auto& sums, auto smooth) {
    for (; cells != 0; cells &= cells - 1) {
      const int cell_begin = __builtin_ctz(cells) * kCellPixels;
      for (int at = cell_begin; at < cell_begin + kCellPixels; at += Pack<S>::kLanes) {
        Mask<Pack<S>> wanted;
        if (!visitor.wanted(at, wanted)) continue;
        num_pairs += Pack<S>::kLanes;
        PackPairs<Visitor::kMode, S, decltype(smooth)::value> pairs(gaussian, pixels, at);
        if (!decltype(smooth)::value) wide.cut(pairs.gate, gaussian, at);
        visitor.take(at, pairs, wanted, sums);
      }
    }
  };
  for (int64_t k = 0; k < end - begin; ++k) {
    const int64_t i = Visitor::kBackToFront ? end - 1 - k : begin + k;
    const int64_t next =
        Visitor::kBackToFront ? max(i - kPrefetchDistance, begin) : min(i + kPrefetchDistance, end - 1);
    if (!list.wants(i)) {
      visitor.skip(tile.saved.instances[i].slot);
      continue;
    }
    list.load(i, next, gaussian);
    visitor.expect(tile.saved.instances[next].slot);
    auto sums = visitor.begin(gaussian);
    visit(gaussian.met & on_image & ~gaussian.smooth, sums, std::false_type{});
    visit(gaussian.smooth & on_image, sums, std::true_type{});
    visitor.end(gaussian, sums);
  }
  return num_pairs;
}

}  // namespace DSMOE_SIMD
}  // namespace cpu
}  // namespace dsmoe
