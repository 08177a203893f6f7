// What an op asks of Python where LibTorch's stable ABI has no form of it: to raise an error of a type, and whether a
// level of forward-mode derivatives is open. Its functions are found in the Python that loads the ops.
#pragma once

#include <string>

namespace dsmoe {
namespace binding {

enum class ErrorKind { kRuntime, kValue, kType, kIndex, kNotImplemented, kOutOfMemory };

// Throws what PyTorch turns into a Python error of that kind. Needs no GIL.
[[noreturn]] void raise(ErrorKind kind, const std::string& message);

// Whether torch.autograd.forward_ad has a level open.
bool forward_mode_is_open();

}  // namespace binding
}  // namespace dsmoe
