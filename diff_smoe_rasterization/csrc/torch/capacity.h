// How much memory the tile instances of a rendering get, before the GPU has counted them. The counts of earlier
// renderings of the same size and mode are a good guess; a bad one costs time, never correctness (rasterize_cuda.h).
// This table of sizes is all that outlives a call.
#pragma once

#include <cuda_runtime_api.h>

#include <cstdint>
#include <map>
#include <memory>
#include <mutex>
#include <tuple>

namespace dsmoe {
namespace binding {

class InstanceCapacities {
 public:
  using Key = std::tuple<int, int64_t, int64_t, int64_t>;  // device, width, height, blend mode

  // The capacity for a rendering whose count lies at `num_instances` on the device. Waits for the stream only where
  // nothing is known of the key, or `exact` is asked for, and the stream is not being captured.
  int64_t choose(const Key& key, const int64_t* num_instances, int64_t num_gaussians, bool exact, cudaStream_t stream);

  static InstanceCapacities& shared();

 private:
  // The count of the latest rendering, written by the device whenever it gets there; pinned, never freed, because a
  // captured graph may write it at any time.
  struct Count {
    int64_t* latest = nullptr;
    int64_t greatest = 0;
  };

  std::mutex mutex_;
  std::map<Key, Count> counts_;
};

}  // namespace binding
}  // namespace dsmoe
