#include "capacity.h"

#include <algorithm>
#include <cmath>

#include "check.h"
#include "dsmoe/rasterize_cuda.h"
#include "scratch.h"

namespace dsmoe {
namespace cuda {
namespace {

constexpr int64_t kGranularity = 1 << 16;  // instances: like views get blocks of one size, which allocators reuse
constexpr int64_t kFirstCalls = 64;        // renderings after which the views are thought to be known

// margin: what the next views may add.
int64_t with_margin(int64_t count, int64_t margin) {
  return (count + margin + kGranularity) / kGranularity * kGranularity;
}

}  // namespace

InstanceCapacities::Key InstanceCapacities::key(int device, int64_t width, int64_t height, int64_t blend_mode,
                                                int64_t num_gaussians) {
  int bits = 0;
  while (num_gaussians >> bits != 0) ++bits;
  return {device, width, height, blend_mode, bits};
}

int64_t InstanceCapacities::likely(const Key& key, int64_t num_gaussians, bool captured) {
  const std::lock_guard<std::mutex> lock(mutex_);
  const auto found = find_nearest(key);
  if (found == counts_.end()) return -1;
  Count& count = found->second;
  count.used = ++uses_;
  const int64_t greatest = greatest_of(count, num_gaussians);
  const bool few = count.calls++ < kFirstCalls;  // views have been counted
  return greatest < 0 ? -1 : with_margin(greatest, few ? greatest : captured ? greatest / 2 : greatest / 8);
}

void InstanceCapacities::learn(const Key& key, int64_t num_gaussians, const int64_t* num_instances,
                               cudaStream_t stream) {
  const std::lock_guard<std::mutex> lock(mutex_);
  auto found = counts_.find(key);
  if (found == counts_.end()) {
    if (is_capturing(stream)) return;  // no memory can be pinned during a capture
    Count count;
    const auto nearest = find_nearest(key);
    if (nearest != counts_.end()) count.recent = nearest->second.recent;
    count.latest = pinned_count();
    *count.latest = -1;
    found = counts_.emplace(key, count).first;
  }
  found->second.num_gaussians = num_gaussians;
  found->second.used = ++uses_;
  write_number(num_instances, found->second.latest, stream);
}

int64_t InstanceCapacities::greatest(const Key& key, int64_t num_gaussians) {
  const std::lock_guard<std::mutex> lock(mutex_);
  const auto found = counts_.find(key);
  return found == counts_.end() ? -1 : greatest_of(found->second, num_gaussians);
}

int64_t InstanceCapacities::greatest_of(Count& count, int64_t num_gaussians) {
  const int64_t latest = *static_cast<volatile int64_t*>(count.latest);  // the device writes it
  if (latest >= 0) count.recent.add(double(latest) / double(std::max<int64_t>(1, count.num_gaussians)));
  const double greatest = count.recent.greatest();
  return greatest < 0 ? -1 : static_cast<int64_t>(std::ceil(greatest * double(num_gaussians)));
}

std::map<InstanceCapacities::Key, InstanceCapacities::Count>::iterator InstanceCapacities::find_nearest(Key key) {
  int& bits = std::get<4>(key);
  for (const int change : {0, -1, +2}) {
    bits += change;
    const auto found = counts_.find(key);
    if (found != counts_.end()) return found;
  }
  return counts_.end();
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

int64_t recent_instances(int64_t width, int64_t height, int64_t blend_mode, int64_t num_gaussians) {
  int device = 0;
  check(cudaGetDevice(&device), "asking for the device");
  return InstanceCapacities::shared().greatest(
      InstanceCapacities::key(device, width, height, blend_mode, num_gaussians), num_gaussians);
}

InstanceCapacities& InstanceCapacities::shared() {
  static InstanceCapacities* capacities = new InstanceCapacities;  // outlives the CUDA context
  return *capacities;
}

}  // namespace cuda
}  // namespace dsmoe
