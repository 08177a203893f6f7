// Opacity, scale and rotation from what an optimizer moves.
#include "dsmoe/training/gaussians.h"

#include <gtest/gtest.h>

#include <cmath>
#include <vector>

#include "finite_difference.h"

namespace dsmoe {
namespace {

using Vector = std::vector<double>;

TEST(Sigmoid, ByHand) {
  EXPECT_EQ(sigmoid(0.0), 0.5);
  EXPECT_NEAR(sigmoid(std::log(3.0)), 0.75, 1e-15);
  EXPECT_EQ(sigmoid(-1000.0), 0.0);
  EXPECT_EQ(sigmoid(1000.0f), 1.0f);
}

TEST(Sigmoid, BackwardMatchesFiniteDifferences) {
  for (double logit : {-3.0, 0.2, 2.5}) {
    const auto value = [](const Vector& x) { return 1.7 * sigmoid(x[0]); };
    expect_gradient({sigmoid_backward(sigmoid(logit), 1.7)}, value, {logit});
  }
}

TEST(Exp, BackwardMatchesFiniteDifferences) {
  const auto value = [](const Vector& x) { return 1.7 * std::exp(x[0]); };
  expect_gradient({exp_backward(std::exp(-1.2), 1.7)}, value, {-1.2});
}

TEST(NormalizeQuaternion, HasLengthOneInTheSameDirection) {
  const double q[4] = {0, 3e5, 0, -4e5};
  double unit[4];
  normalize_quaternion(q, unit);
  const double expected[4] = {0, 0.6, 0, -0.8};
  for (int i = 0; i < 4; ++i) EXPECT_NEAR(unit[i], expected[i], 1e-15);
}

TEST(NormalizeQuaternion, BackwardMatchesFiniteDifferences) {
  Random random(2);
  for (int i = 0; i < 10; ++i) {
    const Vector q = random.uniforms(4, 0.5, 1.5), weights = random.uniforms(4);
    const auto value = [&](const Vector& x) {
      Vector unit(4);
      normalize_quaternion(x.data(), unit.data());
      return weighted_sum(weights, unit);
    };
    Vector gradient(4);
    normalize_quaternion_backward(q.data(), weights.data(), gradient.data());
    expect_gradient(gradient, value, q);
  }
}

TEST(NormalizeQuaternion, ZeroStaysZeroWithAFiniteGradient) {
  const double q[4] = {}, dL_dunit[4] = {1, -2, 3, 4};
  double unit[4], dL_dq[4];
  normalize_quaternion(q, unit);
  normalize_quaternion_backward(q, dL_dunit, dL_dq);
  for (int i = 0; i < 4; ++i) {
    EXPECT_EQ(unit[i], 0);
    EXPECT_NEAR(dL_dq[i] * kShortestQuaternion, dL_dunit[i], 1e-15);
  }
}

// Adam with activations against the activations, their gradients and Adam one after the other.

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
