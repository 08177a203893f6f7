// The Python module: what is no tensor op. Importing it registers the ops (schema.cpp).
#include "dsmoe/blend.h"
#include "dsmoe/constants.h"
#include "dsmoe/rasterize_cuda.h"
#include "dsmoe/removal.h"
#include "python/io.h"
#include "python/python.h"
#include "torch/most_instances.h"
#include "torch/profiling.h"
#include "torch/tensors.h"

#ifdef DSMOE_STABLE_ABI
#include <torch/headeronly/version.h>
#else
#include <torch/version.h>
#endif

namespace {

using namespace dsmoe;
using python::Dict;
using python::Object;

// For the test that compares them with the oracle's own.
Object constants() {
  return Dict()
      .set("alpha_max", kAlphaMax)
      .set("alpha_cut", kAlphaCut)
      .set("gate_cut", kGateCut)
      .set("core_kernel", kCoreKernel)
      .set("transmittance_cut", kTransmittanceCut)
      .set("gate_sum_cut", kGateSumCut)
      .set("max_opacity", kMaxOpacity)
      .set("radius_root_floor", kRadiusRootFloor)
      .set("compensation_floor", kCompensationFloor)
      .set("low_pass", kLowPass)
      .set("frustum_margin", kFrustumMargin)
      .set("homogeneous_epsilon", kHomogeneousEpsilon)
      .set("tile_size", kTileSize)
      .set("segment_length", cuda::kSegmentLength);
}

// The list of fields.h: the options' names in the order of the ops' arguments, with their types.
Object options() {
  Dict types;
#define DSMOE_TYPE(type, schema, name) types.set(#name, schema);
  DSMOE_OPTIONS(DSMOE_TYPE)
#undef DSMOE_TYPE
  return types;
}

// What a backend saves: of each tensor its name, its type ("real": that of the inputs) and how many numbers a row has.
template <class Saved, class Sizes> Object saved_arrays() {
  python::List arrays;
  Saved saved;
  for_each_array(saved, Sizes(), [&](const char* name, auto*& pointer, int64_t rows) {
    const SavedArray array = saved_array(name, pointer, rows);
    const char* type = array.type == NumberType::kInt32 ? "int32" : array.type == NumberType::kInt64 ? "int64" : "real";
    arrays.append(python::tuple(name, type, array.columns));
  });
  return arrays;
}

Object saved() {
  return Dict()
      .set("cpu", saved_arrays<SavedForward<float>, SavedSizes>())
      .set("cuda", saved_arrays<cuda::SavedForward<float>, cuda::SavedSizes>());
}

// The core's list: names in the order of their numbers, each with the facts that Python asks for. `divides`: the
// backward pass reads the images of the forward pass. `removable`: `importance` takes the mode. `background_gate`: the
// mode's own, or None where the caller gives it. `faint_below`: what is usual in the mode.
Object blend_modes() {
  Dict modes;
  BlendModes::for_each([&](auto mode) {
    using Policy = Blend<decltype(mode)::value>;
    std::optional<double> gate;
    if constexpr (!Policy::kLearnsGate) gate = Policy::background_gate(0.0);
    modes.set(Policy::kName, Object(Dict()
                                        .set("number", static_cast<int>(decltype(mode)::value))
                                        .set("divides", Policy::kDivides)
                                        .set("removable", kRemovable<decltype(mode)::value>)
                                        .set("background_gate", gate)
                                        .set("tails", Policy::kTails)
                                        .set("faint_below", Policy::kFaintBelow)));
  });
  return modes;
}

Object build_info() {
#ifdef DSMOE_WITH_CUDA
  constexpr bool kCudaBuilt = true;
#else
  constexpr bool kCudaBuilt = false;
#endif
  return Dict()
      .set("torch_built_with", TORCH_VERSION)
      .set("compiler", __VERSION__)
      .set("cuda_built", kCudaBuilt)
      .set("simd_level", cpu::simd_level())
      .set("num_threads", binding::num_threads());
}

Object stage_times() {
  const StageTimes times = binding::stage_times();
  return Dict()
      .set("project", times.project)
      .set("sort", times.sort)
      .set("bin", times.bin)
      .set("blend", times.blend)
      .set("blend_backward", times.blend_backward)
      .set("project_backward", times.project_backward)
      .set("forward_pairs", times.forward_pairs)
      .set("backward_pairs", times.backward_pairs);
}

void add(PyObject* module, const char* name, Object value) {
  python::check_status(PyModule_AddObject(module, name, value.get()));
  value.release();  // which the module has now
}

PyMethodDef methods[] = {python::method<&build_info>("build_info"),
                         python::method<&binding::set_most_instances>("set_most_instances"),
                         python::method<&binding::set_profiling>("set_profiling"),
                         python::method<&stage_times>("stage_times"),
                         {nullptr, nullptr, 0, nullptr}};

PyModuleDef definition = {PyModuleDef_HEAD_INIT, "_C", nullptr, -1, methods, nullptr, nullptr, nullptr, nullptr};

}  // namespace

PyMODINIT_FUNC PyInit__C() {
  try {
#ifdef DSMOE_STABLE_ABI
    binding::prepare_python_errors();
#endif
    Object module(PyModule_Create(&definition));
    add(module.get(), "constants", constants());
    add(module.get(), "blend_modes", blend_modes());
    add(module.get(), "inputs", python::tuple_of(binding::kInputNames));
    add(module.get(), "images", python::tuple_of(binding::kImageNames));
    add(module.get(), "options", options());
    add(module.get(), "saved", saved());
    add(module.get(), "io", io::make_module());
    return module.release();
  } catch (...) {
    python::set_error();
    return nullptr;
  }
}
