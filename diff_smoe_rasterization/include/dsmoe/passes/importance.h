// What each Gaussian is worth to an image. It also reads the features, so each backend has a walk of its own for it.
#pragma once

#include "dsmoe/params.h"
#include "dsmoe/passes/pass.h"
#include "dsmoe/removal.h"

namespace dsmoe {

template <class S> struct ImportancePass {
  template <class Real> using Sums = Importance<Real>;
  SumTargets<S> targets() const { return {{map.sums.shares, map.sums.squared_shares, map.sums.removal_costs}, 3}; }

  ImportanceMap<S> map;
};

}  // namespace dsmoe
