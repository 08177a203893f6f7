#include "process.h"

#include <atomic>
#include <mutex>
#include <stdexcept>
#include <string>

#include "dsmoe/params.h"

namespace dsmoe {
namespace binding {
namespace {

std::atomic<int64_t> most{kMostInstances};
std::atomic<bool> profiling{false};
std::mutex latest_mutex;
StageTimes latest;

}  // namespace

void set_most_instances(int64_t count) {
  if (count < 0) {
    throw std::invalid_argument("set_most_instances: count is " + std::to_string(count) + "; it must be 0 or more");
  }
  most = count > 0 ? count : kMostInstances;
}

int64_t most_instances() { return most; }

void set_profiling(bool enabled) { profiling = enabled; }

StageTimes stage_times() {
  const std::lock_guard<std::mutex> lock(latest_mutex);
  return latest;
}

StageRecorder::StageRecorder(Pass pass) : pass_(pass), enabled_(profiling) {}

StageRecorder::~StageRecorder() {
  if (!enabled_) return;
  const std::lock_guard<std::mutex> lock(latest_mutex);
  if (pass_ == Pass::kForward) {
    latest = times_;
    return;
  }
  latest.blend_backward = times_.blend_backward;
  latest.project_backward = times_.project_backward;
  latest.backward_pairs = times_.backward_pairs;
}

}  // namespace binding
}  // namespace dsmoe
