// From run-time values to template arguments: the only such switch.
#pragma once

#include <type_traits>

#include "dsmoe/gate.h"

namespace dsmoe {

// The number of features that is known when compiling: 3 is the fast path, 0 stands for any.
constexpr int kAnyFeatures = 0;

template <BlendMode kMode> using ModeConstant = std::integral_constant<BlendMode, kMode>;
template <int kFeatures> using FeaturesConstant = std::integral_constant<int, kFeatures>;

// Calls body(ModeConstant<mode>, FeaturesConstant<3 or kAnyFeatures>).
template <class Body> inline void dispatch_blend(BlendMode mode, int num_features, Body body) {
  auto with_mode = [&](auto mode_constant) {
    if (num_features == 3) {
      body(mode_constant, FeaturesConstant<3>{});
    } else {
      body(mode_constant, FeaturesConstant<kAnyFeatures>{});
    }
  };
  switch (mode) {
    case BlendMode::kAlpha:
      return with_mode(ModeConstant<BlendMode::kAlpha>{});
    case BlendMode::kSmoe:
      return with_mode(ModeConstant<BlendMode::kSmoe>{});
    case BlendMode::kSmoeTn:
      return with_mode(ModeConstant<BlendMode::kSmoeTn>{});
    case BlendMode::kSmoeStd:
      return with_mode(ModeConstant<BlendMode::kSmoeStd>{});
  }
}

}  // namespace dsmoe
