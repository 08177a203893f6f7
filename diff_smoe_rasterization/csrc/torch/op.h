// What an op.h needs (csrc/ops). It has the functions of its ops for any backend, and NAME_ops, which names each with
// its schema:
//
//   template <class Backend, class Ops> void adam_ops(Ops& ops) {
//     ops.template add<&adam<Backend>>("adam(Tensor(a!)[] parameters, ...) -> ()");
//   }
#pragma once

#include <string>
#include <string_view>
#include <type_traits>

#include "checks.h"
#include "tensors.h"

// Calls a function of the core that both backends have, on a Backend: last comes its number of threads, or its stream.
#define DSMOE_ON(Backend, function, ...)           \
  if constexpr (Backend::kOnHost) {                \
    cpu::function(__VA_ARGS__, Backend::where());  \
  } else {                                         \
    cuda::function(__VA_ARGS__, Backend::where()); \
  }

namespace dsmoe {
namespace binding {

// The tensors and the options of a rendering in a schema.
#define DSMOE_ARGUMENT(first, schema, name, ...) schema " " #name ", "
inline std::string inputs_in_schema() { return DSMOE_INPUTS(DSMOE_ARGUMENT); }
inline std::string options_in_schema() {
  const std::string list = DSMOE_OPTIONS(DSMOE_ARGUMENT);
  return list.substr(0, list.size() - 2);  // without the last comma
}
#undef DSMOE_ARGUMENT

inline Inputs read_inputs(Arguments& arguments) {
  Inputs inputs;
  const auto read = [&](std::string_view schema, Tensor& value) {
    schema == "Tensor?" ? arguments.read_optional(value) : arguments.read(value);
  };
#define DSMOE_READ(enumerator, schema, name, ...) read(schema, inputs[enumerator]);
  DSMOE_INPUTS(DSMOE_READ)
#undef DSMOE_READ
  return inputs;
}

inline Options read_options(Arguments& arguments) {
  Options options;
#define DSMOE_READ(type, schema, name) arguments.read(options.name);
  DSMOE_OPTIONS(DSMOE_READ)
#undef DSMOE_READ
  return options;
}

inline Tensor read_optional(Arguments& arguments) {
  Tensor value;
  arguments.read_optional(value);
  return value;
}

// What a rendering saved, each array at a multiple of what a kernel loads at once. Torch's own memory is; what a hook
// of autograd hands back may lie anywhere, and is copied.
inline Saved read_saved(Arguments& arguments) {
  constexpr size_t kLargestVector = 32;  // bytes: SegmentPixel<double>
  auto saved = arguments.read<Saved>();
  for (Tensor& array : saved) {
    const bool given = array.defined() && array.numel() > 0;
    if (given && reinterpret_cast<uintptr_t>(array.data_ptr()) % kLargestVector != 0) array = array.clone();
  }
  return saved;
}

// Calls body(S()) with the type of `like`, as the op `function`.
template <class Body> void dispatch(const char* function, const Tensor& like, Body body) {
  as_op(function, [&] { dispatch_real(like, body); });
}

// What an op that projects asks of the values of its arguments. Returns them dense.
template <class Backend> Inputs checked(const char* function, const Inputs& inputs, const Options& options) {
  if (options.debug) {
    for (int i = kBackground; i <= kBackgroundGate; ++i) {
      refuse_nan(std::string(function) + ": " + kInputNames[i], inputs[i]);
    }
  }
  const Inputs dense = contiguous(inputs);
  if (options.strict) refuse_non_finite(function, dense);
  if (options.prefiltered) {
    refuse_culled(function, dense,
                  Backend::visible(function, dense[kMeans3D], dense[kViewMatrix], dense[kViewMatrixEnd], options.near,
                                   options.camera_model));
  }
  return dense;
}

// Says that there are the ops.
struct Definitions {
  template <auto kFunction> void add(const std::string& schema) { library.def(schema.c_str()); }
  Library& library;
};

// Says how a backend computes them.
struct Implementations {
  template <auto kFunction> void add(const std::string& schema) {
    const std::string name = schema.substr(0, schema.find('('));
    if constexpr (std::is_convertible_v<decltype(kFunction), void (*)(Arguments&)>) {
      implement<kFunction>(library, name.c_str());
    } else {
      implement<&with_arguments<kFunction>>(library, name.c_str());
    }
  }
  Library& library;
};

}  // namespace binding
}  // namespace dsmoe
