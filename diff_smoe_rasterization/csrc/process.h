// What callers set for the whole process: the clock of the stages, and how many tile instances a pass lists at once.
#pragma once

#include <cstdint>

#include "dsmoe/rasterize.h"

namespace dsmoe {
namespace binding {

// Tests make it small, so that a small image is rendered in many bands; 0: kMostInstances. Throws std::invalid_argument
// below 0.
void set_most_instances(int64_t count);
int64_t most_instances();

// Whether stage times are taken.
void set_profiling(bool enabled);

// Of the latest forward pass, and of the latest backward pass; zeros if there was none.
StageTimes stage_times();

enum class Pass { kForward, kBackward };

// Collects the stage times of one pass and publishes them when it ends.
class StageRecorder {
 public:
  explicit StageRecorder(Pass pass);
  ~StageRecorder();
  StageRecorder(const StageRecorder&) = delete;
  StageRecorder& operator=(const StageRecorder&) = delete;

  // Null while profiling is off.
  StageTimes* times() { return enabled_ ? &times_ : nullptr; }

 private:
  const Pass pass_;
  const bool enabled_;
  StageTimes times_;
};

}  // namespace binding
}  // namespace dsmoe
