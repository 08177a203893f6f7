// Views: json files, the matrices of a view, orbits.
#include "views.h"

#include <gtest/gtest.h>

#include <cmath>
#include <stdexcept>

#include "io_test_support.h"

namespace dsmoe::tools {
namespace {

using io::expect_contains;
using io::format_error_of;

constexpr const char* kTransforms = R"({"w": 64, "h": 48, "fl_x": 50, "cx": 30, "k1": 0, "frames": [
  {"file_path": "a.png", "transform_matrix": [[0,0,1,5],[1,0,0,6],[0,1,0,7],[0,0,0,1]]},
  {"file_path": "b.png", "fl_x": 40, "fl_y": 41, "cy": 20,
   "transform_matrix": [[1,0,0,0],[0,1,0,0],[0,0,1,0],[0,0,0,1]]}]})";
constexpr const char* kInria = R"([{"id": 0, "img_name": "v", "width": 64, "height": 48, "fx": 50, "fy": 51,
  "position": [5, 6, 7], "rotation": [[0, 0, -1], [1, 0, 0], [0, -1, 0]]}])";

/// A point of the world in the view.
std::array<double, 3> seen(const View& view, const std::array<double, 3>& p) {
  std::array<double, 3> out = view.translation;
  for (int row = 0; row < 3; ++row) {
    for (int k = 0; k < 3; ++k) out[row] += view.rotation[3 * row + k] * p[k];
  }
  return out;
}

#if DSMOE_WITH_JSON
TEST(JsonViews, TransformsHaveOpenGlAxesAndValuesOfTheirFrame) {
  const std::vector<View> views = parse_json_views(kTransforms, "t.json", {});
  ASSERT_EQ(views.size(), 2u);
  EXPECT_EQ(views[0].name, "a.png");
  EXPECT_EQ(views[0].fx, 50);
  EXPECT_EQ(views[0].fy, 50);
  EXPECT_EQ(views[0].cx, 30);
  EXPECT_EQ(views[0].cy, 24);
  EXPECT_EQ(views[1].fx, 40);
  EXPECT_EQ(views[1].fy, 41);
  EXPECT_EQ(views[1].cy, 20);
  // Columns of the matrix: right is world y, up is world z, back is world x. One step ahead is (-1, 0, 0).
  EXPECT_EQ(seen(views[0], {5, 6, 7}), (std::array<double, 3>{0, 0, 0}));
  EXPECT_EQ(seen(views[0], {4, 6, 7}), (std::array<double, 3>{0, 0, 1}));
  EXPECT_EQ(seen(views[0], {5, 7, 7}), (std::array<double, 3>{1, 0, 0}));
  EXPECT_EQ(seen(views[0], {5, 6, 8}), (std::array<double, 3>{0, -1, 0}));
}

TEST(JsonViews, InriaCamerasAreTheSameViewInOurAxes) {
  const std::vector<View> views = parse_json_views(kInria, "cameras.json", {});
  ASSERT_EQ(views.size(), 1u);
  EXPECT_EQ(seen(views[0], {4, 6, 7}), (std::array<double, 3>{0, 0, 1}));
  EXPECT_EQ(seen(views[0], {5, 7, 7}), (std::array<double, 3>{1, 0, 0}));
  EXPECT_EQ(seen(views[0], {5, 6, 8}), (std::array<double, 3>{0, -1, 0}));
  EXPECT_EQ(views[0].fy, 51);
  EXPECT_EQ(views[0].cx, 32);
}

TEST(JsonViews, AnAngleOfViewIsThatOfTheWholeWidth) {
  const std::string text = R"({"camera_angle_x": 1.5707963267948966, "frames": [{"file_path": "a",
    "transform_matrix": [[1,0,0,0],[0,1,0,0],[0,0,1,0],[0,0,0,1]]}]})";
  const std::vector<View> views = parse_json_views(text, "t.json", {200, 100});
  EXPECT_EQ(views[0].width, 200);
  EXPECT_EQ(views[0].height, 100);
  EXPECT_NEAR(views[0].fx, 100, 1e-12);  // tan(45 degrees) is 1 but for rounding
  EXPECT_NEAR(views[0].fy, 100, 1e-12);
  expect_contains(format_error_of([&] { parse_json_views(text, "t.json", {}); }), "--size");
}

TEST(JsonViews, HaveTheLensOfTheirFile) {
  const auto with = [](const char* valid, const std::string& from, const std::string& to) {
    std::string text = valid;
    return parse_json_views(text.replace(text.find(from), from.size(), to), "c.json", {})[0];
  };
  EXPECT_EQ(with(kTransforms, "\"k1\": 0", "\"k1\": 0").model, LensModel::kPinhole);
  const View bent = with(kTransforms, "\"k1\": 0", "\"k1\": 0.1, \"p2\": 0.2, \"k3\": 0.3");
  EXPECT_EQ(bent.model, LensModel::kOpencv);
  EXPECT_EQ(bent.distortion, (std::vector<double>{0.1, 0, 0, 0.2, 0.3}));
  for (const char* fisheye :
       {"\"k3\": 0.3, \"is_fisheye\": true", "\"k3\": 0.3, \"camera_model\": \"OPENCV_FISHEYE\""}) {
    const View view = with(kTransforms, "\"k1\": 0", fisheye);
    EXPECT_EQ(view.model, LensModel::kFisheye);
    EXPECT_EQ(view.distortion, (std::vector<double>{0, 0, 0.3, 0}));
  }
  EXPECT_EQ(with(kTransforms, "\"k1\": 0", "\"camera_model\": \"EQUIRECTANGULAR\"").model, LensModel::kEquirectangular);
  const View inria =
      with(kInria, "\"id\": 0", R"("camera_model": "fisheye", "distortion": [0.1, 0.2], "cx": 30, "cy": 20)");
  EXPECT_EQ(inria.model, LensModel::kFisheye);
  EXPECT_EQ(inria.distortion, (std::vector<double>{0.1, 0.2}));
  EXPECT_EQ(inria.cx, 30);
  EXPECT_EQ(inria.cy, 20);
}

TEST(JsonViews, RefuseWithPlaceAndReason) {
  const auto expect_refused = [](const char* valid, const std::string& from, const std::string& to,
                                 const std::string& place, const std::string& reason) {
    std::string text = valid;
    const std::size_t at = text.find(from);
    ASSERT_NE(at, std::string::npos) << from;
    text.replace(at, from.size(), to);
    const std::string message = format_error_of([&] { parse_json_views(text, "c.json", {}); });
    expect_contains(message, "c.json" + place);
    expect_contains(message, reason);
  };
  expect_refused(kInria, "\"v\", ", "\"v\" ", ", byte ", "not valid json");
  expect_refused(kInria, "50", "NaN", ", byte ", "not valid json");
  expect_refused(kInria, "50", "1e999", "", "not valid json");
  expect_refused(kInria, "64", "-64", ": camera 0: `width`", "-64");
  expect_refused(kInria, "64", "6.5", ": camera 0: `width`", "whole number");
  expect_refused(kInria, "64", "1e300", ": camera 0: `width`", "1e+300");
  expect_refused(kInria, "50", "0", ": camera 0: `fx`", "must be a number from");
  expect_refused(kInria, "50", "true", ": camera 0: `fx`", "true");
  expect_refused(kInria, "50", "\"µ\"", ": camera 0: `fx`", "µ");
  expect_refused(kInria, "[5, 6, 7]", "[5, 6]", ": camera 0: `position`", "3 numbers");
  expect_refused(kInria, "[5, 6, 7]", "7", ": camera 0: `position`", "3 numbers");
  expect_refused(kInria, "[0, 0, -1]", "[0, 0, 1]", ": camera 0: `rotation`", "mirrors");
  expect_refused(kInria, "[0, 0, -1]", "[0, 0, 0]", ": camera 0: `rotation`", "not a rotation");
  expect_refused(kInria, "\"img_name\"", "\"name\"", ": camera 0", "`img_name` is missing");
  expect_refused(kInria, "\"id\": 0", "\"camera_model\": \"fish\"", ": camera 0: `camera_model`", "is \"fish\"");
  expect_refused(kInria, "\"id\": 0", "\"camera_model\": \"fisheye\", \"distortion\": [1, 2, 3]",
                 ": \"v\": ", "distortion has 3 numbers; it must have 0, 1, 2 or 4");
  expect_refused(kInria, "\"id\": 0", "\"camera_model\": \"opencv\", \"distortion\": [-1e8]",
                 ": \"v\": ", "folds the image back");
  expect_refused(kInria, "\"id\": 0", "\"distortion\": [0.1]", ": \"v\": ", "distortion has 1 numbers; it must have 0");
  expect_refused(kInria, "\"id\": 0", "\"distortion\": 0.1", ": camera 0: `distortion`", "a list of numbers");
  expect_refused(kTransforms, "\"k1\": 0", "\"k4\": 0.1", ": `k4`", "must be 0 for `camera_model` OPENCV");
  expect_refused(kTransforms, "\"k1\": 0", "\"p1\": 0.1, \"is_fisheye\": true", ": `p1`", "must be 0");
  expect_refused(kTransforms, "\"k1\": 0", "\"k1\": 0.1, \"camera_model\": \"EQUIRECTANGULAR\"", ": `k1`", "must be 0");
  expect_refused(kTransforms, "\"k1\": 0", "\"camera_model\": \"FISHEYE624\"", ": `camera_model`", "OPENCV_FISHEYE");
  expect_refused(kTransforms, "\"frames\"", "\"views\"", "", "`frames` is missing");
  expect_refused(kTransforms, "\"a.png\"", "3", ": frame 0: `file_path`", "must be a text");
  expect_refused(kTransforms, "\"fl_x\": 40", "\"fl_x\": \"40\"", ": frame 1: `fl_x`", "40");
  for (const char* text : {"", "3", "[]", "[3]", "{\"frames\": []}", "{\"frames\": 3}", "nul"}) {
    EXPECT_THROW(parse_json_views(text, "c.json", {}), io::FormatError) << text;
  }
}

TEST(JsonViews, DamageIsSurvived) {
  for (const char* valid : {kTransforms, kInria}) {
    io::expect_survives_damage(
        valid, [](const std::string& b) { parse_json_views(b, "damaged", {}); }, 1000);
  }
}
#else
TEST(JsonViews, SayThatThisBuildHasNone) {
  expect_contains(format_error_of([&] { parse_json_views(kInria, "c.json", {}); }), "nlohmann");
}
#endif

TEST(View, KeepsWhatItShowsAtAnotherSize) {
  const View view = orbit_views({})[0];
  const View half = resized(view, view.width / 2, view.height / 4);
  EXPECT_EQ(half.fx, view.fx / 2);
  EXPECT_EQ(half.cx, view.cx / 2);
  EXPECT_EQ(half.fy, view.fy / 4);
  EXPECT_EQ(half.cy, view.cy / 4);
}

TEST(Orbit, LooksAtItsTargetFromItsDistanceWithUpAbove) {
  Orbit orbit;
  orbit.count = 8;
  orbit.target = {1, 2, 3};
  orbit.distance = 5;
  orbit.elevation = 30;
  for (const std::array<double, 3>& up : {std::array<double, 3>{0, -1, 0}, {0, 0, 2}, {1, 1, -1}}) {
    orbit.up = up;
    const double length = std::sqrt(up[0] * up[0] + up[1] * up[1] + up[2] * up[2]);
    for (const View& view : orbit_views(orbit)) {
      const std::array<double, 3> target = seen(view, orbit.target);
      EXPECT_NEAR(target[0], 0, 1e-12);
      EXPECT_NEAR(target[1], 0, 1e-12);
      EXPECT_NEAR(target[2], 5, 1e-12);
      const std::array<double, 3> above = seen(view, {1 + up[0] / length, 2 + up[1] / length, 3 + up[2] / length});
      EXPECT_NEAR(above[0], 0, 1e-12);
      EXPECT_NEAR(above[1], -std::cos(M_PI / 6), 1e-12);     // y is down
      EXPECT_NEAR(above[2], 5 - std::sin(M_PI / 6), 1e-12);  // the camera is 30 degrees above
    }
  }
  orbit.up = {0, 0, 0};
  EXPECT_THROW(orbit_views(orbit), std::invalid_argument);
}

/// The column and row of a point on the view's image, and whether its lens shows it.
LensPoint<float> shown(const View& view, const Vec3<float>& point) { return through_lens(camera_of(view).lens, point); }

TEST(CameraOf, HasTheLensOfItsView) {
  View view;
  view.width = 200, view.height = 100, view.fx = 60, view.fy = 50, view.cx = 90, view.cy = 40;
  view.rotation = {1, 0, 0, 0, 1, 0, 0, 0, 1};
  EXPECT_EQ(camera_of(view).lens.model, LensModel::kPinhole);
  // 60 degrees to the right; a first pixel's centre is 0 in the rasterizer, and 0.5 in a view.
  const Vec3<float> aside = {std::sqrt(3.0f), 0, 1};
  view.model = LensModel::kFisheye, view.distortion = {0.1};
  const double angle = M_PI / 3;
  EXPECT_NEAR(shown(view, aside).pixel.x, 60 * angle * (1 + 0.1 * angle * angle) + 89.5, 1e-4);
  EXPECT_NEAR(shown(view, aside).pixel.y, 39.5, 1e-4);
  const View half = resized(view, 100, 50);
  EXPECT_NEAR(shown(half, aside).pixel.x, (shown(view, aside).pixel.x + 0.5) / 2 - 0.5, 1e-4);
  set_panorama(view), view.distortion.clear();
  EXPECT_NEAR(shown(view, aside).pixel.x, 200 * (0.5 + 60 / 360.0) - 0.5, 1e-4);
  EXPECT_NEAR(shown(view, {0, 1, 0.01f}).pixel.y, 100 * (1 - std::atan(0.01) / M_PI) - 0.5, 1e-3);
}

TEST(ColmapViews, HaveTheLensOfTheirCamera) {
  io::ColmapModel model;
  model.cameras.push_back({7, io::find_camera_model("SIMPLE_PINHOLE"), 64, 48, {50, 30, 20}});
  io::ColmapImage image;
  image.camera_id = 7, image.name = "a/b.jpg";
  image.qvec = {std::sqrt(0.5), 0, 0, std::sqrt(0.5)};  // a quarter turn about z
  image.tvec = {1, 2, 3};
  model.images.push_back(image);
  const View view = views_of(model, "folder")[0];
  EXPECT_EQ(view.fx, 50);
  EXPECT_EQ(view.fy, 50);
  EXPECT_EQ(view.cx, 30);
  EXPECT_EQ(view.cy, 20);
  const std::array<double, 3> turned = seen(view, {1, 0, 0});
  EXPECT_NEAR(turned[0], 1, 1e-12);
  EXPECT_NEAR(turned[1], 3, 1e-12);
  EXPECT_NEAR(turned[2], 3, 1e-12);
  const auto with = [&](const char* name, const std::vector<double>& params) {
    model.cameras[0].model = io::find_camera_model(name), model.cameras[0].params = params;
    return views_of(model, "folder")[0];
  };
  const View radial = with("SIMPLE_RADIAL", {50, 30, 20, 0.1});
  EXPECT_EQ(radial.model, LensModel::kOpencv);
  EXPECT_EQ(radial.fy, 50);
  EXPECT_EQ(radial.cy, 20);
  EXPECT_EQ(radial.distortion, (std::vector<double>{0.1}));
  const View fisheye = with("OPENCV_FISHEYE", {50, 51, 30, 20, 0.1, 0.2, 0.3, 0.4});
  EXPECT_EQ(fisheye.model, LensModel::kFisheye);
  EXPECT_EQ(fisheye.fy, 51);
  EXPECT_EQ(fisheye.distortion, (std::vector<double>{0.1, 0.2, 0.3, 0.4}));
  EXPECT_EQ(with("FISHEYE", {50, 51, 30, 20}).model, LensModel::kFisheye);
  EXPECT_EQ(with("THIN_PRISM_FISHEYE", {50, 51, 30, 20, 0, 0, 0, 0, 0, 0, 0, 0}).model, LensModel::kThinPrismFisheye);
  EXPECT_EQ(with("FULL_OPENCV", {50, 51, 30, 20, 0, 0, 0, 0, 0, 0, 0, 0.1}).distortion.size(), 8u);
  EXPECT_EQ(with("EQUIRECTANGULAR", {64, 48}).model, LensModel::kEquirectangular);
  expect_contains(format_error_of([&] { with("FOV", {50, 51, 30, 20, 0.1}); }), "folder: camera 7 has the model FOV");
  expect_contains(format_error_of([&] {
                    with("RADIAL", {50, 30, 20, -1e8, 0});
                  }),
                  "folder: \"a/b.jpg\": distortion folds the image");
}

}  // namespace
}  // namespace dsmoe::tools
