#include "capacity.h"

#include <algorithm>

#include "../cuda/check.h"

namespace dsmoe {
namespace binding {
namespace {

constexpr size_t kMostKeys = 256;  // more sizes than that are not remembered
constexpr int64_t kGranularity = 1 << 16;

// Room for what the next views may add.
int64_t with_margin(int64_t count) { return (count + count / 4 + kGranularity) / kGranularity * kGranularity; }

bool is_capturing(cudaStream_t stream) {
  cudaStreamCaptureStatus status;
  cuda::check(cudaStreamIsCapturing(stream, &status), "asking for the stream's state");
  return status != cudaStreamCaptureStatusNone;
}

}  // namespace

int64_t InstanceCapacities::choose(const Key& key, const int64_t* num_instances, int64_t num_gaussians, bool exact,
                                   cudaStream_t stream) {
  const std::lock_guard<std::mutex> lock(mutex_);
  const bool capturing = is_capturing(stream);
  auto found = counts_.find(key);
  if (found == counts_.end() && !capturing && counts_.size() < kMostKeys) {
    Count count;
    cuda::check(cudaHostAlloc(reinterpret_cast<void**>(&count.latest), sizeof(int64_t), cudaHostAllocPortable),
                "allocating pinned memory");
    *count.latest = -1;
    found = counts_.emplace(key, count).first;
  }
  if (found == counts_.end()) {
    if (capturing) return with_margin(8 * num_gaussians);
    int64_t count = 0;
    cuda::check(cudaMemcpyAsync(&count, num_instances, sizeof(count), cudaMemcpyDeviceToHost, stream),
                "counting instances");
    cuda::check(cudaStreamSynchronize(stream), "projecting Gaussians");
    return count;
  }
  Count& count = found->second;
  const int64_t seen = *static_cast<volatile int64_t*>(count.latest);
  count.greatest = std::max(count.greatest, seen);
  cuda::check(cudaMemcpyAsync(count.latest, num_instances, sizeof(int64_t), cudaMemcpyDeviceToHost, stream),
              "counting instances");
  if (capturing) return with_margin(count.greatest > 0 ? count.greatest : 8 * num_gaussians);
  if (seen < 0 || exact) {
    cuda::check(cudaStreamSynchronize(stream), "projecting Gaussians");
    count.greatest = std::max(count.greatest, *count.latest);
    if (exact) return *count.latest;
  }
  return with_margin(count.greatest);
}

InstanceCapacities& InstanceCapacities::shared() {
  static InstanceCapacities* capacities = new InstanceCapacities;  // outlives the CUDA context
  return *capacities;
}

}  // namespace binding
}  // namespace dsmoe
