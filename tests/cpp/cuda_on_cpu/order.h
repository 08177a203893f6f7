// In which order the emulator runs blocks, warps and lanes, as far as they do not wait for each other.
#pragma once

namespace emulator {

enum class Order { kForward, kBackward, kShuffled };
void run_in(Order order);  // from now on

}  // namespace emulator
