// Calls the ops by their names. Autograd, which the callers implement, does not see the calls.
#pragma once

#include <ATen/core/LegacyTypeDispatch.h>
#include <ATen/core/dispatch/Dispatcher.h>

#include <string>
#include <utility>

namespace dsmoe {
namespace binding {

inline c10::OperatorHandle find_op(const char* name) {
  const std::string full_name = std::string("diff_smoe_rasterization::") + name;
  return c10::Dispatcher::singleton().findSchemaOrThrow(full_name.c_str(), "");
}

// Replaces the op's arguments on the stack by its results.
inline void call_boxed(const c10::OperatorHandle& op, torch::jit::Stack& stack) {
  const at::AutoDispatchBelowADInplaceOrView guard;
  op.callBoxed(&stack);
}

// `Signature` is that of the op's schema.
template <class Signature, class... Values> auto call_op(const c10::OperatorHandle& op, Values&&... values) {
  const at::AutoDispatchBelowADInplaceOrView guard;
  return op.typed<Signature>().call(std::forward<Values>(values)...);
}

}  // namespace binding
}  // namespace dsmoe
