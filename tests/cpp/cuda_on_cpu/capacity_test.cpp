// For how many tile instances there is room before the device has counted them.
#include "diff_smoe_rasterization/csrc/cuda/capacity.h"

#include <gtest/gtest.h>

#include "diff_smoe_rasterization/csrc/cuda/scratch.h"

namespace dsmoe {
namespace cuda {
namespace {

using Key = InstanceCapacities::Key;

// Renders so many instances of so many Gaussians, as far as the table is concerned. Returns how many it had room for.
int64_t render(InstanceCapacities& capacities, int64_t num_gaussians, int64_t instances, int64_t width = 800) {
  const Key key = InstanceCapacities::key(0, width, 600, 0, num_gaussians);
  const int64_t room = capacities.likely(key, num_gaussians);
  capacities.learn(key, num_gaussians, &instances, nullptr);
  return room;
}

TEST(InstanceCapacities, KnowNothingAtFirst) {
  InstanceCapacities capacities;
  EXPECT_EQ(render(capacities, 1'000'000, 5'000'000), -1);
  EXPECT_GT(render(capacities, 1'000'000, 5'000'000), 5'000'000);
}

TEST(InstanceCapacities, GrowWithTheNumberOfGaussians) {
  InstanceCapacities capacities;
  for (int i = 0; i < 100; ++i) render(capacities, 600'000, 6'000'000);  // more than the first calls, which get more
  EXPECT_GT(render(capacities, 1'000'000, 10'000'000), 10'000'000);
}

TEST(InstanceCapacities, KnowTwiceAndHalfAsManyGaussians) {
  InstanceCapacities capacities;
  for (int i = 0; i < 100; ++i) render(capacities, 500'000, 5'000'000);  // 2^19 is 524'288
  EXPECT_GT(render(capacities, 530'000, 5'300'000), 5'300'000);
  EXPECT_GT(render(capacities, 530'000, 5'300'000), 5'300'000) << "what it learned anew";
  EXPECT_GT(render(capacities, 260'000, 2'600'000), 2'600'000);
  EXPECT_EQ(render(capacities, 60'000, 600'000), -1);
}

TEST(InstanceCapacities, GiveAGraphHalfAsMuchAgain) {
  InstanceCapacities capacities;
  for (int i = 0; i < 100; ++i) render(capacities, 500'000, 5'000'000);
  const Key key = InstanceCapacities::key(0, 800, 600, 0, 500'000);
  EXPECT_LT(capacities.likely(key, 500'000), 6'000'000);
  EXPECT_GT(capacities.likely(key, 500'000, true), 7'500'000);
  EXPECT_EQ(capacities.greatest(key, 500'000), 5'000'000);
}

TEST(InstanceCapacities, ForgetTheSizeThatWasLongestNotUsed) {
  InstanceCapacities capacities;
  const auto most = static_cast<int64_t>(InstanceCapacities::kMostKeys);
  for (int64_t width = 1; width <= most; ++width) render(capacities, 100, 900, width);
  EXPECT_GT(render(capacities, 100, 900, 1), 900);
  EXPECT_EQ(render(capacities, 100, 900, most + 1), -1);
  EXPECT_GT(render(capacities, 100, 900, most + 1), 900) << "a size after the table was full";
  EXPECT_GT(render(capacities, 100, 900, 1), 900) << "a size that was used lately";
  EXPECT_EQ(render(capacities, 100, 900, 2), -1) << "the size that was longest not used";
}

TEST(InstanceCapacities, LeaveACaptureOnAnotherThreadAlone) {
  InstanceCapacities capacities;
  const int64_t count = 7;
  emulator::other_captures = true;
  EXPECT_NO_THROW(render(capacities, 100, 900));
  EXPECT_EQ(read(&count, "counting", nullptr), 7);
  const cudaError_t after = cudaStreamSynchronize(nullptr);
  emulator::other_captures = false;
  EXPECT_EQ(after, cudaErrorStreamCaptureUnsupported) << "the thread went back to the rules";
}

}  // namespace
}  // namespace cuda
}  // namespace dsmoe
