// What the functions of both backends refuse: comparisons on the host, a few a call. Messages have one form: "function:
// name is this; it must be that". A pointer is only compared with null; an array without elements may be null.
#pragma once

#include <cstdint>
#include <initializer_list>
#include <limits>
#include <sstream>
#include <stdexcept>
#include <type_traits>

#include "dsmoe/params.h"
#include "dsmoe/removal.h"
#include "dsmoe/sh.h"

namespace dsmoe {

template <class... Parts> [[noreturn]] void refuse(const char* function, const Parts&... parts) {
  std::ostringstream message;
  message << function << ": ";
  (message << ... << parts);
  throw std::invalid_argument(message.str());
}

// size: 0 if the array has no elements.
inline void refuse_null(const char* function, const char* name, const void* array, const char* shape, int64_t size) {
  if (array == nullptr && size > 0) refuse(function, name, " is null; it must point to an array ", shape);
}

struct NamedArray {
  const char* name;
  const void* array;
};

// Arrays of tensors[i]. size: of each.
inline void refuse_null_fields(const char* function, size_t i, int64_t size, std::initializer_list<NamedArray> fields) {
  for (const NamedArray& field : fields) {
    if (field.array != nullptr || size <= 0) continue;
    refuse(function, "tensors[", i, "].", field.name, " is null; it must point to an array of ", size, " numbers");
  }
}

template <class S> void refuse_negative(const char* function, const char* name, S value) {
  if (value >= S(0) && value <= std::numeric_limits<S>::max()) return;
  refuse(function, name, " is ", value, "; it must be 0 or more and finite");
}

template <class S> void refuse_unless_positive(const char* function, const char* name, S value) {
  if (value > S(0) && value <= std::numeric_limits<S>::max()) return;
  refuse(function, name, " is ", value, "; it must be positive and finite");
}

template <class S> void refuse_unless_finite(const char* function, const char* name, const S* values, int index) {
  const S value = values[index];
  if (value >= std::numeric_limits<S>::lowest() && value <= std::numeric_limits<S>::max()) return;
  refuse(function, name, "[", index, "] is ", value, "; it must be finite");
}

// Of a matrix [4, 4], all columns but one, which nothing reads.
template <class S> void refuse_unless_finite_but(int column, const char* function, const char* name, const S* matrix) {
  for (int i = 0; i < 16; ++i) {
    if (i % 4 != column) refuse_unless_finite(function, name, matrix, i);
  }
}

constexpr int kUnreadViewColumn = 3, kUnreadClipColumn = 2;  // (0, 0, 0, 1), and clip z

// Whether the host may read what the pointers of a frame point to: if the camera holds its matrices.
template <class Frame> constexpr bool kOnHost = !std::is_pointer_v<decltype(Frame::camera.view)>;

// The shape of saved.features.
template <class Frame> constexpr const char* kFeatureShape = kOnHost<Frame> ? "[N, F]" : "[N, feature_stride(F)]";

// on_host: the host may read what the rules point to.
template <class S> void refuse_rules(const char* function, const BlendRules<S>& rules, bool on_host) {
  const int mode = static_cast<int>(rules.mode);
  if (mode < 0 || mode >= BlendModes::kSize) {
    refuse(function, "blend_mode is ", mode, "; it must be 0 to ", BlendModes::kSize - 1);
  }
  refuse_negative(function, "alpha_min", rules.alpha_min);
  if (rules.faint_below != kFaintBelowOfMode) refuse_negative(function, "faint_below", rules.faint_below);
  if (!on_host && rules.background_gate_at != nullptr) return;
  constexpr S kMostGate = S(1e30);  // that and a background's colour still make a float32 number
  if (rules.lambda() >= S(0) && rules.lambda() <= kMostGate) return;
  refuse(function, "background_gate is ", rules.lambda(), "; it must be 0 to ", kMostGate);
}

inline void refuse_image_size(const char* function, int64_t width, int64_t height) {
  const auto fits = [](int64_t side) { return side > 0 && side <= kMostImageSide; };
  if (fits(width) && fits(height)) return;
  refuse(function, "image_width x image_height is ", width, " x ", height, "; both must be 1 to ", kMostImageSide);
}

// What every pass reads: the sizes, and what decides which pairs count.
template <class Frame> void refuse_frame(const char* function, const Frame& frame) {
  constexpr int64_t kMostGaussians = std::numeric_limits<int32_t>::max();
  const auto& config = frame.config;
  const int64_t count = frame.inputs.num_gaussians;
  if (count < 0 || count > kMostGaussians) {
    refuse(function, "num_gaussians is ", count, "; it must be 0 to ", kMostGaussians);
  }
  refuse_image_size(function, frame.camera.width, frame.camera.height);
  refuse_rules(function, config.blend, kOnHost<Frame>);
  if (config.num_channels < 1) refuse(function, "num_channels is ", config.num_channels, "; it must be 1 or more");
  if (config.most_instances < 1) {
    refuse(function, "most_instances is ", config.most_instances, "; it must be 1 or more");
  }
}

inline void refuse_unless_one(const char* function, bool first, bool second, const char* names) {
  if (first != second) return;
  refuse(function, first ? "both" : "neither", " of ", names, first ? " are" : " is",
         " given; exactly one of the two must be");
}

// Colours and covariances that are not given, given twice, or too short.
template <class S> void refuse_given(const char* function, const GaussianInputs<S>& inputs, int num_channels) {
  const bool dc = inputs.dc != nullptr, shs = inputs.shs != nullptr;
  const bool scales = inputs.scales != nullptr, rotations = inputs.rotations != nullptr;
  refuse_unless_one(function, shs || dc, inputs.colors_precomp != nullptr, "shs (or dc) and colors_precomp");
  refuse_unless_one(function, scales || rotations, inputs.cov3D_precomp != nullptr,
                    "scales with rotations, and cov3D_precomp,");
  if (scales != rotations) {
    refuse(function, scales ? "scales is given without rotations" : "rotations is given without scales",
           "; the covariance needs both");
  }
  if (!shs && !dc) return;
  if (num_channels != 3) refuse(function, "num_channels is ", num_channels, "; colours from shs have 3");
  if (inputs.sh_degree < 0 || inputs.sh_degree > kMaxShDegree) {
    refuse(function, "sh_degree is ", inputs.sh_degree, "; it must be 0 to ", kMaxShDegree);
  }
  const int in_shs = shs ? inputs.num_sh : 0, held = in_shs + dc, needed = sh_coefficients(inputs.sh_degree);
  if (in_shs < 0 || held < needed) {
    refuse(function, "shs has shape [", inputs.num_gaussians, ", ", in_shs, ", 3]", dc ? " besides dc" : "",
           "; sh_degree ", inputs.sh_degree, " needs ", needed, " coefficients a Gaussian, not ", held);
  }
}

// Gaussians that do not say what a projection needs. If there are none, null does not tell what is given.
template <class S> void refuse_inputs(const char* function, const GaussianInputs<S>& inputs, int num_channels) {
  if (inputs.num_gaussians == 0) return;
  refuse_null(function, "means3D", inputs.means3D, "[N, 3]", 1);
  refuse_null(function, "opacities", inputs.opacities, "[N]", 1);
  refuse_given(function, inputs, num_channels);
}

// Poses that cannot be read. size: null will do where that is 0.
template <class Frame> void refuse_poses(const char* function, const Frame& frame, int64_t size) {
  const auto& camera = frame.camera;
  const bool rolls = camera.shutter != Shutter::kGlobal;
  if constexpr (kOnHost<Frame>) {
    refuse_unless_finite_but(kUnreadViewColumn, function, "camera.view (viewmatrix)", camera.view);
    if (!rolls) return;
    refuse_unless_finite_but(kUnreadViewColumn, function, "camera.view_end (viewmatrix_end)", camera.view_end);
  } else {
    refuse_null(function, "camera.view", camera.view, "[4, 4]", size);
    if (rolls) refuse_null(function, "camera.view_end", camera.view_end, "[4, 4]", size);
  }
}

template <class Frame> void refuse_projection(const char* function, const Frame& frame) {
  const auto& camera = frame.camera;
  refuse_frame(function, frame);
  refuse_inputs(function, frame.inputs, frame.config.num_channels);
  refuse_unless_positive(function, "tan_fov_x (tanfovx)", camera.tan_fov_x);
  refuse_unless_positive(function, "tan_fov_y (tanfovy)", camera.tan_fov_y);
  refuse_negative(function, "near", camera.near);
  refuse_negative(function, "scale_modifier", frame.config.scale_modifier);
  refuse_negative(function, "low_pass", frame.config.low_pass);
  const bool pinhole = camera.lens.model == LensModel::kPinhole;
  if (!pinhole) {
    refuse_unless_positive(function, "camera.lens.focal.x", camera.lens.focal.x);
    refuse_unless_positive(function, "camera.lens.focal.y", camera.lens.focal.y);
  }
  const int shutter = static_cast<int>(camera.shutter);
  if (shutter < 0 || shutter >= kNumShutters) {
    refuse(function, "camera.shutter (rolling_shutter) is ", shutter, "; it must be 0 to ", kNumShutters - 1);
  }
  if (camera.shutter != Shutter::kGlobal && pinhole) {
    refuse(function, "camera.shutter is ", kShutterNames[shutter],
           ", but camera.lens is a pinhole; it must be another lens, such as opencv without distortion");
  }
  refuse_poses(function, frame, 1);
  if constexpr (kOnHost<Frame>) {
    if (pinhole) {
      refuse_unless_finite_but(kUnreadClipColumn, function, "camera.projection (projmatrix)", camera.projection);
    }
    const bool read = frame.inputs.dc != nullptr || frame.inputs.shs != nullptr;
    for (int i = 0; read && i < 3; ++i) refuse_unless_finite(function, "camera.position (campos)", camera.position, i);
  } else {
    refuse_null(function, "camera.projection", camera.projection, "[4, 4]", 1);
    refuse_null(function, "camera.position", camera.position, "[3]", 1);
  }
}

template <class Frame> void refuse_radii(const char* function, const Frame& frame) {
  refuse_projection(function, frame);
  refuse_null(function, "images.radii", frame.images.radii, "[N]", frame.inputs.num_gaussians);
}

// A batch of views that is not as its struct says. Frame: the backend's. refuse_view(view): refuses what a stage
// cannot read or write of a view.
template <class Frame, class Batch, class Refuse>
void refuse_batch(const char* function, const Batch& batch, const Refuse& refuse_view) {
  const int64_t count = static_cast<int64_t>(batch.views.size());
  if (count < 1 || count > kMostViews) refuse(function, "views has length ", count, "; it must be 1 to ", kMostViews);
  if (batch.config.num_channels != 3) refuse(function, "num_channels is ", batch.config.num_channels, "; rows have 3");
  if (batch.config.num_features() != 3) refuse(function, "config asks for depths; rows have colours alone");
  Frame frame;
  frame.inputs = batch.inputs, frame.config = batch.config;
  for (const auto& view : batch.views) {
    frame.camera = view.camera;
    refuse_projection(function, frame);
    refuse_null(function, "radii", view.radii, "[N]", batch.inputs.num_gaussians);
    refuse_null(function, "offsets", view.offsets, "[num_view_blocks(N) + 1]", 1);
    refuse_view(view);
  }
  if (batch.inputs.num_gaussians == 0) return;
  if (batch.inputs.cov3D_precomp != nullptr)
    refuse(function, "cov3D_precomp is given; rows are of scales and rotations");
  if (batch.inputs.colors_precomp != nullptr) refuse(function, "colors_precomp is given; rows are of shs or dc");
  if (batch.inputs.shs != nullptr && batch.inputs.num_sh > kMaxShCoefficients) {
    refuse(function, "shs has ", batch.inputs.num_sh, " coefficients a Gaussian; rows are of at most ",
           kMaxShCoefficients);
  }
}

// The same for a stage that reads or writes rows. A device takes these as vectors.
template <class Frame, class Batch> void refuse_rows(const char* function, const Batch& batch, bool backward) {
  const auto refuse_unaligned = [&](const char* name, const float* rows) {
    if (kOnHost<Frame> || reinterpret_cast<std::uintptr_t>(rows) % 16 == 0) return;
    refuse(function, name, " is not aligned; it must begin at a multiple of 16 bytes");
  };
  refuse_batch<Frame>(function, batch, [&](const auto& view) {
    if (view.num_rows < 0) refuse(function, "num_rows is ", view.num_rows, "; it must be 0 or more");
    if constexpr (kOnHost<Frame>) {
      const int64_t counted = view.offsets[num_view_blocks(batch.inputs.num_gaussians)];
      if (view.num_rows != counted) {
        refuse(function, "num_rows is ", view.num_rows, "; it must be ", counted, ", the last of offsets");
      }
    }
    refuse_unaligned("features", view.features);
    if (!backward) refuse_unaligned("gates", view.gates);
    if (!backward) refuse_null(function, "gates", view.gates, "[M, 8]", view.num_rows);
    refuse_null(function, "features", view.features, "[M, 4]", view.num_rows);
    if (backward) refuse_null(function, "records", view.records, "[M, 9]", view.num_rows);
  });
}

template <class Frame> void refuse_images(const char* function, const Frame& frame) {
  const auto& images = frame.images;
  refuse_null(function, "background", frame.config.background, "[C]", 1);
  for (int i = 0; kOnHost<Frame> && i < frame.config.num_channels; ++i) {
    refuse_unless_finite(function, "background (bg)", frame.config.background, i);
  }
  refuse_null(function, "images.color", images.color, "[C, H, W]", 1);
  refuse_null(function, "images.gate_sum", images.gate_sum, "[H, W]", 1);
  refuse_null(function, "images.depth", images.depth, "[H, W], as config.depth is set", frame.config.depth);
  refuse_null(function, "images.inverse_depth", images.inverse_depth, "[H, W], as config.inverse_depth is set",
              frame.config.inverse_depth);
  refuse_null(function, "images.radii", images.radii, "[N]", frame.inputs.num_gaussians);
}

template <class Frame> void refuse_forward(const char* function, const Frame& frame) {
  refuse_projection(function, frame);
  refuse_images(function, frame);
}

// Footprints that have no place, or are not there.
template <class Frame> void refuse_footprints(const char* function, const Frame& frame) {
  const int64_t count = frame.inputs.num_gaussians;
  refuse_null(function, "saved.projected", frame.saved.projected, "[N]", count);
  refuse_null(function, "saved.features", frame.saved.features, kFeatureShape<Frame>, count);
}

template <class Frame> void refuse_project(const char* function, const Frame& frame) {
  refuse_radii(function, frame);
  refuse_footprints(function, frame);
}

template <class Frame> void refuse_blend_footprints(const char* function, const Frame& frame) {
  refuse_frame(function, frame);
  refuse_footprints(function, frame);
  refuse_images(function, frame);
}

// A rendering that is not as the forward pass left it. sizes: of its arrays.
template <class Frame, class Sizes>
void refuse_rendering(const char* function, const Frame& frame, const Sizes& sizes) {
  auto saved = frame.saved;
  const auto refuse_missing = [&](const char* name, const void* array, int64_t size) {
    if (array == nullptr && size > 0) {
      refuse(function, "saved.", name, " is null; the frame must be as the forward pass left it");
    }
  };
  for_each_array(saved, sizes, refuse_missing);
  refuse_missing("gate_sum", saved.gate_sum, 1);
  refuse_null(function, "background", frame.config.background, "[C]", 1);
  refuse_null(function, "images.radii", frame.images.radii, "[N]", frame.inputs.num_gaussians);
}

// Gradients by images that are not there.
template <class Frame, class S>
void refuse_gradients(const char* function, const Frame& frame, const ImageGradients<S>& gradients) {
  const auto& config = frame.config;
  const auto& images = frame.images;
  refuse_null(function, "images.color", images.color, "[C, H, W], as its gradient is given",
              gradients.color != nullptr);
  refuse_null(function, "images.depth", images.depth, "[H, W], as its gradient is given",
              config.depth && gradients.depth != nullptr);
  refuse_null(function, "images.inverse_depth", images.inverse_depth, "[H, W], as its gradient is given",
              config.inverse_depth && gradients.inverse_depth != nullptr);
}

template <class Frame, class S, class Sizes>
void refuse_backward(const char* function, const Frame& frame, const ImageGradients<S>& gradients, const Sizes& sizes) {
  refuse_projection(function, frame);
  refuse_rendering(function, frame, sizes);
  refuse_gradients(function, frame, gradients);
}

template <class Frame, class S, class Sizes>
void refuse_blend_backward(const char* function, const Frame& frame, const ImageGradients<S>& gradients,
                           const FootprintGradients<S>& footprints, const Sizes& sizes) {
  refuse_frame(function, frame);
  refuse_rendering(function, frame, sizes);
  refuse_gradients(function, frame, gradients);
  refuse_null(function, "records", footprints.records, "[N, 6 + F]", frame.inputs.num_gaussians);
}

template <class Frame, class S>
void refuse_project_backward(const char* function, const Frame& frame, const FootprintGradients<S>& footprints) {
  const int64_t count = frame.inputs.num_gaussians;
  refuse_radii(function, frame);
  refuse_null(function, "saved.features", frame.saved.features, kFeatureShape<Frame>, count);
  refuse_null(function, "records", footprints.records, "[N, 6 + F]", count);
}

// Sums by instance that have no place.
template <class Frame> void refuse_instance_sums(const char* function, const Frame& frame) {
  if constexpr (kOnHost<Frame>) {
    refuse_null(function, "saved.instance_offsets", frame.saved.instance_offsets, "[N + 1]",
                frame.saved.instances != nullptr);
  }
}

// A rendering whose lists cannot be walked.
template <class Frame> void refuse_walk(const char* function, const Frame& frame) {
  const int64_t count = frame.inputs.num_gaussians;
  refuse_frame(function, frame);
  refuse_null(function, "saved.projected", frame.saved.projected, "[N]", count);
  refuse_null(function, "saved.tile_offsets", frame.saved.tile_offsets, "[tiles + 1]", 1);
  refuse_null(function, "saved.last_contributor", frame.saved.last_contributor, "[H, W]", 1);
  // Its sign says which pairs count.
  refuse_null(function, "saved.final_transmittance", frame.saved.final_transmittance, "[H, W]", 1);
  bool reads_radii = true;
  if constexpr (kOnHost<Frame>) {
    reads_radii = frame.saved.instances == nullptr;
  } else {
    const bool listed = frame.saved.capacity > 0;
    refuse_null(function, "saved.order", frame.saved.order, "[N]", count);
    refuse_null(function, "saved.num_ordered", frame.saved.num_ordered, "[1]", 1);
    refuse_null(function, "saved.num_instances", frame.saved.num_instances, "[1]", listed);
    refuse_null(function, "saved.instances", frame.saved.instances, "[capacity]", listed);
    refuse_null(function, "saved.tile_order", frame.saved.tile_order, "[tiles]", listed);
  }
  refuse_null(function, "images.radii", frame.images.radii, "[N]", reads_radii ? count : 0);
}

// pass: of dsmoe/passes.
template <class Frame, class Pass> void refuse_pass(const char* function, const Frame& frame, const Pass& pass) {
  refuse_walk(function, frame);
  if (Pass::template Sums<float>::kNum > 0) refuse_instance_sums(function, frame);
  pass.arrays([&](const char* name, const void* array, const char* shape,
                  int64_t size) { refuse_null(function, name, array, shape, size); },
              frame.inputs.num_gaussians);
}

// A mode without a removal cost.
template <class Modes = BlendModes> void refuse_unremovable(const char* function, BlendMode mode) {
  Modes::for_each([&](auto of) {
    constexpr BlendMode kMode = decltype(of)::value;
    if (kMode != mode || kRemovable<kMode>) return;
    refuse(function, "blend_mode is ", Blend<kMode>::kName, "; it must be one whose law dsmoe/removal.h knows");
  });
}

template <class Frame, class Pass> void refuse_importance(const char* function, const Frame& frame, const Pass& pass) {
  refuse_unremovable(function, frame.config.blend.mode);
  refuse_pass(function, frame, pass);
  refuse_footprints(function, frame);
  refuse_null(function, "background", frame.config.background, "[C]", 1);
  refuse_null(function, "saved.gate_sum", frame.saved.gate_sum, "[H, W]", 1);
  refuse_null(function, "saved.tails", frame.saved.tails, "[H, W]", has_tails(frame.config.blend.mode));
}

template <class Frame> void refuse_mark_visible(const char* function, const Frame& frame, const bool* visible) {
  const int64_t count = frame.inputs.num_gaussians;
  refuse_null(function, "means3D", frame.inputs.means3D, "[N, 3]", count);
  refuse_poses(function, frame, count);
  refuse_null(function, "visible", visible, "[N]", count);
}

}  // namespace dsmoe
