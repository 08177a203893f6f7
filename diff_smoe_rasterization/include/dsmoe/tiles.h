// Which tiles, and which rows of a tile, a footprint meets: the exact ellipse against an axis-aligned band, and Inria's
// tile rectangle. All tests are bounds, widened by kFootprintSlack, so that every pixel that counts passes them.
#pragma once

#include "dsmoe/constants.h"
#include "dsmoe/vec.h"

namespace dsmoe {

// Half-open rectangle of tiles.
struct TileRect {
  int x0, y0, x1, y1;
  DSMOE_HD bool empty() const { return x0 >= x1 || y0 >= y1; }
};

// The tiles of an image.
struct TileGrid {
  int columns, rows;
  TileGrid() = default;
  DSMOE_HD TileGrid(int width, int height) : columns((width - 1) / kTileSize + 1), rows((height - 1) / kTileSize + 1) {}
};

// floor(x) and ceil(x), clamped to [low, high] with 0 <= low. They are defined even if x is beyond every integer.
template <class S> DSMOE_HD int floor_to_int(S x, int low, int high) {
  return static_cast<int>(clamp(x, S(low), S(high)));
}
template <class S> DSMOE_HD int ceil_to_int(S x, int low, int high) {
  const S kept = clamp(x, S(low), S(high));
  const int below = static_cast<int>(kept);
  return below + (S(below) < kept);
}

// The tiles that Inria's rasterizer gives to a Gaussian: the square of its radius, in whole tiles. In `alpha` mode a
// pair counts only inside, although for opacity above 0.353 the 1/255 ellipse leaves it.
template <class S> DSMOE_HD TileRect radius_rect(Vec2<S> mean, S radius, TileGrid grid) {
  const S size = S(kTileSize);
  return {floor_to_int((mean.x - radius) / size, 0, grid.columns), floor_to_int((mean.y - radius) / size, 0, grid.rows),
          floor_to_int((mean.x + radius + size - S(1)) / size, 0, grid.columns),
          floor_to_int((mean.y + radius + size - S(1)) / size, 0, grid.rows)};
}

template <class S> struct Interval {
  S low, high;
  DSMOE_HD bool empty() const { return !(low <= high); }
};

// The ellipse conic.xx u^2 + 2 conic.xy u v + conic.yy v^2 <= reach around 0. It says how far the ellipse extends in u
// over a band of v.
template <class S> class EllipseBand {
 public:
  EllipseBand() = default;
  DSMOE_HD EllipseBand(const Sym2<S>& conic, S squared_reach) : conic_(conic) {
    reach_ = squared_reach * S(1 + kFootprintSlack) + S(kFootprintSlack);
    determinant_ = difference_of_products(conic.xx, conic.yy, conic.xy, conic.xy);
    inverse_xx_ = rough_reciprocal(conic.xx);
    // The conic of a long needle may round to a determinant of 0 or less. Then the pairs that count fill an endless
    // strip.
    const S scale = determinant_ > S(0) ? max(S(0), reach_ * rough_reciprocal(determinant_)) : S(INFINITY);
    v_extent_ = rough_sqrt(scale * conic.xx);
    // v where u is largest: on the line conic.xy u + conic.yy v = 0.
    v_at_u_extent_ = -conic.xy * rough_reciprocal(conic.yy) * rough_sqrt(scale * conic.yy);
  }

  DSMOE_HD S v_extent() const { return v_extent_; }

  // u over v in [band.low, band.high]; empty if the band misses the ellipse.
  DSMOE_HD Interval<S> over(Interval<S> band) const {
    const S low = max(band.low, -v_extent_), high = min(band.high, v_extent_);
    if (!(low <= high)) return {S(1), S(0)};
    const S v_right = clamp(v_at_u_extent_, low, high), v_left = clamp(-v_at_u_extent_, low, high);
    return {centre(v_left) - half_width(v_left), centre(v_right) + half_width(v_right)};
  }

 private:
  DSMOE_HD S centre(S v) const { return -conic_.xy * v * inverse_xx_; }
  DSMOE_HD S half_width(S v) const {
    return rough_sqrt(max(S(0), conic_.xx * reach_ - determinant_ * v * v)) * inverse_xx_;
  }

  Sym2<S> conic_;
  S reach_, determinant_, inverse_xx_, v_extent_, v_at_u_extent_;
};

// The tiles that a footprint meets, row by row, inside bounds.
template <class S> class FootprintTiles {
 public:
  // Meets no tile, as a negative reach does.
  DSMOE_HD FootprintTiles() : begin_(0), end_(0) {}
  DSMOE_HD FootprintTiles(const Sym2<S>& conic, Vec2<S> mean, S squared_reach, TileRect bounds)
      : ellipse_(conic, squared_reach), mean_(mean), bounds_(bounds), begin_(0), end_(0) {
    if (!(squared_reach >= S(0)) || bounds.empty()) return;
    const S size = S(kTileSize);
    begin_ = floor_to_int((mean.y - ellipse_.v_extent()) / size, bounds.y0, bounds.y1);
    end_ = floor_to_int((mean.y + ellipse_.v_extent()) / size + S(1), bounds.y0, bounds.y1);
  }

  DSMOE_HD int begin() const { return begin_; }
  DSMOE_HD int end() const { return end_; }

  // Half-open range of tiles in row y; may be empty.
  struct Span {
    int x0, x1;
  };
  DSMOE_HD Span row(int y) const {
    const S size = S(kTileSize), last = S(kTileSize - 1);
    const S top = S(y) * size - mean_.y;
    const Interval<S> u = ellipse_.over({top, top + last});
    if (u.empty()) return {0, 0};
    // The first tile whose last pixel is not left of u.low, and the tile after the last whose first pixel is in.
    return {ceil_to_int((mean_.x + u.low - last) / size, bounds_.x0, bounds_.x1),
            floor_to_int((mean_.x + u.high) / size + S(1), bounds_.x0, bounds_.x1)};
  }

 private:
  EllipseBand<S> ellipse_;
  Vec2<S> mean_;
  TileRect bounds_;
  int begin_, end_;
};

// Calls visit(tile_x0, tile_x1, tile_y) for each tile row that the footprint meets, inside bounds.
template <class S, class Visit>
DSMOE_HD void for_each_tile_row(const Sym2<S>& conic, Vec2<S> mean, S squared_reach, TileRect bounds, Visit visit) {
  const FootprintTiles<S> tiles(conic, mean, squared_reach, bounds);
  for (int y = tiles.begin(); y < tiles.end(); ++y) {
    const auto span = tiles.row(y);
    if (span.x0 < span.x1) visit(span.x0, span.x1, y);
  }
}

template <class S> struct PixelRect {
  S x0, y0, x1, y1;  // pixel centres, borders included
};

// The least value of d^T conic d over a rectangle. The form grows along every ray from the mean, so the least value
// lies where a ray enters: on the column or the row that is nearest to the mean.
template <class Real, class S>
DSMOE_HD Real least_squared_distance(const Sym2<S>& conic, Vec2<S> mean, const PixelRect<Real>& rect) {
  const Real x0 = rect.x0 - Real(mean.x), x1 = rect.x1 - Real(mean.x);
  const Real y0 = rect.y0 - Real(mean.y), y1 = rect.y1 - Real(mean.y);
  auto value = [&](Real x, Real y) {
    return (Real(conic.xx) * x + Real(S(2) * conic.xy) * y) * x + Real(conic.yy) * y * y;
  };
  const Real x = clamp(Real(S(0)), x0, x1), y = clamp(Real(S(0)), y0, y1);
  const Real on_column = value(x, clamp(Real(-conic.xy) * x * Real(rough_reciprocal(conic.yy)), y0, y1));
  const Real on_row = value(clamp(Real(-conic.xy) * y * Real(rough_reciprocal(conic.xx)), x0, x1), y);
  return min(on_column, on_row);
}

// Whether a pair of the Gaussian may count inside the rectangle, or in each of a pack of rectangles; a bound.
template <class Real, class S>
DSMOE_HD Mask<Real> may_meet(const Sym2<S>& conic, Vec2<S> mean, S squared_reach, const PixelRect<Real>& rect) {
  const S bound = squared_reach >= S(0) ? squared_reach * S(1 + kFootprintSlack) + S(kFootprintSlack) : S(-INFINITY);
  return least_squared_distance(conic, mean, rect) <= Real(bound);
}

// Whether the ellipse meets the image: the gated modes' rule for radius > 0. Exact, without the bounds' slack.
template <class S>
DSMOE_HD bool meets_image(const Sym2<S>& conic, Vec2<S> mean, S squared_reach, int width, int height) {
  const PixelRect<S> image = {S(0), S(0), S(width - 1), S(height - 1)};
  return least_squared_distance(conic, mean, image) <= squared_reach;
}

}  // namespace dsmoe
