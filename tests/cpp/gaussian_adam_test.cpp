// Adam with activations against the activations, their gradients and Adam one after the other.
#include "dsmoe/gaussian_adam.h"

#include <gtest/gtest.h>

#include <vector>

#include "dsmoe/gaussians.h"

namespace dsmoe {
namespace {

constexpr AdamConstants<double> kConstants = {0.9, 0.999, 1 - 0.9, 1 - 0.999, 1e-15};
constexpr int kCount = 5;
constexpr int kSizes[kGaussianAdamTensors] = {3, 1, 3, 4};

std::vector<double> numbers(int size, double first) {
  std::vector<double> out;
  for (int i = 0; i < size * kCount; ++i) out.push_back(first + 0.37 * i - 0.11 * (i % 3) * i);
  return out;
}

TEST(GaussianAdam, IsActivateBackwardAdamAndActivate) {
  std::vector<double> raw[4], value[4], gradient[4], by_raw[4], moment[4], square[4], expected[4];
  const int32_t radii[kCount] = {4, 0, 1, 0, 9};
  for (int t = 0; t < 4; ++t) {
    raw[t] = numbers(kSizes[t], 0.2 * t - 0.5), value[t] = raw[t];
    gradient[t] = numbers(kSizes[t], 0.7), moment[t] = numbers(kSizes[t], -0.3), square[t] = numbers(kSizes[t], 0.1);
    for (double& number : square[t]) number *= number;
    for (int i = 0; i < kSizes[t] * kCount; ++i) gradient[t][i] *= radii[i / kSizes[t]] > 0;
    by_raw[t] = gradient[t];
  }
  const auto pointers = [](std::vector<double>* of) {
    return GaussianParameters<double>{of[1].data(), of[2].data(), of[3].data()};
  };
  const auto constant = [&](std::vector<double>* of) {
    return GaussianParameters<const double>{of[1].data(), of[2].data(), of[3].data()};
  };
  const auto activate = [&] {
    for (int i = 0; i < kCount; ++i) Activate<double>{constant(raw), pointers(value)}(i);
  };
  activate();
  GaussianAdam<double> adam = {};
  adam.num_gaussians = kCount, adam.radii = radii, adam.constants = kConstants;
  const Activation activations[] = {Activation::kNone, Activation::kSigmoid, Activation::kExp,
                                    Activation::kUnitQuaternion};
  std::vector<double> stepped[4], stepped_moment[4], stepped_square[4], unread[4], stepped_value[4];
  for (int t = 0; t < 4; ++t) {
    stepped[t] = raw[t], stepped_moment[t] = moment[t], stepped_square[t] = square[t], stepped_value[t] = value[t];
    unread[t] = gradient[t];
    for (int i = 0; i < kSizes[t] * kCount; ++i) {
      if (radii[i / kSizes[t]] == 0) unread[t][i] = 1e9;  // what was not seen has no gradient, whatever lies there
    }
    adam.tensors[t] = {stepped[t].data(),        t > 0 ? stepped_value[t].data() : nullptr,
                       unread[t].data(),         stepped_moment[t].data(),
                       stepped_square[t].data(), kSizes[t],
                       activations[t],           {0.1 + t, 2.0 - 0.1 * t}};
  }
  cpu::step_gaussians(adam, 2);

  for (int i = 0; i < kCount; ++i) {
    ActivateBackward<double>{constant(raw), constant(value), constant(gradient), pointers(by_raw)}(i);
  }
  for (int t = 0; t < 4; ++t) {
    for (int i = 0; i < kSizes[t] * kCount; ++i) {
      adam_step(kConstants, adam.tensors[t].rates, by_raw[t][i], raw[t][i], moment[t][i], square[t][i]);
    }
  }
  activate();
  for (int t = 0; t < 4; ++t) {
    EXPECT_EQ(stepped[t], raw[t]);
    EXPECT_EQ(stepped_moment[t], moment[t]);
    EXPECT_EQ(stepped_square[t], square[t]);
    EXPECT_EQ(stepped_value[t], value[t]) << "of means it is not written";
  }
}

}  // namespace
}  // namespace dsmoe
