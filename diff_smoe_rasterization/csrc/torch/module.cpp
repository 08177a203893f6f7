// The Python module: what is no tensor op. Importing it registers the ops (schema.cpp).
#include <ATen/Parallel.h>
#include <pybind11/pybind11.h>
#include <torch/version.h>

#include "dsmoe/blend.h"
#include "dsmoe/constants.h"
#include "dsmoe/rasterize_cuda.h"
#include "dsmoe/removal.h"
#include "io/python_bindings.h"
#include "most_instances.h"
#include "profiling.h"
#include "tensors.h"

namespace py = pybind11;

namespace {

// For the test that compares them with the oracle's own.
py::dict constants() {
  using namespace py::literals;
  return py::dict("alpha_max"_a = dsmoe::kAlphaMax, "alpha_cut"_a = dsmoe::kAlphaCut, "gate_cut"_a = dsmoe::kGateCut,
                  "core_kernel"_a = dsmoe::kCoreKernel, "transmittance_cut"_a = dsmoe::kTransmittanceCut,
                  "gate_sum_cut"_a = dsmoe::kGateSumCut, "max_opacity"_a = dsmoe::kMaxOpacity,
                  "radius_root_floor"_a = dsmoe::kRadiusRootFloor, "compensation_floor"_a = dsmoe::kCompensationFloor,
                  "low_pass"_a = dsmoe::kLowPass, "frustum_margin"_a = dsmoe::kFrustumMargin,
                  "homogeneous_epsilon"_a = dsmoe::kHomogeneousEpsilon, "tile_size"_a = dsmoe::kTileSize,
                  "segment_length"_a = dsmoe::cuda::kSegmentLength);
}

// The lists of fields.h: names in the order of the ops' arguments and results; the options with their types.
template <size_t kCount> py::tuple names(const char* const (&list)[kCount]) {
  py::tuple out(kCount);
  for (size_t i = 0; i < kCount; ++i) out[i] = py::str(list[i]);
  return out;
}

py::dict options() {
  py::dict types;
#define DSMOE_TYPE(type, schema, name) types[#name] = schema;
  DSMOE_OPTIONS(DSMOE_TYPE)
#undef DSMOE_TYPE
  return types;
}

// What a backend saves: of each tensor its name, its type ("real": that of the inputs) and how many numbers a row has.
template <class Saved, class Sizes> py::list saved_arrays() {
  py::list arrays;
  Saved saved;
  for_each_array(saved, Sizes(), [&](const char* name, auto*& pointer, int64_t rows) {
    const dsmoe::SavedArray array = dsmoe::saved_array(name, pointer, rows);
    const char* type = array.type == dsmoe::NumberType::kInt32   ? "int32"
                       : array.type == dsmoe::NumberType::kInt64 ? "int64"
                                                                 : "real";
    arrays.append(py::make_tuple(name, type, array.columns));
  });
  return arrays;
}

py::dict saved() {
  using namespace py::literals;
  return py::dict("cpu"_a = saved_arrays<dsmoe::SavedForward<float>, dsmoe::SavedSizes>(),
                  "cuda"_a = saved_arrays<dsmoe::cuda::SavedForward<float>, dsmoe::cuda::SavedSizes>());
}

// The core's list: names in the order of their numbers, each with the facts that Python asks for. `divides`: the
// backward pass reads the images of the forward pass. `removable`: `importance` takes the mode. `background_gate`: the
// mode's own, or None where the caller gives it. `faint_below`: what is usual in the mode.
py::dict blend_modes() {
  using namespace py::literals;
  py::dict modes;
  dsmoe::BlendModes::for_each([&](auto mode) {
    using Policy = dsmoe::Blend<decltype(mode)::value>;
    py::object gate = py::none();
    if (!Policy::kLearnsGate) gate = py::float_(Policy::background_gate(0.0));
    modes[Policy::kName] =
        py::dict("number"_a = static_cast<int>(decltype(mode)::value), "divides"_a = Policy::kDivides,
                 "removable"_a = dsmoe::kRemovable<decltype(mode)::value>, "background_gate"_a = gate,
                 "tails"_a = Policy::kTails, "faint_below"_a = Policy::kFaintBelow);
  });
  return modes;
}

py::dict build_info() {
  using namespace py::literals;
#ifdef DSMOE_WITH_CUDA
  constexpr bool kCudaBuilt = true;
#else
  constexpr bool kCudaBuilt = false;
#endif
  return py::dict("torch_built_with"_a = TORCH_VERSION, "compiler"_a = __VERSION__, "cuda_built"_a = kCudaBuilt,
                  "simd_level"_a = dsmoe::cpu::simd_level(), "num_threads"_a = at::get_num_threads());
}

py::dict stage_times() {
  using namespace py::literals;
  const dsmoe::StageTimes times = dsmoe::binding::stage_times();
  return py::dict("project"_a = times.project, "sort"_a = times.sort, "bin"_a = times.bin, "blend"_a = times.blend,
                  "blend_backward"_a = times.blend_backward, "project_backward"_a = times.project_backward,
                  "forward_pairs"_a = times.forward_pairs, "backward_pairs"_a = times.backward_pairs);
}

}  // namespace

PYBIND11_MODULE(TORCH_EXTENSION_NAME, m) {
  m.attr("constants") = constants();
  m.attr("blend_modes") = blend_modes();
  m.attr("inputs") = names(dsmoe::binding::kInputNames);
  m.attr("images") = names(dsmoe::binding::kImageNames);
  m.attr("options") = options();
  m.attr("saved") = saved();
  m.def("build_info", &build_info);
  m.def("set_most_instances", &dsmoe::binding::set_most_instances);
  m.def("set_profiling", &dsmoe::binding::set_profiling);
  m.def("stage_times", &stage_times);
  py::module_ io = m.def_submodule("io");
  dsmoe::io::bind_io(io);
}
