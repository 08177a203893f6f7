// The Python module _core: what is not a tensor op. It needs Python and numpy, but no torch.
#include <pybind11/pybind11.h>
#include <pybind11/stl.h>

#include <cmath>
#include <utility>
#include <vector>

#include "dsmoe/allocator.h"
#include "dsmoe/arrays.h"
#include "dsmoe/blend.h"
#include "dsmoe/constants.h"
#include "dsmoe/lens.h"
#include "dsmoe/rasterize.h"
#include "dsmoe/rasterize_cuda.h"
#include "dsmoe/removal.h"
#include "process.h"
#include "python/python.h"
#include "torch/fields.h"

namespace py = pybind11;

namespace {

using namespace dsmoe;

// For the test that compares them with the oracle's own.
py::dict constants() {
  py::dict out;
  out["alpha_max"] = kAlphaMax;
  out["alpha_cut"] = kAlphaCut;
  out["gate_cut"] = kGateCut;
  out["core_kernel"] = kCoreKernel;
  out["most_views"] = kMostViews;
  out["most_lens_numbers"] = 2 + kMostDistortion;
  out["core_alpha"] = kCoreAlpha;
  out["tail_alpha"] = kTailAlpha;
  out["every_tail_alpha"] = kEveryTailAlpha;
  out["transmittance_cut"] = kTransmittanceCut;
  out["gate_sum_cut"] = kGateSumCut;
  out["max_opacity"] = kMaxOpacity;
  out["radius_root_floor"] = kRadiusRootFloor;
  out["compensation_floor"] = kCompensationFloor;
  out["low_pass"] = kLowPass;
  out["frustum_margin"] = kFrustumMargin;
  out["homogeneous_epsilon"] = kHomogeneousEpsilon;
  out["tile_size"] = kTileSize;
  out["segment_length"] = cuda::kSegmentLength;
  return out;
}

// The lists of fields.h: names of the ops' tensors and images, in order; of the options also the types.
#define DSMOE_NAME_OF_INPUT(enumerator, schema, name, ...) #name,
#define DSMOE_NAME_OF_IMAGE(enumerator, name) #name,
py::tuple inputs() { return py::tuple(py::cast(std::vector<std::string>{DSMOE_INPUTS(DSMOE_NAME_OF_INPUT)})); }
py::tuple images() { return py::tuple(py::cast(std::vector<std::string>{DSMOE_IMAGES(DSMOE_NAME_OF_IMAGE)})); }

py::dict options() {
  py::dict types;
#define DSMOE_TYPE(type, schema, name) types[#name] = schema;
  DSMOE_OPTIONS(DSMOE_TYPE)
  return types;
}

// What a backend saves: of each tensor its name, its type ("real": the inputs' type) and how many numbers a row has.
template <class Saved, class Sizes> py::list saved_arrays() {
  py::list arrays;
  Saved saved;
  for_each_array(saved, Sizes(), [&](const char* name, auto*& pointer, int64_t rows) {
    const SavedArray array = saved_array(name, pointer, rows);
    const char* type = array.type == NumberType::kInt32 ? "int32" : array.type == NumberType::kInt64 ? "int64" : "real";
    arrays.append(py::make_tuple(name, type, array.columns));
  });
  return arrays;
}

py::dict saved() {
  py::dict backends;
  backends["cpu"] = saved_arrays<SavedForward<float>, SavedSizes>();
  backends["cuda"] = saved_arrays<cuda::SavedForward<float>, cuda::SavedSizes>();
  return backends;
}

// The core's list: names in the order of their numbers, each with the facts that Python asks for. `divides`: the
// backward pass reads the images of the forward pass. `removable`: `importance` takes the mode. `background_gate`: the
// mode's own, or None if the caller gives it. `faint_below`: what is usual in the mode.
py::dict blend_modes() {
  py::dict modes;
  BlendModes::for_each([&](auto mode) {
    using Policy = Blend<decltype(mode)::value>;
    std::optional<double> gate;
    if constexpr (!Policy::kLearnsGate) gate = Policy::background_gate(0.0);
    py::dict facts;
    facts["number"] = static_cast<int>(decltype(mode)::value);
    facts["divides"] = Policy::kDivides;
    facts["removable"] = kRemovable<decltype(mode)::value>;
    facts["background_gate"] = gate;
    facts["tails"] = Policy::kTails;
    facts["faint_below"] = Policy::kFaintBelow;
    modes[Policy::kName] = facts;
  });
  return modes;
}

// The radial part of a lens: radii on its plane, from 0 to the end of its range and evenly by their angle, and the
// distorted ones for a focal length of 1, which rise. Empty if the model has no range. Raises ValueError for wrong
// coefficients.
std::pair<std::vector<double>, std::vector<double>> lens_radii(int camera_model, std::vector<double> coefficients,
                                                               int count) {
  using namespace lens_making;
  LensCalibration of;
  of.model = static_cast<LensModel>(camera_model), of.distortion = std::move(coefficients);
  const Distortion<double> d = distortion_of(of);
  std::vector<double> radii, distorted;
  const bool slopes = of.model == LensModel::kOpencv;
  if (!slopes && of.model != LensModel::kFisheye && of.model != LensModel::kThinPrismFisheye) return {};
  const double range = range_of(d, slopes ? kMostSlope : kFisheyeEnd, slopes);
  for (int i = 0; i < count; ++i) {
    const double part = i / (count - 1.0), r = slopes ? std::tan(part * std::atan(range)) : part * range;
    const double bent = r * radial_of(d, r * r).value;
    if (i > 0 && !(bent > distorted.back() && std::isfinite(bent))) break;  // coefficients at which float64 overflows
    radii.push_back(r), distorted.push_back(bent);
  }
  return {radii, distorted};
}

// Raises ValueError if DSMOE_SIMD names no level of this processor.
py::dict build_info() {
#ifdef DSMOE_WITH_CUDA
  constexpr bool kCudaBuilt = true;
#else
  constexpr bool kCudaBuilt = false;
#endif
  py::dict info;
  info["compiler"] = __VERSION__;
  info["cuda_built"] = kCudaBuilt;
  info["simd_level"] = cpu::simd_level();
  return info;
}

py::dict stage_times() {
  const StageTimes times = binding::stage_times();
  py::dict out;
  out["project"] = times.project;
  out["sort"] = times.sort;
  out["bin"] = times.bin;
  out["blend"] = times.blend;
  out["blend_backward"] = times.blend_backward;
  out["project_backward"] = times.project_backward;
  out["forward_pairs"] = times.forward_pairs;
  out["backward_pairs"] = times.backward_pairs;
  return out;
}

}  // namespace

PYBIND11_MODULE(_core, module) {
  py::register_local_exception_translator(&python::translate_exception);  // a global one would take PyTorch's, too
  module.attr("constants") = constants();
  module.attr("blend_modes") = blend_modes();
  module.attr("camera_models") =
      py::tuple(py::cast(std::vector<std::string>(std::begin(kLensNames), std::end(kLensNames))));
  module.attr("rolling_shutters") =
      py::tuple(py::cast(std::vector<std::string>(std::begin(kShutterNames), std::end(kShutterNames))));
  module.attr("inputs") = inputs();
  module.attr("images") = images();
  module.attr("options") = options();
  module.attr("saved") = saved();
  module.def("build_info", &build_info);
  module.def("lens_radii", &lens_radii);
#ifdef DSMOE_WITH_CUDA
  module.def("recent_instances", &cuda::recent_instances);
#endif
  module.def("set_most_instances", &binding::set_most_instances);
  module.def("set_profiling", &binding::set_profiling);
  module.def("stage_times", &stage_times);
  io::add_to(module.def_submodule("io"));
}
