// From run-time values to template arguments.
#include "dispatch.h"

#include <gtest/gtest.h>

#include "all_modes.h"

namespace dsmoe {
namespace {

TEST(DispatchBlend, HandsOnEveryModeAndTheFastNumberOfFeatures) {
  for (const BlendMode wanted : kAllModes) {
    for (const int features : {1, 2, 3, 4, 32}) {
      int calls = 0;
      dispatch_blend(wanted, features, [&](auto mode, auto num_features) {
        ++calls;
        EXPECT_EQ(mode(), wanted);
        EXPECT_EQ(num_features(), features == 3 ? 3 : kAnyFeatures);
      });
      EXPECT_EQ(calls, 1);
    }
  }
}

}  // namespace
}  // namespace dsmoe
