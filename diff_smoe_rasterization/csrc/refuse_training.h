// What the trainers' functions of both backends refuse, as refuse.h does for the passes: null pointers, by name, and
// sizes that would have them read elsewhere. The passes of gaussians.h do not look.
#pragma once

#include <initializer_list>
#include <vector>

#include "dsmoe/training/adam.h"
#include "dsmoe/training/gather.h"
#include "dsmoe/training/gaussians.h"
#include "dsmoe/training/image_loss.h"
#include "refuse.h"

namespace dsmoe {

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

template <class S> void refuse_adam(const char* function, const std::vector<AdamTensor<S>>& tensors) {
  for (size_t i = 0; i < tensors.size(); ++i) {
    const AdamTensor<S>& t = tensors[i];
    refuse_null_fields(
        function, i, t.size,
        {{"parameter", t.parameter}, {"gradient", t.gradient}, {"moment", t.moment}, {"square", t.square}});
    if (t.size > 0 && (t.row_size < 1 || t.size % t.row_size != 0)) {
      refuse(function, "tensors[", i, "].row_size is ", t.row_size, "; it must be 1 or more and divide ", t.size);
    }
  }
}

template <class S> void refuse_step_gaussians(const char* function, const GaussianAdam<S>& adam) {
  for (size_t i = 0; i < kGaussianAdamTensors; ++i) {
    const ActivatedTensor<S>& t = adam.tensors[i];
    const int64_t size = adam.num_gaussians * t.row_size;
    refuse_null_fields(function, i, size,
                       {{"raw", t.raw}, {"dL_dvalue", t.dL_dvalue}, {"moment", t.moment}, {"square", t.square}});
    if (t.activation != Activation::kNone) refuse_null_fields(function, i, size, {{"value", t.value}});
  }
  refuse_null(function, "radii", adam.radii, "[N]", adam.num_gaussians);
}

inline void refuse_num_tensors(const char* function, int num_tensors) {
  if (0 <= num_tensors && num_tensors <= kLazyAdamMaxTensors) return;
  refuse(function, "num_tensors is ", num_tensors, "; it must be 0 to ", kLazyAdamMaxTensors);
}

template <class S> void refuse_catch_up(const char* function, const LazyAdam<S>& adam) {
  refuse_num_tensors(function, adam.num_tensors);
  for (int i = 0; i < adam.num_tensors; ++i) {
    const LazyAdamTensor<S>& t = adam.tensors[i];
    refuse_null_fields(
        function, i, adam.num_rows * t.row_size,
        {{"parameter", t.parameter}, {"moment", t.moment}, {"square", t.square}, {"gradient", t.gradient}});
  }
  refuse_null(function, "marks", adam.marks, "[N]", adam.num_rows);
  refuse_null(function, "rates", adam.rates, "[steps, num_tensors]", adam.num_rows > 0 ? adam.steps : 0);
}

template <class S> void refuse_note_step(const char* function, const LazyAdamStep<S>& step) {
  refuse_num_tensors(function, step.num_tensors);
  refuse_null(function, "marks", step.marks, "[N]", step.num_rows);
  refuse_null(function, "radii", step.radii, "[N]", step.num_rows);
  refuse_null(function, "rates", step.rates, "[steps + 1, num_tensors]", step.num_tensors);
}

template <class S>
void refuse_gather(const char* function, const std::vector<GatherTensor<S>>& tensors, const GatherRows& rows) {
  for (size_t i = 0; i < tensors.size(); ++i) {
    const int64_t size = rows.count * tensors[i].row_size;
    refuse_null_fields(function, i, size, {{"to", tensors[i].to}});
    if (tensors[i].from == nullptr && size > 0) refuse(function, "tensors[", i, "].from is null; it must have rows");
  }
  refuse_null(function, "rows", rows.rows, "[count]", tensors.empty() ? 0 : rows.count);
}

template <class S> void refuse_image_loss(const char* function, const ImageLoss<S>& loss) {
  const int64_t size = loss.planes * loss.height * loss.width;
  refuse_null(function, "image", loss.image, "[planes, height, width]", size);
  if (loss.target == nullptr && loss.target_bytes == nullptr && size > 0) {
    refuse(function, "target and target_bytes are null; one must point to an array [planes, height, width]");
  }
  refuse_null(function, "loss", loss.loss, "[1]", 1);
  refuse_null(function, "sums", loss.sums, "[num_image_loss_sums(...)]", size);
  refuse_null(function, "derivatives", loss.derivatives, "[3, planes, height, width], as a gradient is wanted",
              loss.gradient != nullptr ? size : 0);
}

}  // namespace dsmoe
