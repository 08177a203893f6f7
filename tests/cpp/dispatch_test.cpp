// From run-time values to template arguments.
#include "dispatch.h"

#include <gtest/gtest.h>

#include <set>
#include <string>

#include "all_modes.h"

namespace dsmoe {
namespace {

TEST(DispatchBlend, HandsOnEveryModeAndTheFastNumberOfFeatures) {
  for (const BlendMode wanted : all_modes()) {
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

TEST(BlendModes, AreInTheOrderOfTheirNumbersAndHaveNamesOfTheirOwn) {
  std::set<std::string> names;
  int number = 0;
  BlendModes::for_each([&](auto mode) {
    EXPECT_EQ(static_cast<int>(mode()), number++);
    names.insert(Blend<mode()>::kName);
  });
  EXPECT_EQ(number, BlendModes::kSize);
  EXPECT_EQ(static_cast<int>(names.size()), BlendModes::kSize);
}

}  // namespace
}  // namespace dsmoe
