// From run-time values to template arguments: the only such switch.
#pragma once

#include <type_traits>

#include "dsmoe/blend.h"
#include "dsmoe/features.h"

namespace dsmoe {

// Stands for a number of features that is not known when compiling. Else it is kFastFeatures.
constexpr int kAnyFeatures = 0;

template <int kFeatures> using FeaturesConstant = std::integral_constant<int, kFeatures>;

// Calls body(ModeConstant<mode>, FeaturesConstant<kFastFeatures or kAnyFeatures>).
template <class Body> inline void dispatch_blend(BlendMode mode, int num_features, Body body) {
  BlendModes::for_each([&](auto mode_constant) {
    if (mode_constant() != mode) return;
    if (num_features == kFastFeatures) {
      body(mode_constant, FeaturesConstant<kFastFeatures>{});
    } else {
      body(mode_constant, FeaturesConstant<kAnyFeatures>{});
    }
  });
}

}  // namespace dsmoe
