// The op that gathers rows of several tensors by one list.
#pragma once

#include <string>
#include <vector>

#include "dsmoe/training/gather.h"
#include "torch/op.h"

namespace dsmoe {
namespace binding {

// Indices of rows that a tensor does not have. On a GPU the host waits for the smallest and the largest one.
inline void check_rows(const char* function, const Tensor& rows, const Tensor& of) {
  if (rows.numel() == 0 || of.dim() == 0) return;
  const Tensor ends = empty({2}, rows);
  ends.narrow(0, 0, 1).copy_(smallest(rows)), ends.narrow(0, 1, 1).copy_(largest(rows));
  const Tensor here = to_cpu(ends);
  const int64_t first = here.data_ptr<int64_t>()[0], last = here.data_ptr<int64_t>()[1];
  DSMOE_CHECK_INDEX(0 <= first && last < of.size(0), function, ": rows has indices from ", first, " to ", last,
                    "; the tensors have ", of.size(0), " rows");
}

template <class Backend> Tensors gather_rows(const Tensors& tensors, const Tensor& rows) {
  const char* function = "gather_rows";
  if (tensors.empty()) return {};
  const Expect expect(function, "tensors[0]", tensors[0]);
  expect("rows", rows, {"M"}, kLong);
  const DeviceGuard guard(rows.device());
  const Tensor list = rows.contiguous();
  check_rows(function, list, tensors[0]);
  Tensors dense, results;
  for (size_t i = 0; i < tensors.size(); ++i) {
    expect(item_name("tensors", i), tensors[i], shape_of(tensors[i].sizes()));
    DSMOE_CHECK_VALUE(tensors[i].dim() > 0, function, ": ", item_name("tensors", i), " has no rows");
    DSMOE_CHECK_VALUE(tensors[i].size(0) == tensors[0].size(0), function, ": ", item_name("tensors", i), " has ",
                      tensors[i].size(0), " rows; it must have ", tensors[0].size(0), ", as tensors[0] has");
    std::vector<int64_t> shape = tensors[i].sizes().vec();
    shape[0] = list.size(0);
    dense.push_back(tensors[i].contiguous());
    results.push_back(empty(shape, tensors[i]));
  }
  dispatch_real(tensors[0], [&](auto zero) {
    using scalar_t = decltype(zero);
    std::vector<GatherTensor<scalar_t>> all;
    for (size_t i = 0; i < dense.size(); ++i) {
      const int64_t size = list.size(0) > 0 ? results[i].numel() / list.size(0) : 0;
      all.push_back({dense[i].data_ptr<scalar_t>(), results[i].data_ptr<scalar_t>(), static_cast<int>(size)});
    }
    const GatherRows rows_of_all = {list.data_ptr<int64_t>(), list.size(0)};
    DSMOE_ON(Backend, gather_rows, all, rows_of_all);
  });
  return results;
}

template <class Backend, class Ops> void gather_ops(Ops& ops) {
  // rows [M] of each tensor [N, ...], which have one type.
  ops.template add<&gather_rows<Backend>>("gather_rows(Tensor[] tensors, Tensor rows) -> Tensor[]");
}

}  // namespace binding
}  // namespace dsmoe
