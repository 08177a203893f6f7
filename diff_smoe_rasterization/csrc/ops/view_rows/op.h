// The ops of the first half of a rendering for a batch of views, and back.
#pragma once

#include <algorithm>
#include <string>
#include <utility>
#include <vector>

#include "torch/op.h"

namespace dsmoe {
namespace binding {

// The arguments of an op on a batch of views: its first view's, and all cameras.
struct BatchArguments {
  explicit BatchArguments(Arguments& arguments)
      : inputs(read_inputs(arguments)),
        options(read_options(arguments)),
        cameras(arguments.read<Tensors>()),
        images(arguments.read<std::vector<double>>()) {}

  int64_t num_views() const { return static_cast<int64_t>(images.size()) / kNumbersOfImage; }

  // Checks all tensors, with the cameras that are given twice. Returns their device.
  Device checked_device(const char* function) {
    DSMOE_CHECK_VALUE(images.size() == kNumbersOfImage * cameras.size() / kTensorsOfCamera && !images.empty() &&
                          cameras.size() % kTensorsOfCamera == 0,
                      function, ": cameras and images have lengths ", cameras.size(), " and ", images.size(),
                      "; they must have ", kTensorsOfCamera, " tensors and ", kNumbersOfImage, " numbers a view");
    check_arguments(function, inputs, options);
    const auto type = inputs[kMeans3D].scalar_type();
    DSMOE_CHECK_TYPE(type == kFloat, function, ": means3D is ", dtype_name(type), "; it must be float32");
    const Expect expect(function, "means3D", inputs[kMeans3D]);
    for (int64_t v = 0; v < num_views(); ++v) {
      take_view(function, v);
      check_arguments(function, inputs, options);
      expect("viewmatrix_end", cameras[v * kTensorsOfCamera + kViewMatrixEnd - kViewMatrix], {4, 4});
    }
    return inputs[kMeans3D].device();
  }

  // The batch as the core has it; no rows yet. Tensors that are not dense are copied.
  template <class Backend> typename Backend::ViewBatch batch(const char* function) {
    typename Backend::ViewBatch batch;
    for (int64_t v = 0; v < num_views(); ++v) {
      take_view(function, v);
      inputs = checked<Backend>(function, inputs, options);
      for (size_t k = 0; k < kTensorsOfCamera; ++k) {
        if (inputs[kViewMatrix + k].defined()) kept.push_back(inputs[kViewMatrix + k]);
      }
      as_op(function, [&] {
        const auto frame = Backend::template frame_of_gaussians<float>(inputs, options, Images());
        batch.inputs = frame.inputs, batch.config = frame.config;
        batch.views.emplace_back().camera = frame.camera;
      });
    }
    return batch;
  }

  // The same with the rows of each view. features and what else the op takes of them: a tensor for each view.
  template <class Backend>
  typename Backend::ViewBatch with_rows(const char* function, const Tensor& radii, const Tensor& offsets,
                                        const Tensors& features) {
    auto batch = this->batch<Backend>(function);
    const Expect expect(function, "means3D", inputs[kMeans3D]);
    const int64_t count = num_gaussians(inputs);
    expect.dense("radii", radii, {num_views(), count}, kInt);
    expect.dense("offsets", offsets, {num_views(), num_view_blocks(count) + 1}, kInt);
    check_length(function, "features", features.size(), batch.views.size());
    for (size_t v = 0; v < features.size(); ++v) {
      expect.dense(item_name("features", v), features[v], {"M", kRowFeatures});
      batch.views[v].num_rows = features[v].size(0);
      batch.views[v].features = mutable_data<float>(features[v]);
    }
    set_counts(batch, radii, offsets);
    return batch;
  }

  // Points each view to its rows of both tensors.
  template <class Batch> void set_counts(Batch& batch, const Tensor& radii, const Tensor& offsets) const {
    const int64_t count = num_gaussians(inputs);
    for (size_t v = 0; v < batch.views.size(); ++v) {
      batch.views[v].radii = radii.data_ptr<int32_t>() + v * count;
      batch.views[v].offsets = offsets.data_ptr<int32_t>() + v * (num_view_blocks(count) + 1);
    }
  }

  // Puts the camera and the image of a view among the arguments.
  void take_view(const char* function, int64_t v) {
    std::copy_n(cameras.begin() + v * kTensorsOfCamera, kTensorsOfCamera, inputs.begin() + kViewMatrix);
    const double* image = images.data() + v * kNumbersOfImage;
    options.image_width = static_cast<int64_t>(image[0]), options.image_height = static_cast<int64_t>(image[1]);
    options.tanfovx = image[2], options.tanfovy = image[3];
    options.camera_model = static_cast<int64_t>(image[4]);
    DSMOE_CHECK_VALUE(image[5] >= 0 && image[5] <= kMostLensNumbers, function, ": images says that a lens has ",
                      image[5], " numbers; it must have 0 to ", kMostLensNumbers);
    options.rolling_shutter = static_cast<int64_t>(image[6]);
    if (options.rolling_shutter == 0) inputs[kViewMatrixEnd] = Tensor();
    options.lens.assign(image + 7, image + 7 + static_cast<int>(image[5]));
  }

  static constexpr size_t kTensorsOfCamera = 4;
  Inputs inputs;
  Options options;
  Tensors cameras;
  std::vector<double> images;
  Tensors kept;  // what the batch points to
};
static_assert(kProjMatrix == kViewMatrix + 1 && kCampos == kViewMatrix + 2 && kViewMatrixEnd == kViewMatrix + 3,
              "a camera's tensors lie side by side");

template <class Backend> void count_rows(Arguments& arguments) {
  const char* function = "count_rows";
  BatchArguments given(arguments);
  const typename Backend::Guard guard(given.checked_device(function));
  auto batch = given.batch<Backend>(function);
  const Tensor& like = given.inputs[kMeans3D];
  const int64_t count = num_gaussians(given.inputs);
  const Tensor radii = empty({given.num_views(), count}, like, kInt);
  const Tensor offsets = empty({given.num_views(), num_view_blocks(count) + 1}, like, kInt);
  given.set_counts(batch, radii, offsets);
  as_op(function, [&] { Backend::count_rows(batch); });
  arguments.give_back(radii, offsets);
}

template <class Backend> void project_rows(Arguments& arguments) {
  const char* function = "project_rows";
  BatchArguments given(arguments);
  const auto radii = arguments.read<Tensor>(), offsets = arguments.read<Tensor>();
  const auto gates = arguments.read<Tensors>(), features = arguments.read<Tensors>();
  const typename Backend::Guard guard(given.checked_device(function));
  auto batch = given.with_rows<Backend>(function, radii, offsets, features);
  const Expect expect(function, "means3D", given.inputs[kMeans3D]);
  check_length(function, "gates", gates.size(), batch.views.size());
  for (size_t v = 0; v < gates.size(); ++v) {
    expect.dense(item_name("gates", v), gates[v], {batch.views[v].num_rows, kProjectedGaussianSize});
    batch.views[v].gates = mutable_data<float>(gates[v]);
  }
  as_op(function, [&] { Backend::project_rows(batch); });
  note_change({radii}), note_change(gates), note_change(features);
  arguments.give_back();
}

template <class Backend> void project_rows_backward(Arguments& arguments) {
  const char* function = "project_rows_backward";
  BatchArguments given(arguments);
  const auto radii = arguments.read<Tensor>(), offsets = arguments.read<Tensor>();
  const auto features = arguments.read<Tensors>(), records = arguments.read<Tensors>();
  const typename Backend::Guard guard(given.checked_device(function));
  auto batch = given.with_rows<Backend>(function, radii, offsets, features);
  const Tensor& like = given.inputs[kMeans3D];
  const Expect expect(function, "means3D", like);
  check_length(function, "records", records.size(), batch.views.size());
  const int64_t count = num_gaussians(given.inputs);
  const Tensor means2D = empty({given.num_views(), count, 3}, like);
  Tensors dense;
  for (size_t v = 0; v < records.size(); ++v) {
    expect(item_name("records", v), records[v], {batch.views[v].num_rows, kNumGateGradients + 3});
    dense.push_back(records[v].contiguous());
    batch.views[v].records = data<float>(dense.back());
    batch.views[v].means2D = count > 0 ? means2D.data_ptr<float>() + v * 3 * count : nullptr;
  }
  InputMask wanted = {};
  for (const Input input : {kMeans3D, kOpacities, kDc, kShs, kScales, kRotations}) {
    wanted[input] = given.inputs[input].defined();
  }
  const Inputs gradients = allocate_gradients(given.inputs, wanted);
  as_op(function, [&] { Backend::project_rows_backward(batch, gaussian_gradients<float>(gradients)); });
  Tensors results;
  for (int i = 0; i < kNumInputs; ++i) {
    if (wanted[i]) results.push_back(gradients[i]);
  }
  arguments.give_back_with_list({means2D}, std::move(results));
}

template <class Backend, class Ops> void view_rows_ops(Ops& ops) {
  // The arguments are those of the first view, V cameras (viewmatrix, projmatrix, campos and viewmatrix_end of each,
  // the last any matrix if its shutter does not roll), and images: kNumbersOfImage of each: width, height, tanfovx,
  // tanfovy, camera_model, how many numbers its lens has, rolling_shutter, and the lens's numbers, filled up with
  // anything. float32.
  const std::string batch = inputs_in_schema() + options_in_schema() + ", Tensor[] cameras, float[] images";
  // radii [V, N] and offsets [V, blocks + 1] int32: the last offset of a view says how many rows it has.
  ops.template add<&count_rows<Backend>>("count_rows(" + batch + ") -> (Tensor radii, Tensor offsets)");
  // Fills gates [M, 8] and features [M, 4] of each view.
  ops.template add<&project_rows<Backend>>(
      "project_rows(" + batch + ", Tensor(a!) radii, Tensor offsets, Tensor(b!)[] gates, Tensor(c!)[] features) -> ()");
  // records: [M, 9] of each view. dL_dmeans2D: [V, N, 3], written where the radius is above 0. gradients: those by the
  // Gaussians that the arguments hold, but for means2D, in their order, summed over the views.
  ops.template add<&project_rows_backward<Backend>>(
      "project_rows_backward(" + batch +
      ", Tensor radii, Tensor offsets, Tensor[] features, Tensor[] records) -> (Tensor dL_dmeans2D, Tensor[] "
      "gradients)");
}

}  // namespace binding
}  // namespace dsmoe
