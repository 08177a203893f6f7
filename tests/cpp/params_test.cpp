// The structs that go in and out.
#include "dsmoe/params.h"

#include <gtest/gtest.h>

namespace dsmoe {
namespace {

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
