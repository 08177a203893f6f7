// Distances to the nearest other points, on a GPU. Points are sorted along a space-filling curve first, so that those
// of a box of consecutive ones lie together and whole boxes can be left out.
#pragma once

#include <cstdint>

namespace dsmoe {
namespace cuda {

constexpr int kNeighbors = 3;
constexpr int kBoxPoints = 256;

// Place of each point on the Morton curve through the bounding box. points: [N, 3]; low, high: [3]; codes: [N].
template <class S>
void morton_codes(const S* points, int64_t count, const S* low, const S* high, int64_t* codes, void* stream);

// Mean squared distance of each point to the kNeighbors nearest others, or to as many as there are.
// points: [N, 3] in any order, which decides the speed alone; order: [N] where the result of each goes;
// boxes: [ceil(N / kBoxPoints), 2, 3] scratch; result: [N].
template <class S>
void mean_squared_distances(const S* points, const int64_t* order, int64_t count, S* boxes, S* result, void* stream);

}  // namespace cuda
}  // namespace dsmoe
