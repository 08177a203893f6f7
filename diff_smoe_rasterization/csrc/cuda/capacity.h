// How much memory the tile instances of a rendering get, before the GPU has counted them. The guess is the number of
// instances per Gaussian of earlier renderings with the same image size, mode and about as many Gaussians. A bad guess
// costs time, never correctness (rasterize_cuda.h). The background's gate is not in the key, because the host does not
// know the value of a tensor. A count is forgotten after 1,024 to 2,048 renderings, so that one large view does not
// enlarge the key sort and the memory for ever. This table of sizes is all that outlives a call.
#pragma once

#include <cuda_runtime_api.h>

#include <cstdint>
#include <map>
#include <memory>
#include <mutex>
#include <tuple>

#include "recent_greatest.h"

namespace dsmoe {
namespace cuda {

class InstanceCapacities {
 public:
  using Key = std::tuple<int, int64_t, int64_t, int64_t, int>;  // device, width, height, blend mode, bits of N
  static Key key(int device, int64_t width, int64_t height, int64_t blend_mode, int64_t num_gaussians);

  static constexpr size_t kMostKeys = 1024;  // that are remembered; each pins a few bytes for ever

  // What is likely to be enough for so many Gaussians, or -1 if nothing is known of the key. captured: into a graph,
  // which keeps its room; it gets 1.5 times the greatest count.
  int64_t likely(const Key& key, int64_t num_gaussians, bool captured = false);

  // Learns the count of a rendering that has just been launched, as soon as the device has it. If the table is full,
  // the key that was longest not used is forgotten.
  void learn(const Key& key, int64_t num_gaussians, const int64_t* num_instances, cudaStream_t stream);

  // The greatest count lately, for so many Gaussians; -1 if nothing is known of the key.
  int64_t greatest(const Key& key, int64_t num_gaussians);

  static InstanceCapacities& shared();

 private:
  struct Count {
    // Counts of the latest finished rendering, in pinned memory that the device writes. It is never freed,
    // because a captured graph may write it at any time; another key may get it.
    int64_t* latest = nullptr;
    int64_t num_gaussians = 0;  // of the latest rendering that was launched; `latest` may be of the one before
    RecentGreatest recent;      // counts per Gaussian of earlier renderings
    int64_t calls = 0;          // how often `likely` has read it
    int64_t used = 0;           // number of the last use
  };

  // Takes over what the device has counted.
  static int64_t greatest_of(Count& count, int64_t num_gaussians);

  // The counts of the key or, if it has none, of half or twice as many Gaussians.
  std::map<Key, Count>::iterator find_nearest(Key key);

  int64_t* pinned_count();  // memory that no key has

  std::mutex mutex_;
  std::map<Key, Count> counts_;
  int64_t uses_ = 0;
};

}  // namespace cuda
}  // namespace dsmoe
