// From run-time values to template arguments: the only such switch.
#pragma once

#include <type_traits>

#include "dsmoe/blend.h"

namespace dsmoe {

// The number of features that is known when compiling: 3 is the fast path, 0 stands for any.
constexpr int kAnyFeatures = 0;

template <int kFeatures> using FeaturesConstant = std::integral_constant<int, kFeatures>;

// Calls body(ModeConstant<mode>, FeaturesConstant<3 or kAnyFeatures>).
template <class Body> inline void dispatch_blend(BlendMode mode, int num_features, Body body) {
  BlendModes::for_each([&](auto mode_constant) {
    if (mode_constant() != mode) return;
    if (num_features == 3) {
      body(mode_constant, FeaturesConstant<3>{});
    } else {
      body(mode_constant, FeaturesConstant<kAnyFeatures>{});
    }
  });
}

}  // namespace dsmoe
