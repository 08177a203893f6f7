// Distances to the nearest other points, on the CPU and on a GPU.
#pragma once

#include <cstdint>

namespace dsmoe {

constexpr int kNeighbors = 3;

namespace cpu {

// Mean squared distance of each point to the kNeighbors nearest others, or to as many as there are.
// points: [N, 3], finite; result: [N].
template <class S> void mean_squared_distances(const S* points, int64_t count, S* result, int num_threads);

}  // namespace cpu

// On a GPU, points are sorted along a space-filling curve first, so that the points of a box of consecutive ones lie
// together and whole boxes can be left out.
namespace cuda {

constexpr int kBoxPoints = 256;  // so many that few boxes are tested, so few that most of them are left out

// The place of each point on the Morton curve through their bounding box.
template <class S> struct MortonCodes {
  const S* points;  // [N, 3]
  int64_t count;    // N
  const S* low;     // [3] the least coordinates
  const S* high;    // [3] the greatest ones
  int64_t* codes;   // [N] written
};

// Asynchronous on `stream`, a cudaStream_t. Throws std::runtime_error if the launch fails.
template <class S> void morton_codes(const MortonCodes<S>& morton, void* stream);

// The mean squared distance of each point to the kNeighbors nearest others, or to as many as there are.
template <class S> struct NeighborDistances {
  const S* points;       // [N, 3] in any order; only the speed depends on it, and the Morton curve is good
  int64_t count;         // N
  const int64_t* order;  // [N] where the result of each point goes
  S* boxes;              // [ceil(N / kBoxPoints), 2, 3] scratch
  S* result;             // [N] written
};

// Asynchronous on `stream`, a cudaStream_t. Throws std::runtime_error if a launch fails.
template <class S> void mean_squared_distances(const NeighborDistances<S>& search, void* stream);

}  // namespace cuda
}  // namespace dsmoe
