// Opacity, scale and rotation from what an optimizer moves.
#include "dsmoe/activations.h"

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

}  // namespace
}  // namespace dsmoe
