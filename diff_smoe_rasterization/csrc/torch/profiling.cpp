#include "profiling.h"

#include <atomic>
#include <mutex>

namespace dsmoe {
namespace binding {
namespace {

std::atomic<bool> profiling{false};
std::mutex latest_mutex;
StageTimes latest;

}  // namespace

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
