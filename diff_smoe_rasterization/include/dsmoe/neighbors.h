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

// On a GPU, points are sorted along a space-filling curve first, so that those of a box of consecutive ones lie
// together and whole boxes can be left out.
namespace cuda {

constexpr int kBoxPoints = 256;

// Place of each point on the Morton curve through the bounding box. points: [N, 3]; low, high: [3]; codes: [N].
template <class S>
void morton_codes(const S* points, int64_t count, const S* low, const S* high, int64_t* codes, void* stream);

// As on the CPU. points: [N, 3] in any order, which decides the speed alone; order: [N] where the result of each goes;
// boxes: [ceil(N / kBoxPoints), 2, 3] scratch; result: [N].
template <class S>
void mean_squared_distances(const S* points, const int64_t* order, int64_t count, S* boxes, S* result, void* stream);

}  // namespace cuda
}  // namespace dsmoe
