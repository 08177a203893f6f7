// PLY: Gaussian models, point clouds and the vertex reader under both.
#include <gtest/gtest.h>

#include <cmath>
#include <limits>
#include <optional>

#include "io/ply.h"
#include "io/ply_vertices.h"
#include "io_test_support.h"

namespace dsmoe::io {
namespace {

GaussianModel make_model(std::size_t count, int sh_degree) {
  float next = 0.25F;
  const auto fill = [&](std::vector<float>& values, std::size_t width) {
    values.resize(count * width);
    for (float& value : values) value = next = -1.01F * next + 0.37F;  // all different
  };
  GaussianModel model;
  model.count = count;
  model.sh_degree = sh_degree;
  fill(model.means3D, 3);
  fill(model.dc, 3);
  fill(model.shs, static_cast<std::size_t>(3 * ((sh_degree + 1) * (sh_degree + 1) - 1)));
  fill(model.opacity_logits, 1);
  fill(model.log_scales, 3);
  fill(model.rotations, 4);
  return model;
}

void expect_same(const GaussianModel& a, const GaussianModel& b) {
  EXPECT_EQ(a.count, b.count);
  EXPECT_EQ(a.sh_degree, b.sh_degree);
  EXPECT_EQ(a.means3D, b.means3D);
  EXPECT_EQ(a.dc, b.dc);
  EXPECT_EQ(a.shs, b.shs);
  EXPECT_EQ(a.opacity_logits, b.opacity_logits);
  EXPECT_EQ(a.log_scales, b.log_scales);
  EXPECT_EQ(a.rotations, b.rotations);
}

TEST(PlyGaussians, ReadBackAsWrittenAtEveryDegree) {
  const TemporaryFolder folder;
  for (int degree = 0; degree <= 3; ++degree) {
    const GaussianModel written = make_model(7, degree);
    write_gaussians(folder.file("a.ply"), written);
    expect_same(read_gaussians(folder.file("a.ply")), written);
  }
}

TEST(PlyGaussians, EmptyModelIsAModel) {
  const TemporaryFolder folder;
  write_gaussians(folder.file("a.ply"), make_model(0, 2));
  expect_same(read_gaussians(folder.file("a.ply")), make_model(0, 2));
}

TEST(PlyGaussians, HeaderHasInriasColumnsInInriasOrder) {
  const TemporaryFolder folder;
  GaussianModel model = make_model(2, 1);
  model.blend_mode = "smoe";
  write_gaussians(folder.file("a.ply"), model);
  std::string expected = "ply\nformat binary_little_endian 1.0\ncomment blend_mode smoe\nelement vertex 2\n";
  for (const char* name :
       {"x",        "y",        "z",        "nx",       "ny",       "nz",       "f_dc_0",   "f_dc_1",   "f_dc_2",
        "f_rest_0", "f_rest_1", "f_rest_2", "f_rest_3", "f_rest_4", "f_rest_5", "f_rest_6", "f_rest_7", "f_rest_8",
        "opacity",  "scale_0",  "scale_1",  "scale_2",  "rot_0",    "rot_1",    "rot_2",    "rot_3"}) {
    expected += std::string("property float ") + name + "\n";
  }
  expected += "end_header\n";
  const std::string bytes = read_bytes(folder.file("a.ply"));
  EXPECT_EQ(bytes.substr(0, expected.size()), expected);
  EXPECT_EQ(bytes.size(), expected.size() + 2 * 26 * 4);  // 26 columns of 4 bytes
}

/// A header and one row, with f_rest_i = i and every other column its position in the row plus 100.
std::string one_gaussian(int num_rest, const std::string& type = "float", const std::string& skipped = "") {
  std::string header = "ply\nformat ascii 1.0\nelement vertex 1\n";
  std::string row;
  int position = 100;
  const auto add = [&](const std::string& name, int value) {
    if (name == skipped) return;
    header += "property " + type + " " + name + "\n";
    row += std::to_string(value) + " ";
  };
  for (const char* name : {"rot_0", "rot_1", "rot_2", "rot_3", "opacity"}) add(name, position++);
  for (int i = 0; i < num_rest; ++i) add("f_rest_" + std::to_string(i), i);
  for (const char* name : {"scale_0", "scale_1", "scale_2", "f_dc_0", "f_dc_1", "f_dc_2", "x", "y", "z", "label"}) {
    add(name, position++);
  }
  return header + "end_header\n" + row + "\n";
}

TEST(PlyGaussians, RestIsStoredChannelByChannel) {
  for (const int num_coefficients : {3, 8, 15}) {
    const GaussianModel model = parse_gaussians(one_gaussian(3 * num_coefficients), "file");
    ASSERT_EQ(model.shs.size(), static_cast<std::size_t>(3 * num_coefficients));
    for (int k = 0; k < num_coefficients; ++k) {
      for (int channel = 0; channel < 3; ++channel) {
        EXPECT_EQ(model.shs[static_cast<std::size_t>(3 * k + channel)], channel * num_coefficients + k);
      }
    }
  }
}

TEST(PlyGaussians, ColumnsAreFoundByNameInAnyOrderAndType) {
  for (const char* type : {"float", "double", "int", "uchar", "int16", "float64"}) {
    const GaussianModel model = parse_gaussians(one_gaussian(0, type), "file");
    EXPECT_EQ(model.sh_degree, 0);
    EXPECT_EQ(model.rotations, (std::vector<float>{100, 101, 102, 103})) << type;
    EXPECT_EQ(model.opacity_logits, (std::vector<float>{104})) << type;
    EXPECT_EQ(model.log_scales, (std::vector<float>{105, 106, 107})) << type;
    EXPECT_EQ(model.dc, (std::vector<float>{108, 109, 110})) << type;
    EXPECT_EQ(model.means3D, (std::vector<float>{111, 112, 113})) << type;
  }
}

TEST(PlyGaussians, EveryMissingColumnIsNamed) {
  for (const char* name : {"x", "y", "z", "f_dc_0", "f_dc_2", "opacity", "scale_0", "scale_2", "rot_0", "rot_3"}) {
    const std::string message = format_error_of([&] { parse_gaussians(one_gaussian(9, "float", name), "model.ply"); });
    expect_contains(message, "model.ply");
    expect_contains(message, "\"" + std::string(name) + "\"");
  }
}

TEST(PlyGaussians, OnlyWholeDegreesAreRead) {
  for (const int num_rest : {1, 3, 8, 10, 23, 44, 46, 72}) {
    const std::string message = format_error_of([&] { parse_gaussians(one_gaussian(num_rest), "model.ply"); });
    expect_contains(message, "has " + std::to_string(num_rest) + " properties f_rest_*");
  }
}

TEST(PlyGaussians, NanAndInfinityPassThrough) {
  const TemporaryFolder folder;
  GaussianModel model = make_model(3, 0);
  model.means3D[4] = std::numeric_limits<float>::quiet_NaN();
  model.opacity_logits[2] = std::numeric_limits<float>::infinity();
  write_gaussians(folder.file("a.ply"), model);
  const GaussianModel read = read_gaussians(folder.file("a.ply"));
  EXPECT_TRUE(std::isnan(read.means3D[4]));
  EXPECT_EQ(read.opacity_logits, model.opacity_logits);
}

TEST(PlyGaussians, BlendModeAndCommentsTravel) {
  const TemporaryFolder folder;
  GaussianModel model = make_model(1, 0);
  model.comments = {"made for a test"};
  model.blend_mode = "smoe_tn";
  write_gaussians(folder.file("a.ply"), model);
  const GaussianModel read = read_gaussians(folder.file("a.ply"));
  EXPECT_EQ(read.blend_mode, "smoe_tn");
  EXPECT_EQ(read.comments, (std::vector<std::string>{"made for a test", "blend_mode smoe_tn"}));

  write_gaussians(folder.file("b.ply"), read);  // the mode is not recorded once more
  EXPECT_EQ(read_bytes(folder.file("b.ply")), read_bytes(folder.file("a.ply")));

  model.blend_mode = "";
  write_gaussians(folder.file("c.ply"), model);
  EXPECT_EQ(read_gaussians(folder.file("c.ply")).blend_mode, "");
}

TEST(PlyGaussians, TwoBlendModesAreRefused) {
  const TemporaryFolder folder;
  GaussianModel model = make_model(1, 0);
  model.comments = {"blend_mode alpha"};
  model.blend_mode = "smoe";
  expect_contains(format_error_of([&] { write_gaussians(folder.file("a.ply"), model); }), "two blend modes");
  EXPECT_FALSE(std::filesystem::exists(folder.file("a.ply")));
  std::string bytes = one_gaussian(0);
  bytes.insert(bytes.find("element"), "comment blend_mode alpha\ncomment blend_mode smoe\n");
  expect_contains(format_error_of([&] { parse_gaussians(bytes, "a.ply"); }), "two blend modes");
}

TEST(PlyGaussians, BackgroundGateReadsBackExactly) {
  const TemporaryFolder folder;
  // Neither a tenth nor the float nearest to it has a short binary form; the least double has the longest exponent.
  for (const double gate : {0.0, 0.05, 0.1, static_cast<double>(0.1F), 1.0 / 3, 5e-324, 1e300}) {
    GaussianModel model = make_model(1, 0);
    model.blend_mode = "smoe";
    model.background_gate = gate;
    write_gaussians(folder.file("a.ply"), model);
    const GaussianModel read = read_gaussians(folder.file("a.ply"));
    EXPECT_EQ(read.background_gate, std::optional<double>(gate));
    write_gaussians(folder.file("b.ply"), read);  // it is not recorded once more
    EXPECT_EQ(read_bytes(folder.file("b.ply")), read_bytes(folder.file("a.ply")));
  }
  GaussianModel model = make_model(1, 0);
  model.comments = {"background_gates are other words"};
  write_gaussians(folder.file("c.ply"), model);
  EXPECT_EQ(read_gaussians(folder.file("c.ply")).background_gate, std::nullopt);
  model.background_gate = 0.05;
  write_gaussians(folder.file("d.ply"), model);
  expect_contains(read_bytes(folder.file("d.ply")), "\ncomment background_gate 0.05\n");
}

TEST(PlyGaussians, FaintBelowIsReadFromItsComment) {
  const TemporaryFolder folder;
  std::string bytes = one_gaussian(0);
  EXPECT_EQ(parse_gaussians(bytes, "a.ply").faint_below, std::nullopt);
  const std::size_t place = bytes.find("element");
  std::string wrong = bytes;
  wrong.insert(place, "comment faint_below most\n");
  expect_contains(format_error_of([&] { parse_gaussians(wrong, "a.ply"); }),
                  "a.ply, line 3: the comment's faint_below value is \"most\"; it must be a number, 0 or more");
  bytes.insert(place, "comment blend_mode smoe\ncomment faint_below 0.125\n");
  const GaussianModel read = parse_gaussians(bytes, "a.ply");
  EXPECT_EQ(read.faint_below, std::optional<double>(0.125));
  write_gaussians(folder.file("a.ply"), read);
  const std::string written = read_bytes(folder.file("a.ply"));
  EXPECT_EQ(written.find("faint_below"), written.rfind("faint_below")) << "it is not recorded once more";
  GaussianModel model = make_model(1, 0);
  model.faint_below = 2;
  write_gaussians(folder.file("b.ply"), model);
  EXPECT_EQ(read_gaussians(folder.file("b.ply")).faint_below, std::optional<double>(2));
}

TEST(PlyGaussians, WhatIsNoBackgroundGateIsRefused) {
  const TemporaryFolder folder;
  const auto message_of = [](const std::string& comments) {
    std::string bytes = one_gaussian(0);
    bytes.insert(bytes.find("element"), comments);
    return format_error_of([&] { parse_gaussians(bytes, "a.ply"); });
  };
  for (const std::string text : {"", " -0.05", " nan", " inf", " 0.05x", " 0.05 0.06", " 1e999", " learned"}) {
    const std::string message = message_of("comment blend_mode smoe\ncomment background_gate" + text + "\n");
    expect_contains(message, "a.ply, line 4: the comment's background gate is");
    expect_contains(message, "0 or more");
  }
  expect_contains(message_of("comment background_gate 0.05\ncomment background_gate 0.1\n"),
                  "a.ply, line 4: the comments record two background gates, 0.05 and 0.1");

  GaussianModel model = make_model(1, 0);
  model.background_gate = -1;
  expect_contains(format_error_of([&] { write_gaussians(folder.file("a.ply"), model); }), "\"-1\"");
  model.comments = {"background_gate 0.1"};
  model.background_gate = 0.05;
  expect_contains(format_error_of([&] { write_gaussians(folder.file("a.ply"), model); }), "two background gates");
  EXPECT_FALSE(std::filesystem::exists(folder.file("a.ply")));
}

TEST(PlyGaussians, WritingChecksEverySize) {
  const TemporaryFolder folder;
  const auto refuse = [&](std::vector<float> GaussianModel::*values, const char* name) {
    GaussianModel model = make_model(4, 1);
    (model.*values).pop_back();
    expect_contains(format_error_of([&] { write_gaussians(folder.file("a.ply"), model); }), name);
  };
  refuse(&GaussianModel::means3D, "means3D");
  refuse(&GaussianModel::dc, "dc");
  refuse(&GaussianModel::shs, "shs");
  refuse(&GaussianModel::opacity_logits, "opacity_logits");
  refuse(&GaussianModel::log_scales, "log_scales");
  refuse(&GaussianModel::rotations, "rotations");
  GaussianModel model = make_model(1, 0);
  model.comments = {"two\nlines"};
  expect_contains(format_error_of([&] { write_gaussians(folder.file("a.ply"), model); }), "not one line");
}

TEST(PlyFiles, AppearOnlyWhenComplete) {
  const TemporaryFolder folder;
  const std::string path = folder.file("a.ply");
  write_bytes(path, "what was there before");
  {
    OutputFile file(path);
    file.write("half of");
  }
  EXPECT_EQ(read_bytes(path), "what was there before");
  EXPECT_FALSE(std::filesystem::exists(path + ".partial"));
  OutputFile file(path);
  file.write("all");
  file.commit();
  EXPECT_EQ(read_bytes(path), "all");
}

TEST(PlyFiles, ThatAreNoFilesAreNamed) {
  const TemporaryFolder folder;
  for (const std::string& path : {folder.file("missing.ply"), folder.file("."), std::string("/dev/null")}) {
    try {
      read_points(path);
      ADD_FAILURE() << path << " was read";
    } catch (const FileError& error) {
      expect_contains(error.what(), path);
      EXPECT_NE(error.error_number, 0);
    }
  }
  EXPECT_THROW(write_points(folder.file("no/such/folder/a.ply"), PointCloud()), FileError);
  EXPECT_THROW(write_points("/dev/null", PointCloud()), FileError);
}

const char* const kPointColumns =
    "property float x\nproperty double y\nproperty short z\nproperty uchar red\nproperty uchar green\n"
    "property uchar blue\nproperty float nx\nproperty float ny\nproperty float nz\n";

/// Two points in binary; between their scalars a list, before them an element with a list, after them a third element.
std::string binary_points(bool big_endian, bool with_lists) {
  const std::string list = "property list uchar int neighbours\n";
  Bytes file;
  file.text(std::string("ply\nformat binary_") + (big_endian ? "big" : "little") + "_endian 1.0\ncomment hello\n");
  file.text("element camera 2\nproperty float focal\n" + (with_lists ? list : ""));
  file.text("element vertex 2\n" + (with_lists ? list : "") + kPointColumns);
  file.text("element face 1\nproperty list uchar int vertex_indices\nend_header\n");
  for (int camera = 0; camera < 2; ++camera) {
    file.put(50.0F, big_endian);
    if (with_lists) file.put<std::uint8_t>(1, big_endian).put<std::int32_t>(7, big_endian);
  }
  for (int point = 0; point < 2; ++point) {
    if (with_lists) {
      file.put<std::uint8_t>(2, big_endian).put<std::int32_t>(-1, big_endian).put<std::int32_t>(-2, big_endian);
    }
    file.put(1.5F, big_endian)
        .put(-2.25, big_endian)
        .put<std::int16_t>(static_cast<std::int16_t>(-300 + point), big_endian);
    for (const int color : {255, 128, 0}) file.put(static_cast<std::uint8_t>(color), big_endian);
    for (const float normal : {0.0F, 0.5F, -1.0F}) file.put(normal, big_endian);
  }
  return file.put<std::uint8_t>(1, big_endian).put<std::int32_t>(0, big_endian).str();
}

std::string ascii_points() {
  return std::string("ply\nformat ascii 1.0\ncomment hello\nelement camera 1\nproperty list uchar float focals\n") +
         "element vertex 2\n" + kPointColumns +
         "property list int float weights\nend_header\n3 50 51 52\n"
         "1.5 -2.25 -300 255 128 0 0 +.5 -1e0 0\n\n1.5 -2.25 -299 255 128 0 0 0.5 -1 2 0.5 nan\n";
}

void expect_the_two_points(const PointCloud& points) {
  EXPECT_EQ(points.count, 2U);
  EXPECT_EQ(points.positions, (std::vector<double>{1.5, -2.25, -300, 1.5, -2.25, -299}));
  EXPECT_EQ(points.colors, (std::vector<std::uint8_t>{255, 128, 0, 255, 128, 0}));
  EXPECT_EQ(points.normals, (std::vector<float>{0, 0.5F, -1, 0, 0.5F, -1}));
  EXPECT_EQ(points.comments, std::vector<std::string>{"hello"});
}

TEST(PlyPoints, AreTheSameInEveryFormatWhateverStandsAroundThem) {
  expect_the_two_points(parse_points(ascii_points(), "ascii"));
  for (const bool big_endian : {false, true}) {
    for (const bool with_lists : {false, true}) {
      expect_the_two_points(parse_points(binary_points(big_endian, with_lists), "binary"));
    }
  }
}

TEST(PlyPoints, WindowsLineEndsAreLineEnds) {
  std::string bytes;
  for (const char c : ascii_points()) bytes += c == '\n' ? std::string("\r\n") : std::string(1, c);
  expect_the_two_points(parse_points(bytes, "ascii"));
}

TEST(PlyPoints, ReadBackAsWritten) {
  const TemporaryFolder folder;
  PointCloud points = parse_points(ascii_points(), "ascii");
  write_points(folder.file("a.ply"), points);
  expect_the_two_points(read_points(folder.file("a.ply")));
  points.colors.clear();
  points.normals.clear();
  write_points(folder.file("b.ply"), points);
  const PointCloud plain = read_points(folder.file("b.ply"));
  EXPECT_EQ(plain.positions, points.positions);
  EXPECT_TRUE(plain.colors.empty());
  EXPECT_TRUE(plain.normals.empty());
}

TEST(PlyErrors, NameFileAndReason) {
  const std::string xyz = "property float x\nproperty float y\nproperty float z\n";
  const std::string ascii = "ply\nformat ascii 1.0\n";
  const std::string binary = "ply\nformat binary_little_endian 1.0\n";
  const std::pair<std::string, std::string> cases[] = {
      {"", "cloud.ply: it has 0 bytes, so this is no PLY file, whose first line is \"ply\""},
      {"plyx\n", "no PLY file"},
      {"ply\n", "no end_header"},
      {ascii, "no end_header"},
      {"ply\nelement vertex 0\n" + xyz + "end_header\n", "no format"},
      {"ply\nformat binary 1.0\n", "line 2: the format is \"binary\""},
      {"ply\nformat ascii 2.0\n", "only 1.0"},
      {ascii + "end_header\n", "no element \"vertex\""},
      {ascii + "elephant vertex 3\n", "line 3: the header has the unknown keyword \"elephant\""},
      {ascii + "element vertex -1\n", "count is \"-1\""},
      {ascii + "element vertex 1e3\n", "count is \"1e3\""},
      {ascii + "element vertex 18446744073709551616\n", "whole number"},
      {ascii + "element vertex\n", "count is missing"},
      {ascii + "property float x\n", "before the first element"},
      {ascii + "element vertex 1\nproperty real x\n", "type is \"real\""},
      {ascii + "element vertex 1\nproperty list float int x\n", "floating point type"},
      {ascii + "element vertex 1\nproperty float x\nproperty float x\n", "\"x\" is there twice"},
      {ascii + "element vertex 1\n" + xyz + "element vertex 1\n", "\"vertex\" is there twice"},
      {ascii + "element vertex 1\nend_header\n", "has no property"},
      {ascii + "element vertex 1\nproperty float x y\n", "does not belong there"},
      {ascii + "element vertex 1\nproperty float x" + std::string(1, '\0') + "\n", "which is not a name"},
      {ascii + "element vertex 1\nproperty float x\nend_header\n1\n", "no scalar property \"y\"; it has: x"},
      {ascii + "element vertex 2\n" + xyz + "end_header\n1 2 3\n", "ends after 1 of 2 rows"},
      {ascii + "element vertex 1\n" + xyz + "end_header\n1 2\n", "line 8: z is missing"},
      {ascii + "element vertex 1\n" + xyz + "end_header\n1 2 3 4\n", "\"4\", which does not belong"},
      {ascii + "element vertex 1\n" + xyz + "end_header\n1 2 3x\n", "\"3x\", which is not a number"},
      {ascii + "element vertex 1\n" + xyz + "end_header\n1 1e999 3\n", "\"1e999\", which is not a number"},
      {ascii + "element vertex 1\n" + xyz + "end_header\n1 nan 3\n", "vertex 0: y is nan; it must be finite"},
      {ascii + "element vertex 1\n" + xyz + "property uchar red\nend_header\n1 2 3 256\n", "its type cannot hold"},
      {ascii + "element vertex 1\n" + xyz + "property uchar red\nend_header\n1 2 3 0.5\n", "its type cannot hold"},
      {ascii + "element vertex 1\n" + xyz + "property uchar red\nend_header\n1 2 3 4\n", "property \"green\""},
      {ascii + "element vertex 1\n" + xyz +
           "property float red\nproperty float green\nproperty float blue\nend_header\n1 2 3 0 0.5 0\n",
       "green is 0.5; it must be a whole number from 0 to 255"},
      {binary + "element vertex 1\n" + xyz + "end_header\n12345678901", "11 are left"},
      {binary + "element vertex 18446744073709551615\n" + xyz + "end_header\n123456789012", "12 are left"},
      {binary + "element vertex 1537228672809129302\n" + xyz + "end_header\n123456789012", "12 are left"},  // 2^64 / 12
      {binary + "element face 1\nproperty list char int i\nelement vertex 0\n" + xyz + "end_header\n\xff",
       "negative length"},
      {binary + "element face 1\nproperty list uint double i\nelement vertex 0\n" + xyz +
           "end_header\n\xff\xff\xff\xff",
       "needs 4294967295 x 8 bytes"},
      {binary + "element vertex 999999999999\nproperty list uchar int i\n" + xyz + "end_header\n", "truncated"},
  };
  for (const auto& [bytes, reason] : cases) {
    const std::string content = bytes;
    const std::string message = format_error_of([&] { parse_points(content, "cloud.ply"); });
    expect_contains(message, "cloud.ply");
    expect_contains(message, reason);
  }
}

TEST(PlyErrors, EveryTruncationIsSeen) {
  const TemporaryFolder folder;
  GaussianModel model = make_model(2, 0);
  model.blend_mode = "smoe";
  model.background_gate = 0.05;
  write_gaussians(folder.file("a.ply"), model);
  const std::string bytes = read_bytes(folder.file("a.ply"));
  for (std::size_t length = 0; length < bytes.size(); ++length) {
    EXPECT_THROW(parse_gaussians(bytes.substr(0, length), "a.ply"), FormatError) << length;
  }
}

TEST(PlyErrors, DamageIsSurvived) {
  const TemporaryFolder folder;
  GaussianModel model = make_model(3, 1);
  model.background_gate = 0.05;
  write_gaussians(folder.file("a.ply"), model);
  expect_survives_damage(read_bytes(folder.file("a.ply")), [](const std::string& b) { parse_gaussians(b, "damaged"); });
  const auto parse = [](const std::string& bytes) { parse_points(bytes, "damaged"); };
  expect_survives_damage(ascii_points(), parse);
  expect_survives_damage(binary_points(false, false), parse);
  expect_survives_damage(binary_points(true, true), parse);
}

}  // namespace
}  // namespace dsmoe::io
