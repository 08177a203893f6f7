// Adds the seconds between its construction and its destruction to a stage. Does nothing if no times are asked for.
#pragma once

#include <chrono>

#include "dsmoe/rasterize.h"

namespace dsmoe {
namespace cpu {

class Stopwatch {
 public:
  Stopwatch(StageTimes* times, double StageTimes::*stage)
      : seconds_(times != nullptr ? &(times->*stage) : nullptr), start_(Clock::now()) {}
  ~Stopwatch() {
    if (seconds_ != nullptr) *seconds_ += std::chrono::duration<double>(Clock::now() - start_).count();
  }
  Stopwatch(const Stopwatch&) = delete;
  Stopwatch& operator=(const Stopwatch&) = delete;

 private:
  using Clock = std::chrono::steady_clock;
  double* seconds_;
  Clock::time_point start_;
};

}  // namespace cpu
}  // namespace dsmoe
