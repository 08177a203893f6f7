#include "tensors.h"

namespace dsmoe {
namespace binding {

Inputs contiguous(Inputs inputs) {
  for (at::Tensor& tensor : inputs) {
    if (tensor.defined()) tensor = tensor.contiguous();
  }
  return inputs;
}

std::vector<int64_t> image_shape(Image image, const ImageSizes& sizes, const Options& options) {
  const int64_t height = options.image_height, width = options.image_width;
  if (image == kColor) return {sizes.num_channels, height, width};
  if (image == kRadii) return {sizes.num_gaussians};
  bool wanted = true;
  for_each_feature_image([&](Image other, auto field) {
    if (image == other) wanted = field(options);
  });
  return wanted ? std::vector<int64_t>{1, height, width} : std::vector<int64_t>{0};
}

Images allocate_images(const at::Tensor& like_tensor, const ImageSizes& sizes, const Options& options) {
  const at::TensorOptions like = like_tensor.options();
  Images images;
  for (int i = 0; i < kNumImages; ++i) {
    const auto image = static_cast<Image>(i);
    images[i] = at::empty(image_shape(image, sizes, options), image == kRadii ? like.dtype(at::kInt) : like);
  }
  return images;
}

Inputs allocate_gradients(const Inputs& inputs, const InputMask& wanted) {
  Inputs gradients;
  for (int i = 0; i < kNumInputs; ++i) {
    if (wanted[i]) gradients[i] = at::empty(inputs[i].sizes(), inputs[i].options());
  }
  return gradients;
}

at::ScalarType scalar_type(NumberType type) {
  switch (type) {
    case NumberType::kFloat:
      return at::kFloat;
    case NumberType::kDouble:
      return at::kDouble;
    case NumberType::kInt32:
      return at::kInt;
    case NumberType::kInt64:
      return at::kLong;
  }
  return at::kFloat;
}

std::vector<int64_t> saved_shape(const SavedArray& array) {
  if (array.columns == 1) return {array.rows};
  return {array.rows, array.columns};
}

}  // namespace binding
}  // namespace dsmoe
