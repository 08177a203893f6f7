#include "capacity.h"

#include <algorithm>
#include <cmath>

#include "capture.h"
#include "check.h"

namespace dsmoe {
namespace cuda {
namespace {

constexpr int64_t kGranularity = 1 << 16;  // instances: like views get blocks of one size, which allocators reuse
constexpr int64_t kFirstCalls = 64;        // renderings after which the views are thought to be known

// Room for what the next views may add.
int64_t with_margin(int64_t count, bool large) {
  const int64_t margin = large ? count : count / 8;
  return (count + margin + kGranularity) / kGranularity * kGranularity;
}

}  // namespace

InstanceCapacities::Key InstanceCapacities::key(int device, int64_t width, int64_t height, int64_t blend_mode,
                                                int64_t num_gaussians) {
  int bits = 0;
  while (num_gaussians >> bits != 0) ++bits;
  return {device, width, height, blend_mode, bits};
}

int64_t InstanceCapacities::likely(const Key& key, int64_t num_gaussians) {
  const std::lock_guard<std::mutex> lock(mutex_);
  const auto found = counts_.find(key);
  if (found == counts_.end()) return -1;
  Count& count = found->second;
  count.used = ++uses_;
  const int64_t latest = *static_cast<volatile int64_t*>(count.latest);  // the device writes it
  if (latest >= 0) count.recent.add(double(latest) / double(std::max<int64_t>(1, count.num_gaussians)));
  const double greatest = count.recent.greatest();
  const bool few = count.calls++ < kFirstCalls;  // views have been counted
  return greatest < 0 ? -1 : with_margin(static_cast<int64_t>(std::ceil(greatest * double(num_gaussians))), few);
}

void InstanceCapacities::learn(const Key& key, int64_t num_gaussians, const int64_t* num_instances,
                               cudaStream_t stream) {
  const std::lock_guard<std::mutex> lock(mutex_);
  auto found = counts_.find(key);
  if (found == counts_.end()) {
    if (is_capturing(stream)) return;  // no memory can be pinned during a capture
    Count count;
    count.latest = pinned_count();
    *count.latest = -1;
    found = counts_.emplace(key, count).first;
  }
  found->second.num_gaussians = num_gaussians;
  found->second.used = ++uses_;
  check(cudaMemcpyAsync(found->second.latest, num_instances, sizeof(int64_t), cudaMemcpyDeviceToHost, stream),
        "counting instances");
}

int64_t* InstanceCapacities::pinned_count() {
  int64_t* count = nullptr;
  if (counts_.size() < kMostKeys) {
    const BesideCaptures beside;
    check(cudaHostAlloc(reinterpret_cast<void**>(&count), sizeof(int64_t), cudaHostAllocPortable),
          "allocating pinned memory");
    return count;
  }
  // A rendering of the old key that is still under way may leave its count to the new one. That costs time at most.
  const auto oldest = std::min_element(counts_.begin(), counts_.end(),
                                       [](const auto& a, const auto& b) { return a.second.used < b.second.used; });
  count = oldest->second.latest;
  counts_.erase(oldest);
  return count;
}

InstanceCapacities& InstanceCapacities::shared() {
  static InstanceCapacities* capacities = new InstanceCapacities;  // outlives the CUDA context
  return *capacities;
}

}  // namespace cuda
}  // namespace dsmoe
