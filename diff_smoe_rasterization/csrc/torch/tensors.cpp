#include "tensors.h"

namespace dsmoe {
namespace binding {

Inputs contiguous(Inputs inputs) {
  for (Tensor& tensor : inputs) {
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

Images allocate_images(const Tensor& like, const ImageSizes& sizes, const Options& options) {
  Images images;
  for (int i = 0; i < kNumImages; ++i) {
    const auto image = static_cast<Image>(i);
    images[i] = empty(image_shape(image, sizes, options), like, image == kRadii ? kInt : like.scalar_type());
  }
  return images;
}

Inputs allocate_gradients(const Inputs& inputs, const InputMask& wanted) {
  Inputs gradients;
  for (int i = 0; i < kNumInputs; ++i) {
    if (wanted[i]) gradients[i] = empty_like(inputs[i]);
  }
  return gradients;
}

ScalarType scalar_type(NumberType type) {
  switch (type) {
    case NumberType::kFloat:
      return kFloat;
    case NumberType::kDouble:
      return kDouble;
    case NumberType::kInt32:
      return kInt;
    case NumberType::kInt64:
      return kLong;
  }
  return kFloat;
}

std::vector<int64_t> saved_shape(const SavedArray& array) {
  if (array.columns == 1) return {array.rows};
  return {array.rows, array.columns};
}

}  // namespace binding
}  // namespace dsmoe
