// How a rendering blends: a mode and its parameters, as one value from the caller to the kernels. The modes are in
// blend.h.
#pragma once

#include <limits>

#include "dsmoe/blend.h"

namespace dsmoe {

constexpr float kFaintBelowOfMode = -std::numeric_limits<float>::infinity();

template <class S> struct BlendRules {
  BlendMode mode = BlendMode::kAlpha;
  S alpha_min = 0;        // SMoE modes: pairs with alpha below this do not count; in kSmoe they are tails
  S background_gate = 0;  // lambda of kSmoe and kSmoeEq7, 0 or more
  // kSmoe, kSmoeEq7: faint pairs and tails count in pixels whose near pairs have a smaller gate sum than this: with 2
  // in all, with 0 in none; kFaintBelowOfMode: the mode's default
  S faint_below = S(kFaintBelowOfMode);
  const S* background_gate_at = nullptr;  // [1] where lambda lies instead, or null

  DSMOE_HD S lambda() const { return background_gate_at != nullptr ? *background_gate_at : background_gate; }
  DSMOE_HD AlphaCut<S> alpha_cut() const { return {alpha_min, cut_of(mode) == Cut::kKernel ? lambda() : S(0)}; }
  DSMOE_HD S wide_below() const { return faint_below == S(kFaintBelowOfMode) ? S(faint_below_of(mode)) : faint_below; }
  // Whether a pixel is first blended with its near pairs only.
  DSMOE_HD bool blends_near_first() const { return near_first(mode) && wide_below() <= S(1); }
  // The least alpha of a tail.
  DSMOE_HD S tail_alpha() const { return S(blends_near_first() ? kTailAlpha : kEveryTailAlpha); }
  // What the tails reach beyond the strong pairs: is added to the squared reach of a footprint where tiles are listed.
  DSMOE_HD S tail_reach() const {
    return has_tails(mode) ? S(2) * log(max(alpha_min, S(kStrongAlpha)) / tail_alpha()) : S(0);
  }

  // The same rules in another precision. Lambda is read: it must lie where the caller can read it.
  template <class To> BlendRules<To> as() const {
    return {mode, static_cast<To>(alpha_min), static_cast<To>(lambda()), static_cast<To>(faint_below), nullptr};
  }
};

}  // namespace dsmoe
