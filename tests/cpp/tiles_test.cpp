// Footprints against tiles and image, by brute force over every pixel.
#include "dsmoe/tiles.h"

#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <limits>
#include <vector>

#include "dsmoe/gate.h"
#include "finite_difference.h"

namespace dsmoe {
namespace {

constexpr int kWidth = 101, kHeight = 67;  // neither is a multiple of the tile

struct Ellipse {
  Sym2<double> conic;
  Vec2<double> mean;
  double reach;
};

// An ellipse with these standard deviations, in pixels, at an angle.
Ellipse make_ellipse(double long_axis, double short_axis, double angle, Vec2<double> mean, double reach) {
  const double a = 1 / (long_axis * long_axis), b = 1 / (short_axis * short_axis);
  const double c = std::cos(angle), s = std::sin(angle);
  return {{a * c * c + b * s * s, (a - b) * c * s, a * s * s + b * c * c}, mean, reach};
}

// Tiny and huge, round and needle, on the image and far outside.
std::vector<Ellipse> random_ellipses(int count, double largest, double largest_aspect) {
  Random random(1);
  std::vector<Ellipse> out;
  for (int i = 0; i < count; ++i) {
    const double long_axis = random.log_uniform(0.55, largest);
    const double short_axis = std::max(0.55, long_axis / random.log_uniform(1, largest_aspect));
    const double spread = i % 3 == 0 ? 5 : 0.6;  // a third may lie far outside
    const Vec2<double> mean = {kWidth * (0.5 + random.uniform(-spread, spread)),
                               kHeight * (0.5 + random.uniform(-spread, spread))};
    out.push_back(make_ellipse(long_axis, short_axis, random.uniform(0, 3.2), mean, random.log_uniform(1e-3, 23.03)));
  }
  return out;
}

// The least value of the quadratic form over a rectangle: for each x the best y is known, and what is left is convex.
double least_form(const Ellipse& e, double x0, double x1, double y0, double y1) {
  auto best = [&](double x) {
    const double dx = x - e.mean.x;
    const double y = std::min(std::max(e.mean.y - e.conic.xy * dx / e.conic.yy, y0), y1), dy = y - e.mean.y;
    return e.conic.xx * dx * dx + 2 * e.conic.xy * dx * dy + e.conic.yy * dy * dy;
  };
  for (int step = 0; step < 100; ++step) {
    const double left = x0 + (x1 - x0) / 3, right = x1 - (x1 - x0) / 3;
    (best(left) < best(right) ? x1 : x0) = best(left) < best(right) ? right : left;
  }
  return best(0.5 * (x0 + x1));
}

template <class S> Sym2<S> narrowed(const Sym2<double>& c) { return {S(c.xx), S(c.xy), S(c.yy)}; }
template <class S> Vec2<S> narrowed(Vec2<double> v) { return {S(v.x), S(v.y)}; }

template <class S> std::vector<bool> visited_tiles(const Ellipse& e, TileRect bounds, TileGrid grid) {
  std::vector<bool> visited(grid.columns * grid.rows);
  for_each_tile_row(narrowed<S>(e.conic), narrowed<S>(e.mean), S(e.reach), bounds, [&](int x0, int x1, int y) {
    EXPECT_LT(x0, x1);
    for (int x = x0; x < x1; ++x) {
      EXPECT_FALSE(visited[y * grid.columns + x]) << "twice";
      visited[y * grid.columns + x] = true;
    }
  });
  return visited;
}

template <class S> bool within_reach(const Ellipse& e, int x, int y) {
  const ColumnExponent<S, S> exponent(narrowed<S>(e.conic), S(x) - S(e.mean.x));
  return exponent.at(S(y) - S(e.mean.y)) >= S(-0.5) * S(e.reach);
}

template <class S> void expect_every_pixel_that_counts_is_in_a_visited_tile(const std::vector<Ellipse>& ellipses) {
  const TileGrid grid(kWidth, kHeight);
  int counted = 0;
  for (const Ellipse& e : ellipses) {
    const auto visited = visited_tiles<S>(e, {0, 0, grid.columns, grid.rows}, grid);
    for (int y = 0; y < kHeight; ++y) {
      for (int x = 0; x < kWidth; ++x) {
        if (!within_reach<S>(e, x, y)) continue;
        ++counted;
        ASSERT_TRUE(visited[y / kTileSize * grid.columns + x / kTileSize])
            << "pixel " << x << ", " << y << " mean " << e.mean.x << ", " << e.mean.y << " conic " << e.conic.xx << ", "
            << e.conic.xy << ", " << e.conic.yy << " reach " << e.reach;
      }
    }
  }
  EXPECT_GT(counted, 10000);
}

TEST(ForEachTileRow, VisitsTheTileOfEveryPixelThatCounts) {
  expect_every_pixel_that_counts_is_in_a_visited_tile<double>(random_ellipses(1500, 1e5, 1e5));
  // In float the exponent of a needle carries the rounding of its short axis: beyond some thousand pixels of length
  // that exceeds the slack.
  expect_every_pixel_that_counts_is_in_a_visited_tile<float>(random_ellipses(1500, 1000, 1000));
}

// Conics of needles whose float entries have a determinant of 0 or less: which pixels count is known, in double.
TEST(ForEachTileRow, VisitsTheTileOfEveryPixelWhereTheDeterminantIsLost) {
  const TileGrid grid(kWidth, kHeight);
  Random random(9);
  int needles = 0, rows = 0;
  for (int i = 0; i < 400; ++i) {
    const Vec2<double> mean = {kWidth * random.uniform(0, 1), kHeight * random.uniform(0, 1)};
    const Ellipse e =
        make_ellipse(random.log_uniform(2e3, 1e5), 0.55, random.uniform(0, 3.2), mean, random.uniform(1, 23.03));
    const auto conic = narrowed<float>(e.conic);
    const double xx = conic.xx, xy = conic.xy, yy = conic.yy;
    if (xx * yy - xy * xy > 0) continue;
    ++needles;
    const auto visited = visited_tiles<float>(e, {0, 0, grid.columns, grid.rows}, grid);
    int first = kHeight, last = -1;
    for (int y = 0; y < kHeight; ++y) {
      for (int x = 0; x < kWidth; ++x) {
        const double dx = x - double(float(mean.x)), dy = y - double(float(mean.y));
        if (xx * dx * dx + 2 * xy * dx * dy + yy * dy * dy > e.reach) continue;
        first = std::min(first, y / kTileSize), last = std::max(last, y / kTileSize);
        ASSERT_TRUE(visited[y / kTileSize * grid.columns + x / kTileSize])
            << "needle " << i << " pixel " << x << ", " << y;
      }
    }
    rows += last > first;
  }
  EXPECT_GT(needles, 50);
  EXPECT_GT(rows, 50) << "needles that reach more than one row of tiles";
}

TEST(ForEachTileRow, VisitsOnlyTilesThatTheEllipseMeets) {
  const TileGrid grid(kWidth, kHeight);
  int visited_count = 0, met = 0;
  for (const Ellipse& e : random_ellipses(800, 1e3, 1e3)) {
    const auto visited = visited_tiles<double>(e, {0, 0, grid.columns, grid.rows}, grid);
    for (int y = 0; y < grid.rows; ++y) {
      for (int x = 0; x < grid.columns; ++x) {
        // Between the centres of a whole tile's border pixels, also if the image ends earlier.
        const double least = least_form(e, 16 * x, 16 * x + 15, 16 * y, 16 * y + 15);
        met += least <= e.reach;
        if (!visited[y * grid.columns + x]) continue;
        ++visited_count;
        // kFootprintSlack, relative and absolute, and rounding.
        EXPECT_LE(least, e.reach * 1.001 + 0.001 + 1e-9);
      }
    }
  }
  EXPECT_GT(met, 1000);
  EXPECT_GE(visited_count, met);
}

TEST(ForEachTileRow, StaysInItsBounds) {
  const TileGrid grid(kWidth, kHeight);
  const TileRect bounds = {1, 2, 5, 4};
  for (const Ellipse& e : random_ellipses(300, 1e3, 1e2)) {
    const auto inside = visited_tiles<double>(e, bounds, grid);
    const auto all = visited_tiles<double>(e, {0, 0, grid.columns, grid.rows}, grid);
    for (int y = 0; y < grid.rows; ++y) {
      for (int x = 0; x < grid.columns; ++x) {
        const bool in_bounds = x >= 1 && x < 5 && y >= 2 && y < 4;
        EXPECT_EQ(inside[y * grid.columns + x], all[y * grid.columns + x] && in_bounds);
      }
    }
  }
}

TEST(ForEachTileRow, VisitsNothingWithoutReachOrBounds) {
  const TileGrid grid(kWidth, kHeight);
  int visits = 0;
  auto count = [&](int, int, int) { ++visits; };
  const Sym2<double> conic = {1, 0, 1};
  for_each_tile_row(conic, {50.0, 30.0}, -1.0, {0, 0, grid.columns, grid.rows}, count);
  for_each_tile_row(conic, {50.0, 30.0}, std::nan(""), {0, 0, grid.columns, grid.rows}, count);
  for_each_tile_row(conic, {50.0, 30.0}, 9.0, {3, 3, 3, 5}, count);
  EXPECT_EQ(visits, 0);
  for_each_tile_row(conic, {50.0, 30.0}, 0.0, {0, 0, grid.columns, grid.rows}, count);
  EXPECT_EQ(visits, 1) << "a reach of 0 still holds the centre";
}

TEST(EllipseBand, IsTheExtentOfTheEllipseOverTheBand) {
  int hits = 0, misses = 0;
  Random random(2);
  for (const Ellipse& e : random_ellipses(1000, 1e3, 1e3)) {
    const EllipseBand<double> ellipse(e.conic, e.reach);
    const double low = random.uniform(-1.5, 1.2) * ellipse.v_extent();
    const double high = low + random.uniform(0, 0.7) * ellipse.v_extent();
    const auto u = ellipse.over({low, high});
    const Ellipse centred = {e.conic, {0, 0}, e.reach};
    const double everywhere = 1e9;
    if (u.empty()) {
      ++misses;
      EXPECT_GT(least_form(centred, -everywhere, everywhere, low, high), e.reach);
      continue;
    }
    ++hits;
    // At either end the ellipse just reaches the band: its form there is reach, up to the slack.
    for (const double end : {u.low, u.high}) {
      const double least = least_form(centred, end, end, low, high);
      EXPECT_GE(least, e.reach);
      EXPECT_LE(least, e.reach * 1.001 + 0.001 + 1e-6);
    }
  }
  EXPECT_GT(hits, 300);
  EXPECT_GT(misses, 50);
}

// The definition: tiles [floor((p - r) / 16), floor((p + r + 15) / 16)), cut to the grid.
TEST(RadiusRect, IsInriasRectangle) {
  const TileGrid grid(kWidth, kHeight);
  Random random(3);
  for (int i = 0; i < 2000; ++i) {
    const double px = random.uniform(-200, 300), py = random.uniform(-200, 300), r = std::ceil(random.uniform(0, 80));
    const TileRect rect = radius_rect<double>({px, py}, r, grid);
    for (int x = 0; x < grid.columns; ++x) {
      const bool inside = x >= std::floor((px - r) / 16) && x < std::floor((px + r + 15) / 16);
      EXPECT_EQ(x >= rect.x0 && x < rect.x1, inside);
    }
    for (int y = 0; y < grid.rows; ++y) {
      const bool inside = y >= std::floor((py - r) / 16) && y < std::floor((py + r + 15) / 16);
      EXPECT_EQ(y >= rect.y0 && y < rect.y1, inside);
    }
  }
}

template <class S> void expect_huge_numbers_are_clamped() {
  const TileGrid grid(kWidth, kHeight);
  for (const S huge : {S(1e10), S(1e30), std::numeric_limits<S>::infinity()}) {
    EXPECT_TRUE(radius_rect<S>({huge, 10}, 5, grid).empty());
    EXPECT_TRUE(radius_rect<S>({-huge, 10}, 5, grid).empty());
    EXPECT_TRUE(radius_rect<S>({10, -huge}, 5, grid).empty());
    const TileRect all = radius_rect<S>({10, 10}, huge, grid);
    EXPECT_EQ(all.x0, 0);
    EXPECT_EQ(all.y0, 0);
    EXPECT_EQ(all.x1, grid.columns);
    EXPECT_EQ(all.y1, grid.rows);
  }
  for (const auto to_int : {floor_to_int<S>, ceil_to_int<S>}) {
    EXPECT_EQ(to_int(std::numeric_limits<S>::quiet_NaN(), 2, 7), 2);
    EXPECT_EQ(to_int(S(1e30), 2, 7), 7);
    EXPECT_EQ(to_int(S(-1e30), 2, 7), 2);
    EXPECT_EQ(to_int(S(4), 2, 7), 4);
  }
  EXPECT_EQ(floor_to_int(S(4.75), 2, 7), 4);
  EXPECT_EQ(ceil_to_int(S(4.25), 2, 7), 5);
}

TEST(RadiusRect, TakesCoordinatesBeyondEveryInteger) {
  expect_huge_numbers_are_clamped<float>();
  expect_huge_numbers_are_clamped<double>();
}

TEST(TileGrid, CoversTheImage) {
  for (int size = 1; size < 100; ++size) {
    const TileGrid grid(size, 200 - size);
    EXPECT_GE(grid.columns * kTileSize, size);
    EXPECT_LT((grid.columns - 1) * kTileSize, size);
    EXPECT_GE(grid.rows * kTileSize, 200 - size);
    EXPECT_LT((grid.rows - 1) * kTileSize, 200 - size);
  }
}

TEST(MeetsImage, AgreesWithTheLeastFormOverTheImage) {
  int inside = 0, outside = 0;
  for (const Ellipse& e : random_ellipses(5000, 1e4, 1e4)) {
    const double least = least_form(e, 0, kWidth - 1, 0, kHeight - 1);
    if (std::abs(least - e.reach) < 1e-6 * e.reach) continue;  // too close for the search by thirds
    const bool expected = least <= e.reach;
    ++(expected ? inside : outside);
    EXPECT_EQ(meets_image(e.conic, e.mean, e.reach, kWidth, kHeight), expected);
  }
  EXPECT_GT(inside, 1000);
  EXPECT_GT(outside, 1000);
}

TEST(MeetsImage, HoldsWhereverASampleOfTheImageIsInReach) {
  for (const Ellipse& e : random_ellipses(1000, 1e3, 1e2)) {
    bool sampled = false;
    for (double y = 0; y <= kHeight - 1 && !sampled; y += 0.5) {
      for (double x = 0; x <= kWidth - 1 && !sampled; x += 0.5) {
        const double dx = x - e.mean.x, dy = y - e.mean.y;
        sampled = e.conic.xx * dx * dx + 2 * e.conic.xy * dx * dy + e.conic.yy * dy * dy < e.reach;
      }
    }
    if (sampled) {
      EXPECT_TRUE(meets_image(e.conic, e.mean, e.reach, kWidth, kHeight));
    }
  }
}

TEST(MeetsImage, CountsTheBordersPixelCentres) {
  const Sym2<double> conic = {1, 0, 1};
  EXPECT_TRUE(meets_image(conic, {-2.0, 5.0}, 4.0, 10, 10));
  EXPECT_FALSE(meets_image(conic, {-2.001, 5.0}, 4.0, 10, 10));
  EXPECT_TRUE(meets_image(conic, {11.0, 5.0}, 4.0, 10, 10));  // the last centre is 9
  EXPECT_FALSE(meets_image(conic, {11.001, 5.0}, 4.0, 10, 10));
  EXPECT_FALSE(meets_image(conic, {-1.5, -1.5}, 4.0, 10, 10)) << "past the corner";
}

}  // namespace
}  // namespace dsmoe
