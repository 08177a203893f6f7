#include "most_instances.h"

#include <atomic>
#include <stdexcept>
#include <string>

#include "dsmoe/params.h"

namespace dsmoe {
namespace binding {
namespace {

std::atomic<int64_t> most{kMostInstances};

}  // namespace

void set_most_instances(int64_t count) {
  if (count < 0) {
    throw std::invalid_argument("set_most_instances: count is " + std::to_string(count) + "; it must be 0 or more");
  }
  most = count > 0 ? count : kMostInstances;
}

int64_t most_instances() { return most; }

}  // namespace binding
}  // namespace dsmoe
