// Rows by a list on the CPU: threads take runs of them.
#include "dsmoe/training/gather.h"

#include <algorithm>

#include "cpu/parallel.h"
#include "refuse.h"

namespace dsmoe {

template <class S>
void refuse_gather(const char* function, const std::vector<GatherTensor<S>>& tensors, const GatherRows& rows) {
  for (size_t i = 0; i < tensors.size(); ++i) {
    const int64_t size = rows.count * tensors[i].row_size;
    refuse_null_fields(function, i, size, {{"to", tensors[i].to}});
    if (tensors[i].from == nullptr && size > 0) refuse(function, "tensors[", i, "].from is null; it must have rows");
  }
  refuse_null(function, "rows", rows.rows, "[count]", tensors.empty() ? 0 : rows.count);
}

template void refuse_gather(const char*, const std::vector<GatherTensor<float>>&, const GatherRows&);
template void refuse_gather(const char*, const std::vector<GatherTensor<double>>&, const GatherRows&);

namespace cpu {
namespace {

constexpr int64_t kChunk = 1 << 12;  // rows a thread takes at a time

}  // namespace

template <class S>
void gather_rows(const std::vector<GatherTensor<S>>& tensors, const GatherRows& rows, int num_threads) {
  refuse_gather("cpu::gather_rows", tensors, rows);
  for (const GatherTensor<S>& tensor : tensors) {
    const int64_t size = tensor.row_size;
    parallel_for(num_threads, rows.count, kChunk, [&](int64_t begin, int64_t end) {
      for (int64_t i = begin; i < end; ++i) std::copy_n(tensor.from + rows.rows[i] * size, size, tensor.to + i * size);
    });
  }
}

template void gather_rows(const std::vector<GatherTensor<float>>&, const GatherRows&, int);
template void gather_rows(const std::vector<GatherTensor<double>>&, const GatherRows&, int);

}  // namespace cpu
}  // namespace dsmoe
