// The structs that go in and out.
#include "dsmoe/params.h"

#include <gtest/gtest.h>

namespace dsmoe {
namespace {

TEST(RasterConfig, CountsItsFurtherFeatures) {
  RasterConfig<float> config;
  config.num_channels = 5;
  EXPECT_EQ(config.num_features(), 5);
  config.depth = config.inverse_depth = true;
  EXPECT_EQ(config.num_features(), 5 + kMostFurtherFeatures);
  config.leave_out_further_features();
  EXPECT_EQ(config.num_features(), 5);
}

TEST(BlendModeOf, FindsEveryModeByItsName) {
  BlendModes::for_each([](auto mode) { EXPECT_EQ(blend_mode_of(Blend<decltype(mode)::value>::kName), mode()); });
  EXPECT_FALSE(blend_mode_of("Smoe"));
  EXPECT_FALSE(blend_mode_of(""));
}

TEST(ProjectedGaussian, IsAsManyNumbersAsItsConstantSays) {
  // Bindings allocate it as an array of numbers.
  EXPECT_EQ(sizeof(ProjectedGaussian<float>), kProjectedGaussianSize * sizeof(float));
  EXPECT_EQ(sizeof(ProjectedGaussian<double>), kProjectedGaussianSize * sizeof(double));
}

TEST(TileInstance, IsTwoWords) { EXPECT_EQ(sizeof(TileInstance), 8u); }

TEST(RasterConfig, CountsItsFeatures) {
  RasterConfig<float> config;
  EXPECT_EQ(config.num_features(), 3);
  config.depth = true;
  EXPECT_EQ(config.num_features(), 4);
  config.inverse_depth = true;
  config.num_channels = 7;
  EXPECT_EQ(config.num_features(), 9);
}

}  // namespace
}  // namespace dsmoe
