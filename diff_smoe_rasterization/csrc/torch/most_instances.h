// How many tile instances a pass lists at once. Tests make it small, so that a small image is rendered in many bands.
#pragma once

#include <cstdint>

namespace dsmoe {
namespace binding {

// Sets it for all later calls of the process; 0: the core's own. Throws std::invalid_argument below 0.
void set_most_instances(int64_t count);

int64_t most_instances();

}  // namespace binding
}  // namespace dsmoe
