#include <gtest/gtest.h>

#include <cmath>
#include <limits>

#include "io/splat.h"
#include "io_test_support.h"

namespace dsmoe::io {
namespace {

/// One Gaussian whose numbers are all different.
Bytes record(float x = 1, float scale = 0.5f) {
  Bytes bytes;
  bytes.put(x).put(-2.0f).put(3.0f).put(scale).put(0.25f).put(0.0f);
  for (const int byte : {255, 0, 51, 204}) bytes.put(static_cast<std::uint8_t>(byte));
  for (const int byte : {192, 128, 0, 64}) bytes.put(static_cast<std::uint8_t>(byte));
  return bytes;
}

TEST(Splat, GivesRawParameters) {
  const GaussianModel model = parse_splat(record().str() + record(7).str(), "a.splat");
  EXPECT_EQ(model.count, 2u);
  EXPECT_EQ(model.sh_degree, 0);
  EXPECT_TRUE(model.shs.empty());
  EXPECT_TRUE(model.blend_mode.empty());
  EXPECT_EQ(model.means3D, (std::vector<float>{1, -2, 3, 7, -2, 3}));
  EXPECT_EQ(model.log_scales[0], std::log(0.5f));
  EXPECT_EQ(model.log_scales[2], -std::numeric_limits<float>::infinity());  // a flat one: exp gives 0 again
  // Colour is 0.5 + 0.2820948 dc.
  EXPECT_FLOAT_EQ(model.dc[0], 1.7724539f);
  EXPECT_FLOAT_EQ(model.dc[1], -1.7724539f);
  EXPECT_FLOAT_EQ(model.dc[2], -1.0634723f);
  EXPECT_FLOAT_EQ(model.opacity_logits[0], std::log(4.0f));  // 204 / 255 = 4 / 5
  EXPECT_EQ((std::vector<float>(model.rotations.begin(), model.rotations.begin() + 4)),
            (std::vector<float>{0.5f, 0, -1, -0.5f}));
}

TEST(Splat, KeepsLogitsFinite) {
  std::string bytes = record().str();
  bytes[27] = '\xff';
  EXPECT_FLOAT_EQ(parse_splat(bytes, "a").opacity_logits[0], std::log(509.0f));  // half a level below 1
  bytes[27] = '\0';
  EXPECT_FLOAT_EQ(parse_splat(bytes, "a").opacity_logits[0], -std::log(509.0f));
}

TEST(Splat, RefusesWithPlaceAndReason) {
  const auto expect_refused = [](const std::string& bytes, const std::string& place, const std::string& reason) {
    const std::string message = format_error_of([&] { parse_splat(bytes, "a.splat"); });
    expect_contains(message, "a.splat" + place);
    expect_contains(message, reason);
  };
  expect_refused(record().str() + "x", ": ", "33 bytes");
  expect_refused(record().str() + record(NAN).str(), ", byte 32: ", "a position is nan");
  expect_refused(record(1, -0.5f).str(), ", byte 12: ", "a scale is -0.5");
  expect_refused(record(1, INFINITY).str(), ", byte 12: ", "a scale is inf");
}

TEST(Splat, EmptyFileIsAModelOfNoGaussians) { EXPECT_EQ(parse_splat("", "a").count, 0u); }

TEST(Splat, DamageIsSurvived) {
  expect_survives_damage(record().str() + record(2).str(), [](const std::string& b) { parse_splat(b, "damaged"); });
}

}  // namespace
}  // namespace dsmoe::io
