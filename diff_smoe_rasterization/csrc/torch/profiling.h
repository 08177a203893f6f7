// The stage times of the latest rendering and of the latest backward pass. They are taken while profiling is on.
#pragma once

#include "dsmoe/rasterize.h"

namespace dsmoe {
namespace binding {

void set_profiling(bool enabled);

// Of the latest forward pass, and of the latest backward pass; zeros where there was none.
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
