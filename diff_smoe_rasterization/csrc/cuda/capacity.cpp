#include "capacity.h"

#include "check.h"

namespace dsmoe {
namespace cuda {
namespace {

constexpr size_t kMostKeys = 1024;         // sizes that are remembered; each pins a few bytes for ever
constexpr int64_t kGranularity = 1 << 16;  // instances: like views get blocks of one size, which allocators reuse
constexpr int64_t kFirstCalls = 64;        // renderings after which the views are thought to be known

// Room for what the next views may add.
int64_t with_margin(int64_t count, bool large) {
  const int64_t margin = large ? count : count / 8;
  return (count + margin + kGranularity) / kGranularity * kGranularity;
}

}  // namespace

bool is_capturing(cudaStream_t stream) {
  cudaStreamCaptureStatus status;
  check(cudaStreamIsCapturing(stream, &status), "asking for the stream's state");
  return status != cudaStreamCaptureStatusNone;
}

InstanceCapacities::Key InstanceCapacities::key(int device, int64_t width, int64_t height, int64_t blend_mode,
                                                int64_t num_gaussians) {
  int bits = 0;
  while (num_gaussians >> bits != 0) ++bits;
  return {device, width, height, blend_mode, bits};
}

int64_t InstanceCapacities::likely(const Key& key) {
  const std::lock_guard<std::mutex> lock(mutex_);
  const auto found = counts_.find(key);
  if (found == counts_.end()) return -1;
  Count& count = found->second;
  const int64_t latest = *static_cast<volatile int64_t*>(count.latest);  // the device writes it
  count.recent.add(latest);
  const int64_t greatest = count.recent.greatest();
  const bool few = count.calls++ < kFirstCalls;  // views have been counted
  return greatest < 0 ? -1 : with_margin(greatest, few);
}

void InstanceCapacities::learn(const Key& key, const int64_t* num_instances, cudaStream_t stream) {
  const std::lock_guard<std::mutex> lock(mutex_);
  auto found = counts_.find(key);
  if (found == counts_.end()) {
    if (counts_.size() >= kMostKeys || is_capturing(stream)) return;  // no memory can be pinned during a capture
    Count count;
    check(cudaHostAlloc(reinterpret_cast<void**>(&count.latest), sizeof(int64_t), cudaHostAllocPortable),
          "allocating pinned memory");
    *count.latest = -1;
    found = counts_.emplace(key, count).first;
  }
  check(cudaMemcpyAsync(found->second.latest, num_instances, sizeof(int64_t), cudaMemcpyDeviceToHost, stream),
        "counting instances");
}

InstanceCapacities& InstanceCapacities::shared() {
  static InstanceCapacities* capacities = new InstanceCapacities;  // outlives the CUDA context
  return *capacities;
}

}  // namespace cuda
}  // namespace dsmoe
