// Rows by a list on the CPU: threads take runs of them.
#include "dsmoe/training/gather.h"

#include <algorithm>

#include "cpu/parallel.h"
#include "refuse_training.h"

namespace dsmoe {
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
