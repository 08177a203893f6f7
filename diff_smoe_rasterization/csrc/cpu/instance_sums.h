// Sums over the pixels of each Gaussian. Each tile writes one record per instance. Then each Gaussian sums its own
// records, which lie side by side. There are no atomics, so the result does not depend on the threads.
#pragma once

#include <cstdint>
#include <memory>
#include <vector>

#include "bands.h"
#include "dsmoe/rasterize.h"
#include "parallel.h"
#include "tile_loop.h"

namespace dsmoe {
namespace cpu {

constexpr int64_t kGaussianChunk = 4096;  // a few additions each

// Returns the sums of all Gaussians, in double: a large one has thousands of instances. `walk(saved, records)` writes
// the records of a band, `add(sum, record)` adds one.
template <template <class> class Record, class S, class Walk, class Add>
std::vector<Record<double>> sum_instances(const Frame<S>& frame, Record<double> nothing, Walk&& walk, Add&& add) {
  const int64_t num_gaussians = frame.inputs.num_gaussians;
  std::vector<Record<double>> sums(num_gaussians, nothing);
  for_each_band(frame, nullptr, [&](const Frame<S>& band) {
    const SavedForward<S>& saved = band.saved;
    const std::unique_ptr<Record<S>[]> records(new Record<S>[saved.instance_offsets[num_gaussians]]);
    walk(saved, records.get());
    parallel_for(frame.config.num_threads, num_gaussians, kGaussianChunk, [&](int64_t begin, int64_t end) {
      for (int64_t i = begin; i < end; ++i) {
        for (int64_t slot = saved.instance_offsets[i]; slot < saved.instance_offsets[i + 1]; ++slot) {
          add(sums[i], records[slot]);
        }
      }
    });
  });
  return sums;
}

}  // namespace cpu
}  // namespace dsmoe
