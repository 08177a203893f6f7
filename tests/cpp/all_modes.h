// The blend modes as types and as values, for tests that hold in each.
#pragma once

#include <gtest/gtest.h>

#include <tuple>
#include <vector>

#include "dispatch.h"
#include "dsmoe/removal.h"

namespace dsmoe {

template <class Tuple> struct TypesOf;
template <class... Modes> struct TypesOf<std::tuple<Modes...>> { using Type = testing::Types<Modes...>; };

template <BlendMode kMode>
constexpr bool kDividesByGates = Blend<kMode>::kDivides && (Blend<kMode>::kLaw == Law::kGates);

template <BlendMode kMode, bool kIf>
using ModeIf = std::conditional_t<kIf, std::tuple<ModeConstant<kMode>>, std::tuple<>>;

template <class List> struct TypesOfModes;
template <BlendMode... kModes> struct TypesOfModes<ModeList<kModes...>> {
  using All = testing::Types<ModeConstant<kModes>...>;
  using Gated = typename TypesOf<decltype(std::tuple_cat(ModeIf<kModes, kDividesByGates<kModes>>{}...))>::Type;
  using Resuming = typename TypesOf<decltype(std::tuple_cat(ModeIf<kModes, kResumes<kModes>>{}...))>::Type;
  using Removable = typename TypesOf<decltype(std::tuple_cat(ModeIf<kModes, kRemovable<kModes>>{}...))>::Type;
};
using AllModes = TypesOfModes<BlendModes>::All;
using GatedModes = TypesOfModes<BlendModes>::Gated;
using ResumingModes = TypesOfModes<BlendModes>::Resuming;
using RemovableModes = TypesOfModes<BlendModes>::Removable;

inline bool is_removable(BlendMode mode) {
  bool removable = false;
  BlendModes::for_each([&](auto of) { removable |= of() == mode && kRemovable<decltype(of)::value>; });
  return removable;
}

inline std::vector<BlendMode> all_modes() {
  std::vector<BlendMode> modes;
  BlendModes::for_each([&](auto mode) { modes.push_back(mode()); });
  return modes;
}

}  // namespace dsmoe
