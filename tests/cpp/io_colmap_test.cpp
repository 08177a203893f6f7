// COLMAP sparse models, binary and text.
#include <gtest/gtest.h>

#include <cmath>
#include <limits>

#include "io/colmap.h"
#include "io_test_support.h"

namespace dsmoe::io {
namespace {

constexpr ColmapFormat kBinary = ColmapFormat::kBinary;
constexpr ColmapFormat kText = ColmapFormat::kText;
constexpr double kNan = std::numeric_limits<double>::quiet_NaN();

// The same model by hand in both formats: two cameras, two images (the first with two observations), two points
// (the first with a track of three).

std::string binary_cameras() {
  Bytes file;
  file.put<std::uint64_t>(2);
  file.put<std::uint32_t>(1).put<std::int32_t>(1).put<std::uint64_t>(640).put<std::uint64_t>(480);
  file.put(500.5).put(501.5).put(320.0).put(240.25);
  file.put<std::uint32_t>(9).put<std::int32_t>(2).put<std::uint64_t>(1000).put<std::uint64_t>(7);
  file.put(30.0).put(2.0).put(3.5).put(-0.125);
  return file.str();
}

std::string binary_images() {
  Bytes file;
  file.put<std::uint64_t>(2);
  file.put<std::uint32_t>(4).put(0.5).put(-0.5).put(0.5).put(0.5).put(1.0).put(2.0).put(3.0).put<std::uint32_t>(1);
  file.text("left/a b.jpg").put<std::uint8_t>(0).put<std::uint64_t>(2);
  for (int i = 0; i < 2; ++i) file.put(1.5).put(2.5).put<std::int64_t>(-1);
  file.put<std::uint32_t>(3).put(0.0).put(0.0).put(2.0).put(0.0).put(-1.0).put(0.0).put(0.25).put<std::uint32_t>(9);
  file.text("b.jpg").put<std::uint8_t>(0).put<std::uint64_t>(0);
  return file.str();
}

std::string binary_points() {
  Bytes file;
  file.put<std::uint64_t>(2);
  file.put<std::uint64_t>(11).put(1.0).put(-2.0).put(3.25);
  file.put<std::uint8_t>(255).put<std::uint8_t>(0).put<std::uint8_t>(7).put(0.5).put<std::uint64_t>(3);
  for (std::uint32_t i = 0; i < 3; ++i) file.put(i).put(i);
  file.put<std::uint64_t>(70000000000).put(4.0).put(5.0).put(6.0);
  file.put<std::uint8_t>(1).put<std::uint8_t>(2).put<std::uint8_t>(3).put(-1.0).put<std::uint64_t>(0);
  return file.str();
}

const char* const kTextCameras =
    "# Camera list\n#   CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]\n"
    "1 PINHOLE 640 480 500.5 501.5 320 240.25\n\n9 SIMPLE_RADIAL 1000 7 30 2 3.5 -0.125\n";
const char* const kTextImages =
    "# Image list\r\n4 0.5 -0.5 0.5 0.5 1 2 3 1 left/a b.jpg\r\n1.5 2.5 -1 1.5 2.5 -1\r\n"
    "3 0 0 2 0 -1 0 2.5e-1 9 b.jpg\r\n\r\n";
const char* const kTextPoints = "# points\n11 1 -2 3.25 255 0 7 0.5 0 0 1 1 2 2\n70000000000 4 5 6 1 2 3 -1\n";

void expect_the_model(const ColmapModel& model) {
  ASSERT_EQ(model.cameras.size(), 2U);
  EXPECT_EQ(model.cameras[0].id, 1U);
  EXPECT_STREQ(model.cameras[0].model->name, "PINHOLE");
  EXPECT_EQ(model.cameras[0].width, 640U);
  EXPECT_EQ(model.cameras[0].height, 480U);
  EXPECT_EQ(model.cameras[0].params, (std::vector<double>{500.5, 501.5, 320, 240.25}));
  EXPECT_EQ(model.cameras[1].id, 9U);
  EXPECT_STREQ(model.cameras[1].model->name, "SIMPLE_RADIAL");
  EXPECT_EQ(model.cameras[1].params, (std::vector<double>{30, 2, 3.5, -0.125}));
  ASSERT_EQ(model.images.size(), 2U);
  EXPECT_EQ(model.images[0].id, 4U);
  EXPECT_EQ(model.images[0].name, "left/a b.jpg");
  EXPECT_EQ(model.images[0].camera_id, 1U);
  EXPECT_EQ(model.images[0].qvec, (std::array<double, 4>{0.5, -0.5, 0.5, 0.5}));
  EXPECT_EQ(model.images[0].tvec, (std::array<double, 3>{1, 2, 3}));
  EXPECT_EQ(model.images[1].name, "b.jpg");
  EXPECT_EQ(model.images[1].qvec, (std::array<double, 4>{0, 0, 1, 0}));  // stored with length 2
  EXPECT_EQ(model.images[1].tvec, (std::array<double, 3>{-1, 0, 0.25}));
  EXPECT_EQ(model.points.cloud.count, 2U);
  EXPECT_EQ(model.points.cloud.positions, (std::vector<double>{1, -2, 3.25, 4, 5, 6}));
  EXPECT_EQ(model.points.cloud.colors, (std::vector<std::uint8_t>{255, 0, 7, 1, 2, 3}));
  EXPECT_EQ(model.points.errors, (std::vector<double>{0.5, -1}));
}

void write_by_hand(const TemporaryFolder& folder, ColmapFormat format) {
  const std::string extension = format == kBinary ? ".bin" : ".txt";
  write_bytes(folder.file("cameras" + extension), format == kBinary ? binary_cameras() : kTextCameras);
  write_bytes(folder.file("images" + extension), format == kBinary ? binary_images() : kTextImages);
  write_bytes(folder.file("points3D" + extension), format == kBinary ? binary_points() : kTextPoints);
}

TEST(Colmap, BinaryAndTextHoldTheSameModel) {
  for (const ColmapFormat format : {kBinary, kText}) {
    const TemporaryFolder folder;
    write_by_hand(folder, format);
    expect_the_model(read_colmap(folder.file("")));
  }
}

TEST(Colmap, ReadsBackAsWritten) {
  const TemporaryFolder source;
  write_by_hand(source, kBinary);
  const ColmapModel model = read_colmap(source.file(""));
  for (const ColmapFormat format : {kBinary, kText}) {
    const TemporaryFolder folder;
    write_colmap(folder.file("new/model"), model, format);
    expect_the_model(read_colmap(folder.file("new/model")));
  }
}

TEST(Colmap, TextKeepsEveryBitOfADouble) {
  const TemporaryFolder source;
  write_by_hand(source, kBinary);
  ColmapModel model = read_colmap(source.file(""));
  model.points.cloud.positions = {1.0 / 3, 1e-300, -1e300, 0.1, std::nextafter(1.0, 2.0), 123456789.123456789};
  write_colmap(source.file("text"), model, kText);
  EXPECT_EQ(read_colmap(source.file("text")).points.cloud.positions, model.points.cloud.positions);
}

TEST(Colmap, FolderIsFoundWhereTrainersPutIt) {
  const TemporaryFolder folder;
  const std::filesystem::path root = folder.file("scene");
  std::filesystem::create_directories(root / "sparse" / "0");
  try {
    find_colmap_folder(root.string());
    ADD_FAILURE() << "a model was found in an empty folder";
  } catch (const FileError& error) {
    for (const char* part : {"scene", "sparse/0", "cameras.bin", "cameras.txt"}) expect_contains(error.what(), part);
  }
  write_bytes((root / "sparse" / "cameras.txt").string(), kTextCameras);
  EXPECT_EQ(find_colmap_folder(root.string()), (root / "sparse").string());
  write_bytes((root / "sparse" / "0" / "cameras.bin").string(), binary_cameras());
  EXPECT_EQ(find_colmap_folder(root.string()), (root / "sparse" / "0").string());
  write_bytes((root / "cameras.txt").string(), kTextCameras);
  EXPECT_EQ(find_colmap_folder(root.string()), root.string());
}

TEST(Colmap, MissingFileIsNamed) {
  for (const char* name : {"images.bin", "points3D.bin"}) {
    const TemporaryFolder folder;
    write_by_hand(folder, kBinary);
    std::filesystem::remove(folder.file(name));
    try {
      read_colmap(folder.file(""));
      ADD_FAILURE() << "read without " << name;
    } catch (const FileError& error) {
      expect_contains(error.what(), name);
    }
  }
}

TEST(Colmap, EveryCameraModelIsKnownByNumberAndName) {
  // Number, name and number of parameters as COLMAP documents them.
  const std::tuple<int, const char*, int> models[] = {{0, "SIMPLE_PINHOLE", 3},
                                                      {1, "PINHOLE", 4},
                                                      {2, "SIMPLE_RADIAL", 4},
                                                      {3, "RADIAL", 5},
                                                      {4, "OPENCV", 8},
                                                      {5, "OPENCV_FISHEYE", 8},
                                                      {6, "FULL_OPENCV", 12},
                                                      {7, "FOV", 5},
                                                      {8, "SIMPLE_RADIAL_FISHEYE", 4},
                                                      {9, "RADIAL_FISHEYE", 5},
                                                      {10, "THIN_PRISM_FISHEYE", 12},
                                                      {11, "RAD_TAN_THIN_PRISM_FISHEYE", 16},
                                                      {12, "SIMPLE_DIVISION", 4},
                                                      {13, "DIVISION", 5},
                                                      {14, "SIMPLE_FISHEYE", 3},
                                                      {15, "FISHEYE", 4},
                                                      {16, "EUCM", 6},
                                                      {17, "EQUIRECTANGULAR", 2}};
  for (const auto& [id, name, num_params] : models) {
    Bytes binary;
    binary.put<std::uint64_t>(1).put<std::uint32_t>(3).put<std::int32_t>(id);
    binary.put<std::uint64_t>(8).put<std::uint64_t>(8);
    std::string text = std::string("3 ") + name + " 8 8";
    for (int i = 0; i < num_params; ++i) {
      binary.put(1.0 + i);
      text += " " + std::to_string(1 + i);
    }
    const auto from_binary = parse_colmap_cameras(binary.str(), "cameras.bin", kBinary);
    const auto from_text = parse_colmap_cameras(text, "cameras.txt", kText);
    ASSERT_EQ(from_binary.size(), 1U);
    ASSERT_EQ(from_text.size(), 1U);
    EXPECT_STREQ(from_binary[0].model->name, name);
    EXPECT_EQ(from_text[0].model, from_binary[0].model);
    EXPECT_EQ(from_text[0].params, from_binary[0].params);
  }
  EXPECT_EQ(find_camera_model(18), nullptr);
  EXPECT_EQ(find_camera_model(-1), nullptr);
  EXPECT_EQ(find_camera_model("PIN_HOLE"), nullptr);
}

std::string camera_bytes(std::int32_t model, std::uint64_t width, double focal) {
  Bytes file;
  file.put<std::uint64_t>(1).put<std::uint32_t>(3).put(model).put(width).put<std::uint64_t>(8);
  return file.put(1.0).put(focal).put(4.0).put(4.0).str();
}

std::string image_bytes(double qw, double tx, const std::string& name) {
  Bytes file;
  file.put<std::uint64_t>(1).put<std::uint32_t>(5).put(qw).put(0.0).put(0.0).put(0.0).put(tx).put(0.0).put(0.0);
  return file.put<std::uint32_t>(3).text(name).put<std::uint8_t>(0).put<std::uint64_t>(0).str();
}

std::string point_bytes(double z, std::uint64_t track_length) {
  Bytes file;
  file.put<std::uint64_t>(1).put<std::uint64_t>(5).put(0.0).put(0.0).put(z);
  return file.text("rgb").put(0.0).put(track_length).str();
}

TEST(ColmapErrors, OfBinaryFilesNameByteAndReason) {
  const auto cameras = [](const std::string& bytes) { parse_colmap_cameras(bytes, "the file", kBinary); };
  const auto images = [](const std::string& bytes) { parse_colmap_images(bytes, "the file", kBinary); };
  const auto points = [](const std::string& bytes) { parse_colmap_points(bytes, "the file", kBinary); };
  const std::string huge = Bytes().put<std::uint64_t>(1ULL << 60).text(std::string(200, '\1')).str();
  const auto expect_error = [](const auto& parse, const std::string& bytes, const std::string& reason) {
    const std::string message = format_error_of([&] { parse(bytes); });
    expect_contains(message, "the file, byte ");
    expect_contains(message, reason);
  };
  EXPECT_NO_THROW(cameras(camera_bytes(1, 8, 2.0)));
  expect_error(cameras, "", "number of cameras");
  expect_error(cameras, huge, "1152921504606846976");
  expect_error(cameras, camera_bytes(99, 8, 2.0), "unknown camera model 99");
  expect_error(cameras, camera_bytes(1, 0, 2.0), "image side of 0 pixels");
  expect_error(cameras, camera_bytes(1, 1ULL << 40, 2.0), "image side of 1099511627776 pixels");
  expect_error(cameras, camera_bytes(1, 8, kNan), "camera 3 (PINHOLE) has nan as parameter 1");
  expect_error(cameras, camera_bytes(1, 8, 0.0), "a focal length");
  expect_error(cameras, camera_bytes(1, 8, 2.0) + "x", "1 bytes that belong to nothing");
  expect_error(cameras, camera_bytes(4, 8, 2.0), "parameters");  // OPENCV has 8, four are there

  EXPECT_NO_THROW(images(image_bytes(1, 0, "a.jpg")));
  expect_error(images, huge, "1152921504606846976");
  expect_error(images, image_bytes(0, 0, "a.jpg"), "image 5 \"a.jpg\" has a qvec that is not a rotation");
  expect_error(images, image_bytes(kNan, 0, "a.jpg"), "not a rotation");
  expect_error(images, image_bytes(1e200, 0, "a.jpg"), "not a rotation");
  expect_error(images, image_bytes(1, kNan, "a.jpg"), "nan in its tvec");
  expect_error(images, image_bytes(1, 0, ""), "number of images");  // too small a file for one image
  expect_error(images, image_bytes(1, 0, "") + "x", "no usable name");

  EXPECT_NO_THROW(points(point_bytes(1, 0)));
  expect_error(points, huge, "1152921504606846976");
  expect_error(points, point_bytes(kNan, 0), "point 0 has the coordinate nan");
  expect_error(points, point_bytes(1, 1ULL << 62), "length of a track");
}

TEST(ColmapErrors, OfTextFilesNameLineAndReason) {
  const auto cameras = [](const std::string& text) { parse_colmap_cameras(text, "the file", kText); };
  const auto images = [](const std::string& text) { parse_colmap_images(text, "the file", kText); };
  const auto points = [](const std::string& text) { parse_colmap_points(text, "the file", kText); };
  const auto expect_error = [](const auto& parse, const std::string& text, const std::string& reason) {
    const std::string message = format_error_of([&] { parse("# comment\n" + text); });
    expect_contains(message, "the file, line 2");
    expect_contains(message, reason);
  };
  expect_error(cameras, "1 PINHOLE 8 8 1 1 4", "parameter is missing");
  expect_error(cameras, "1 PINHOLE 8 8 1 1 4 4 4", "does not belong there");
  expect_error(cameras, "1 PIN_HOLE 8 8 1 1 4 4", "unknown camera model \"PIN_HOLE\"");
  expect_error(cameras, "1 PINHOLE 8.5 8 1 1 4 4", "width is \"8.5\"");
  expect_error(cameras, "1 PINHOLE 8 8 1 one 4 4", "\"one\", which is not a number");
  expect_error(cameras, "-1 PINHOLE 8 8 1 1 4 4", "id is \"-1\"");
  expect_error(cameras, "4294967296 PINHOLE 8 8 1 1 4 4", "id is \"4294967296\"");
  expect_error(images, "1 1 0 0 0 0 0 0", "camera id is missing");
  expect_error(images, "1 1 0 0 0 0 0 0 1", "no usable name");
  expect_error(images, "1 0 0 0 0 0 0 0 1 a.jpg", "not a rotation");
  expect_error(images, "1 1 0 0 0 0 0 0 1 a" + std::string(1, '\0') + ".jpg", "no usable name");
  expect_error(points, "1 0 0 inf 1 2 3 0", "coordinate inf");
  expect_error(points, "1 0 0 0 256 2 3 0", "colour is \"256\"");
  expect_error(points, "1 0 0 0 1 2 3", "error is missing");
  // If an editor dropped the empty lines of observations, the next image must not be taken for one.
  const std::string no_empty_lines = "1 1 0 0 0 0 0 0 1 a.jpg\n2 1 0 0 0 0 0 0 1 b.jpg\n";
  expect_contains(format_error_of([&] { images(no_empty_lines); }), "line 2: the line of observations");
}

TEST(ColmapErrors, IdsAreUniqueAndCamerasAreThere) {
  const std::string camera = "1 PINHOLE 8 8 1 1 4 4\n";
  const std::string image = "7 1 0 0 0 0 0 0 2 a.jpg\n\n";
  expect_contains(format_error_of([&] { parse_colmap_cameras(camera + camera, "f", kText); }),
                  "camera 1 is there twice");
  expect_contains(format_error_of([&] { parse_colmap_images(image + image, "f", kText); }), "image 7 is there twice");

  const TemporaryFolder folder;
  write_bytes(folder.file("cameras.txt"), camera);
  write_bytes(folder.file("images.txt"), image);
  write_bytes(folder.file("points3D.txt"), "");
  const auto read = [&] { read_colmap(folder.file("")); };
  expect_contains(format_error_of(read), "image 7 \"a.jpg\" refers to camera 2");
  write_bytes(folder.file("images.txt"), "# none\n");
  expect_contains(format_error_of(read), "images.txt: holds no image");
  write_bytes(folder.file("cameras.txt"), "");
  expect_contains(format_error_of(read), "cameras.txt: holds no camera");
}

TEST(ColmapErrors, WritingRefusesWhatCouldNotBeRead) {
  const TemporaryFolder folder;
  write_by_hand(folder, kBinary);
  const ColmapModel valid = read_colmap(folder.file(""));
  const auto refuse = [&](const char* reason, const auto& spoil) {
    ColmapModel model = valid;
    spoil(model);
    expect_contains(format_error_of([&] { write_colmap(folder.file("new"), model, kText); }), reason);
    EXPECT_FALSE(std::filesystem::exists(folder.file("new")));
  };
  refuse("3 parameters, not 4", [](ColmapModel& model) { model.cameras[0].params.pop_back(); });
  refuse("no camera model", [](ColmapModel& model) { model.cameras[0].model = nullptr; });
  refuse("has the name", [](ColmapModel& model) { model.images[0].name = "a\nb"; });
  refuse("positions", [](ColmapModel& model) { model.points.cloud.positions.pop_back(); });
  refuse("colors", [](ColmapModel& model) { model.points.cloud.colors.pop_back(); });
  refuse("errors", [](ColmapModel& model) { model.points.errors.pop_back(); });
}

TEST(ColmapErrors, EveryTruncationIsSeen) {
  const auto expect_refused = [](const std::string& bytes, const auto& parse) {
    for (std::size_t length = 0; length < bytes.size(); ++length) {
      EXPECT_THROW(parse(std::string_view(bytes).substr(0, length), "file", kBinary), FormatError) << length;
    }
  };
  expect_refused(binary_cameras(), parse_colmap_cameras);
  expect_refused(binary_images(), parse_colmap_images);
  expect_refused(binary_points(), parse_colmap_points);
}

TEST(ColmapErrors, DamageIsSurvived) {
  const auto survive = [](const std::string& bytes, const auto& parse, ColmapFormat format) {
    expect_survives_damage(bytes, [&](const std::string& damaged) { parse(damaged, "damaged", format); });
  };
  survive(binary_cameras(), parse_colmap_cameras, kBinary);
  survive(binary_images(), parse_colmap_images, kBinary);
  survive(binary_points(), parse_colmap_points, kBinary);
  survive(kTextCameras, parse_colmap_cameras, kText);
  survive(kTextImages, parse_colmap_images, kText);
  survive(kTextPoints, parse_colmap_points, kText);
}

}  // namespace
}  // namespace dsmoe::io
