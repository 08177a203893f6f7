// The blend modes as types, for tests that hold in each.
#pragma once

#include <gtest/gtest.h>

#include "dispatch.h"

namespace dsmoe {

using AllModes = testing::Types<ModeConstant<BlendMode::kAlpha>, ModeConstant<BlendMode::kSmoe>,
                                ModeConstant<BlendMode::kSmoeTn>, ModeConstant<BlendMode::kSmoeStd>>;
using GatedModes =
    testing::Types<ModeConstant<BlendMode::kSmoe>, ModeConstant<BlendMode::kSmoeTn>, ModeConstant<BlendMode::kSmoeStd>>;
constexpr BlendMode kAllModes[] = {BlendMode::kAlpha, BlendMode::kSmoe, BlendMode::kSmoeTn, BlendMode::kSmoeStd};

}  // namespace dsmoe
