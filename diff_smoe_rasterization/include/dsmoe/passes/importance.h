// What each Gaussian is worth to an image. It also reads the features, so each backend has a walk of its own for it.
#pragma once

#include "dsmoe/params.h"
#include "dsmoe/passes/pass.h"
#include "dsmoe/removal.h"

namespace dsmoe {

template <class S> struct ImportancePass {
  template <class Real> using Sums = Importance<Real>;

  template <class Visit> void arrays(Visit visit, int64_t count) const {
    visit("color", map.color, "[C, H, W]", 1);
    visit("pixel_weights", map.pixel_weights, "[H, W]", 1);
    visit("share_weights", map.share_weights, "[H, W]", 1);
    visit("sums.shares", map.sums.shares, "[N]", count);
    visit("sums.squared_shares", map.sums.squared_shares, "[N]", count);
    visit("sums.removal_costs", map.sums.removal_costs, "[N]", count);
  }
  SumTargets<S> targets() const { return {{map.sums.shares, map.sums.squared_shares, map.sums.removal_costs}, 3}; }

  ImportanceMap<S> map;
};

}  // namespace dsmoe
