// For how many tile instances there is room: by the greatest of the last counts.
#include "cuda/recent_greatest.h"

#include <gtest/gtest.h>

namespace dsmoe {
namespace {

TEST(RecentGreatest, KnowsNothingAtFirst) { EXPECT_EQ(RecentGreatest().greatest(), -1); }

TEST(RecentGreatest, RemembersTheGreatestForAWindow) {
  RecentGreatest recent;
  recent.add(5);
  recent.add(900);
  for (int i = 0; i < RecentGreatest::kWindow; ++i) {
    EXPECT_EQ(recent.greatest(), 900);
    recent.add(7);
  }
}

TEST(RecentGreatest, ForgetsAnOutlier) {
  RecentGreatest recent;
  recent.add(900);
  for (int i = 0; i < 2 * RecentGreatest::kWindow; ++i) recent.add(i % 10);
  EXPECT_EQ(recent.greatest(), 9);
}

}  // namespace
}  // namespace dsmoe
