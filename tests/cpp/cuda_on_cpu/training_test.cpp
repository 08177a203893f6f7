// The trainers' CUDA kernels, run on the CPU by the emulator.
#include <gtest/gtest.h>

#include <numeric>
#include <vector>

#include "dsmoe/training/adam.h"
#include "dsmoe/training/neighbors.h"
#include "finite_difference.h"
#include "refusal.h"

namespace dsmoe {
namespace {

TEST(Kernels, NoteTheRatesOfAStepOfNoRows) {
  AdamRates<float> noted[] = {{7, 7}, {7, 7}};
  const LazyAdamStep<float> step = {0, nullptr, nullptr, noted, {{0.25, 3}, {0.5, 4}}, 1, 0, nullptr, nullptr};
  cuda::note_step(step, nullptr);
  EXPECT_EQ(noted[0].rate, 0.25f);
  EXPECT_EQ(noted[1].rate, 7) << "of one tensor";
  EXPECT_NO_THROW(cuda::note_step<float>({}, nullptr));
}

TEST(Kernels, FindTheNeighboursThatTheCpuFinds) {
  Random random(1);
  for (const int64_t count : {1, 2, 3, 4, cuda::kBoxPoints, 2 * cuda::kBoxPoints + 1}) {
    std::vector<float> points(3 * count), actual(count, NAN), expected(count), boxes(3 * 6);
    for (int64_t i = 0; i < 3 * count; ++i) {  // boxes overlap at their corners
      points[i] = static_cast<float>(random.uniform(-1, 1) + 1.5 * (i / (3 * cuda::kBoxPoints)));
    }
    std::vector<int64_t> order(count);
    std::iota(order.rbegin(), order.rend(), 0);
    cuda::mean_squared_distances<float>({points.data(), count, order.data(), boxes.data(), actual.data()}, nullptr);
    cpu::mean_squared_distances(points.data(), count, expected.data(), 1);
    for (int64_t i = 0; i < count; ++i) {
      // The CPU sums in double. Differences of floats, their squares and 6 sums are rounded by 6e-8 each.
      EXPECT_NEAR(actual[order[i]], expected[i], 1e-6 * expected[i]) << i << " of " << count;
    }
  }
}

TEST(Kernels, RefuseNeighboursOfNothing) {
  float numbers[6] = {};
  const int64_t order[] = {0};
  const cuda::NeighborDistances<float> good = {numbers, 1, order, numbers, numbers};
  const auto refuses = [&](auto spoil, const std::string& name, const std::string& shape) {
    cuda::NeighborDistances<float> bad = good;
    spoil(bad);
    expect_refusal([&] { cuda::mean_squared_distances(bad, nullptr); },
                   "cuda::mean_squared_distances: " + name + " is null; it must point to an array " + shape);
  };
  refuses([](auto& s) { s.points = nullptr; }, "points", "[N, 3]");
  refuses([](auto& s) { s.order = nullptr; }, "order", "[N]");
  refuses([](auto& s) { s.boxes = nullptr; }, "boxes", "[ceil(N / kBoxPoints), 2, 3]");
  refuses([](auto& s) { s.result = nullptr; }, "result", "[N]");
  EXPECT_NO_THROW(cuda::mean_squared_distances<float>({}, nullptr));
  EXPECT_NO_THROW(cuda::morton_codes<float>({}, nullptr));
}

}  // namespace
}  // namespace dsmoe
