// In which order the emulator runs blocks, warps and lanes, as far as they do not wait for each other.
#pragma once

namespace emulator {

enum class Order { kForward, kBackward, kShuffled };
extern Order order;

}  // namespace emulator
