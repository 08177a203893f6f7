// Models as the tools read them.
#include "model.h"

#include <gtest/gtest.h>

#include <limits>
#include <string>

#include "io_test_support.h"

namespace dsmoe::tools {
namespace {

io::GaussianModel two_gaussians() {
  io::GaussianModel model;
  model.count = 2;
  model.means3D = {0, 0, 0, 1, 1, 1}, model.dc = model.log_scales = model.means3D;
  model.opacity_logits = {0, 1};
  model.rotations = {1, 0, 0, 0, 1, 0, 0, 0};
  model.blend_mode = "alpha";
  return model;
}

TEST(ReadModel, RefusesOneOfWhichNoGaussianIsFinite) {
  const io::TemporaryFolder folder;
  const std::string path = folder.file("model.ply");
  io::GaussianModel model = two_gaussians();
  model.means3D[1] = std::numeric_limits<float>::quiet_NaN();
  io::write_gaussians(path, model);
  EXPECT_EQ(read_model(path).count, 2);
  model.opacity_logits[1] = std::numeric_limits<float>::infinity();
  io::write_gaussians(path, model);
  const std::string error = io::format_error_of([&] { read_model(path); });
  EXPECT_NE(error.find("each of its 2 Gaussians"), std::string::npos) << error;
}

TEST(ReadModel, TakesOneWithoutGaussians) {
  const io::TemporaryFolder folder;
  const std::string path = folder.file("model.ply");
  io::write_gaussians(path, {});
  EXPECT_EQ(read_model(path).count, 0);
}

TEST(ChooseBlend, TakesFaintBelowFromTheFileInItsOwnBlend) {
  io::GaussianModel model = two_gaussians();
  model.blend_mode = "smoe", model.faint_below = 2;
  EXPECT_EQ(choose_blend(model, "model.ply", "", std::nullopt).faint_below, 2);
  const double usual = BlendRules<double>().faint_below;
  EXPECT_EQ(choose_blend(model, "model.ply", "smoe_eq7", std::nullopt).faint_below, usual);
  model.faint_below.reset();
  EXPECT_EQ(choose_blend(model, "model.ply", "", std::nullopt).faint_below, usual);
}

}  // namespace
}  // namespace dsmoe::tools
