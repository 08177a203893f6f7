// Rows by a list.
#include "dsmoe/training/gather.h"

#include <gtest/gtest.h>

#include <vector>

namespace dsmoe {
namespace {

TEST(Gather, RowsOfTwoTensorsAgainAndAgain) {
  const std::vector<float> one = {0, 1, 2, 3}, three = {0, 1, 2, 10, 11, 12, 20, 21, 22, 30, 31, 32};
  const std::vector<int64_t> rows = {3, 0, 0, 2, 3};
  std::vector<float> from_one(5), from_three(15);
  const std::vector<GatherTensor<float>> tensors = {{one.data(), from_one.data(), 1},
                                                    {three.data(), from_three.data(), 3}};
  cpu::gather_rows(tensors, {rows.data(), 5}, 2);
  EXPECT_EQ(from_one, (std::vector<float>{3, 0, 0, 2, 3}));
  EXPECT_EQ(from_three, (std::vector<float>{30, 31, 32, 0, 1, 2, 0, 1, 2, 20, 21, 22, 30, 31, 32}));
}

TEST(Gather, NothingOfNothing) {
  cpu::gather_rows<double>({{nullptr, nullptr, 3}}, {nullptr, 0}, 1);
  cpu::gather_rows<double>({}, {nullptr, 0}, 1);
}

}  // namespace
}  // namespace dsmoe
