// The op of the distances to the nearest points.
#pragma once

#include "dsmoe/training/neighbors.h"
#include "torch/op.h"

namespace dsmoe {
namespace binding {

template <class Backend> Tensor mean_squared_neighbour_distances(const Tensor& points) {
  const Expect expect("distCUDA2", "points", points);
  expect("points", points, {"N", 3});
  const int64_t index = first_set(logical_not(all_of(isfinite(points), 1)));
  DSMOE_CHECK_VALUE(index < 0, expect.function, ": points[", index, "] is not finite");
  const DeviceGuard guard(points.device());
  const int64_t count = points.size(0);
  const Tensor given = points.contiguous(), result = empty({count}, points);
  if (count == 0) return result;
  dispatch_real(given, [&](auto zero) {
    using scalar_t = decltype(zero);
    if constexpr (Backend::kOnHost) {
      cpu::mean_squared_distances(given.data_ptr<scalar_t>(), count, result.data_ptr<scalar_t>(), Backend::where());
    } else {
      const Tensor low = smallest(given), high = largest(given), codes = empty({count}, given, kLong);
      cuda::MortonCodes<scalar_t> morton = {};
      morton.points = given.data_ptr<scalar_t>();
      morton.count = count;
      morton.low = low.data_ptr<scalar_t>();
      morton.high = high.data_ptr<scalar_t>();
      morton.codes = codes.data_ptr<int64_t>();
      cuda::morton_codes(morton, Backend::where());
      const Tensor order = argsort(codes);
      const Tensor sorted = index_select(given, 0, order);
      const Tensor boxes = empty({(count + cuda::kBoxPoints - 1) / cuda::kBoxPoints, 2, 3}, given);
      cuda::NeighborDistances<scalar_t> search = {};
      search.points = sorted.data_ptr<scalar_t>();
      search.count = count;
      search.order = order.data_ptr<int64_t>();
      search.boxes = boxes.data_ptr<scalar_t>();
      search.result = result.data_ptr<scalar_t>();
      cuda::mean_squared_distances(search, Backend::where());
    }
  });
  return result;
}

template <class Backend, class Ops> void neighbors_ops(Ops& ops) {
  // Mean squared distance of each point [N, 3] to its three nearest others.
  ops.template add<&mean_squared_neighbour_distances<Backend>>(
      "mean_squared_neighbour_distances(Tensor points) -> Tensor");
}

}  // namespace binding
}  // namespace dsmoe
