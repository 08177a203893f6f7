// The blend modes as types and as values, for tests that hold in each.
#pragma once

#include <gtest/gtest.h>

#include <tuple>
#include <vector>

#include "dispatch.h"

namespace dsmoe {

template <class Tuple> struct TypesOf;
template <class... Modes> struct TypesOf<std::tuple<Modes...>> { using Type = testing::Types<Modes...>; };

template <BlendMode kMode>
using IfDividing = std::conditional_t<Blend<kMode>::kDivides, std::tuple<ModeConstant<kMode>>, std::tuple<>>;

template <class List> struct TypesOfModes;
template <BlendMode... kModes> struct TypesOfModes<ModeList<kModes...>> {
  using All = testing::Types<ModeConstant<kModes>...>;
  using Dividing = typename TypesOf<decltype(std::tuple_cat(IfDividing<kModes>{}...))>::Type;
};
using AllModes = TypesOfModes<BlendModes>::All;
using GatedModes = TypesOfModes<BlendModes>::Dividing;

inline std::vector<BlendMode> all_modes() {
  std::vector<BlendMode> modes;
  BlendModes::for_each([&](auto mode) { modes.push_back(mode()); });
  return modes;
}

}  // namespace dsmoe
