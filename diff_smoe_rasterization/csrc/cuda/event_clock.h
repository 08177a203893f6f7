// Stage times on a CUDA stream. While profiling is off it does nothing. While it is on, the pass waits for its kernels.
#pragma once

#include <cuda_runtime_api.h>

#include <utility>
#include <vector>

#include "check.h"
#include "dsmoe/params.h"

namespace dsmoe {
namespace cuda {

class EventClock {
 public:
  EventClock(StageTimes* times, cudaStream_t stream) : times_(times), stream_(stream) { record(nullptr); }
  EventClock(const EventClock&) = delete;
  EventClock& operator=(const EventClock&) = delete;
  ~EventClock() {
    for (const auto& mark : marks_) cudaEventDestroy(mark.event);
  }

  // Ends the stage `field`, which began where the last one ended.
  void end(double StageTimes::*field) { record(field); }

  // Waits, and adds up the stages.
  void finish() {
    if (times_ == nullptr) return;
    check(cudaEventSynchronize(marks_.back().event), "timing stages");
    for (size_t i = 1; i < marks_.size(); ++i) {
      float milliseconds = 0;
      check(cudaEventElapsedTime(&milliseconds, marks_[i - 1].event, marks_[i].event), "timing stages");
      times_->*marks_[i].field += milliseconds * 1e-3;
    }
  }

 private:
  struct Mark {
    cudaEvent_t event;
    double StageTimes::*field;
  };

  void record(double StageTimes::*field) {
    if (times_ == nullptr) return;
    cudaEvent_t event;
    check(cudaEventCreate(&event), "timing stages");
    marks_.push_back({event, field});
    check(cudaEventRecord(event, stream_), "timing stages");
  }

  StageTimes* times_;
  cudaStream_t stream_;
  std::vector<Mark> marks_;
};

}  // namespace cuda
}  // namespace dsmoe
