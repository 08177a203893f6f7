// What a pass over the pixels of a rendering is: it walks the tiles' lists once more, front to back, and reads no
// features. csrc/cpu/tile_pass_impl.h and csrc/cuda/pass.cuh have the walks. A pass is a struct of S with its maps, and
//
//   arrays(visit, count)   visits what a caller gives: its name, array, shape, and number of elements. Where that is
//                  above 0 the array must not be null. count: of the Gaussians
//   State<Real>    what it knows of a pixel, or of a pack of pixels; `for_each` visits its kNum numbers
//   begin<kMode>(pixel)   the State in front of all pairs; outside the image all its numbers are 0
//   Sums<Real>     what it sums over the pixels of each Gaussian; `for_each` visits several Gaussians' side by side. Or
//                  NoSums
//   visit<kMode>(walked, state, pair, sums)   moves a pixel past a pair. Returns whether the pair adds to the sums
//
// With sums the visits leave the State as it is:
//
//   kCounts        whether the first of the sums is a whole number
//   targets()      where they go
//
// Without them the State is also what the visits have found:
//
//   end(state, pixel, gaussian_at)   writes it. gaussian_at(i): entry i of the tile's list
#pragma once

#include <cstdint>

#include "dsmoe/blend.h"

namespace dsmoe {

struct NoSums {
  static constexpr int kNum = 0;
};

// Where sums go.
template <class S> struct SumTargets {
  static constexpr int kMost = 3;
  S* numbers[kMost];          // [N] each of the real numbers
  int count;                  // of these
  int32_t* counts = nullptr;  // [N] the whole number in front of them, or null
};

// A pair of a walk.
template <class Real> struct WalkedPair {
  Gate<Real> gate;
  Real dx, dy;         // pixel - centre
  Whole<Real> seen;    // entries of the tile's list up to this one, itself too
  Mask<Real> blended;  // the pixel's last pair is not in front of it
};

}  // namespace dsmoe
