#include "io/colmap.h"

#include <cerrno>
#include <cmath>
#include <filesystem>
#include <type_traits>
#include <unordered_set>

#include "io/cursor.h"

namespace dsmoe::io {

namespace {

namespace fs = std::filesystem;

constexpr CameraModel kCameraModels[] = {
    {0, "SIMPLE_PINHOLE", 3, 1},
    {1, "PINHOLE", 4, 2},
    {2, "SIMPLE_RADIAL", 4, 1},
    {3, "RADIAL", 5, 1},
    {4, "OPENCV", 8, 2},
    {5, "OPENCV_FISHEYE", 8, 2},
    {6, "FULL_OPENCV", 12, 2},
    {7, "FOV", 5, 2},
    {8, "SIMPLE_RADIAL_FISHEYE", 4, 1},
    {9, "RADIAL_FISHEYE", 5, 1},
    {10, "THIN_PRISM_FISHEYE", 12, 2},
    {11, "RAD_TAN_THIN_PRISM_FISHEYE", 16, 2},
    {12, "SIMPLE_DIVISION", 4, 1},
    {13, "DIVISION", 5, 2},
    {14, "SIMPLE_FISHEYE", 3, 1},
    {15, "FISHEYE", 4, 2},
    {16, "EUCM", 6, 2},
    {17, "EQUIRECTANGULAR", 2, 0},
};

// The least bytes of a record: with no parameter, a name of one letter, no observation and no track.
constexpr std::size_t kCameraBytes = 4 + 4 + 8 + 8;
constexpr std::size_t kImageBytes = 4 + 7 * 8 + 4 + 2 + 8;
constexpr std::size_t kPointBytes = 8 + 3 * 8 + 3 + 8 + 8;
constexpr std::size_t kObservationBytes = 8 + 8 + 8;
constexpr std::size_t kTrackBytes = 4 + 4;

constexpr std::uint64_t kLargestSide = INT32_MAX;  // pixels; image sizes are int in every consumer

// The checks below throw through the cursor that read the value, which knows file and place.

template <typename Cursor> void check_camera(const Cursor& cursor, const ColmapCamera& camera) {
  const std::string what = "camera " + std::to_string(camera.id) + " (" + camera.model->name + ")";
  for (const std::uint64_t side : {camera.width, camera.height}) {
    if (side < 1 || side > kLargestSide) cursor.fail(what, "has an image side of " + std::to_string(side) + " pixels");
  }
  for (std::size_t i = 0; i < camera.params.size(); ++i) {
    const bool is_focal = static_cast<int>(i) < camera.model->num_focal_lengths;
    if (!std::isfinite(camera.params[i]) || (is_focal && camera.params[i] <= 0)) {
      cursor.fail(what, "has " + shortest_text(camera.params[i]) + " as parameter " + std::to_string(i) +
                            (is_focal ? ", a focal length" : ""));
    }
  }
}

/// Checks an image and gives its quaternion unit length, as COLMAP does.
template <typename Cursor> void check_image(const Cursor& cursor, ColmapImage& image) {
  const std::string what = "image " + std::to_string(image.id) + " " + printable(image.name);
  if (image.name.empty() || image.name.find('\0') != std::string::npos) cursor.fail(what, "has no usable name");
  double squared_length = 0;
  for (const double q : image.qvec) squared_length += q * q;
  if (!std::isfinite(squared_length) || !(squared_length > 0)) cursor.fail(what, "has a qvec that is not a rotation");
  for (double& q : image.qvec) q /= std::sqrt(squared_length);
  for (const double t : image.tvec) {
    if (!std::isfinite(t)) cursor.fail(what, "has " + shortest_text(t) + " in its tvec");
  }
}

template <typename Cursor>
void check_id_is_new(const Cursor& cursor, const char* what, std::uint32_t id, std::unordered_set<std::uint32_t>& ids) {
  if (!ids.insert(id).second) cursor.fail(std::string(what) + " " + std::to_string(id), "is there twice");
}

template <typename Cursor> void add_coordinate(const Cursor& cursor, double value, ColmapPoints& points) {
  if (!std::isfinite(value)) {
    cursor.fail("point " + std::to_string(points.cloud.count), "has the coordinate " + shortest_text(value));
  }
  points.cloud.positions.push_back(value);
}

std::vector<ColmapCamera> parse_cameras_binary(ByteCursor cursor) {
  std::vector<ColmapCamera> cameras(cursor.read_count("the number of cameras", kCameraBytes));
  std::unordered_set<std::uint32_t> ids;
  for (ColmapCamera& camera : cameras) {
    camera.id = cursor.read<std::uint32_t>("a camera's id");
    check_id_is_new(cursor, "camera", camera.id, ids);
    const int model_id = cursor.read<std::int32_t>("a camera's model");
    camera.model = find_camera_model(model_id);
    if (camera.model == nullptr) {
      cursor.fail("camera " + std::to_string(camera.id), "has the unknown camera model " + std::to_string(model_id));
    }
    camera.width = cursor.read<std::uint64_t>("a camera's width");
    camera.height = cursor.read<std::uint64_t>("a camera's height");
    for (int i = 0; i < camera.model->num_params; ++i) {
      camera.params.push_back(cursor.read<double>("a camera's parameters"));
    }
    check_camera(cursor, camera);
  }
  cursor.end_of_data("the last camera");
  return cameras;
}

std::vector<ColmapCamera> parse_cameras_text(LineCursor cursor) {
  std::vector<ColmapCamera> cameras;
  std::unordered_set<std::uint32_t> ids;
  while (cursor.next_content_line()) {
    ColmapCamera camera;
    camera.id = static_cast<std::uint32_t>(cursor.whole("a camera's id", UINT32_MAX));
    check_id_is_new(cursor, "camera", camera.id, ids);
    const std::string_view model_name = cursor.field("a camera's model");
    camera.model = find_camera_model(model_name);
    if (camera.model == nullptr) {
      cursor.fail("camera " + std::to_string(camera.id), "has the unknown camera model " + printable(model_name));
    }
    camera.width = cursor.whole("a camera's width");
    camera.height = cursor.whole("a camera's height");
    for (int i = 0; i < camera.model->num_params; ++i) camera.params.push_back(cursor.number("a camera's parameter"));
    cursor.end_of_line("the last parameter");
    check_camera(cursor, camera);
    cameras.push_back(std::move(camera));
  }
  return cameras;
}

std::vector<ColmapImage> parse_images_binary(ByteCursor cursor) {
  std::vector<ColmapImage> images(cursor.read_count("the number of images", kImageBytes));
  std::unordered_set<std::uint32_t> ids;
  for (ColmapImage& image : images) {
    image.id = cursor.read<std::uint32_t>("an image's id");
    check_id_is_new(cursor, "image", image.id, ids);
    for (double& q : image.qvec) q = cursor.read<double>("an image's qvec");
    for (double& t : image.tvec) t = cursor.read<double>("an image's tvec");
    image.camera_id = cursor.read<std::uint32_t>("an image's camera id");
    image.name = cursor.read_c_string("an image's name");
    check_image(cursor, image);
    const std::uint64_t count = cursor.read_count("the number of observations", kObservationBytes);
    cursor.take(count, kObservationBytes, "an image's observations");
  }
  cursor.end_of_data("the last image");
  return images;
}

std::vector<ColmapImage> parse_images_text(LineCursor cursor) {
  std::vector<ColmapImage> images;
  std::unordered_set<std::uint32_t> ids;
  while (cursor.next_content_line()) {
    ColmapImage image;
    image.id = static_cast<std::uint32_t>(cursor.whole("an image's id", UINT32_MAX));
    check_id_is_new(cursor, "image", image.id, ids);
    for (double& q : image.qvec) q = cursor.number("an image's qvec");
    for (double& t : image.tvec) t = cursor.number("an image's tvec");
    image.camera_id = static_cast<std::uint32_t>(cursor.whole("an image's camera id", UINT32_MAX));
    image.name = cursor.rest();
    check_image(cursor, image);
    images.push_back(std::move(image));

    // The line of observations is there even if it is empty; without it the next image would be lost.
    if (!cursor.next_line()) break;
    std::size_t num_fields = 0;
    for (; cursor.has_field(); cursor.field("an observation")) ++num_fields;
    if (num_fields % 3 != 0) {
      cursor.fail("the line of observations (x y point, ...)", "has " + std::to_string(num_fields) + " fields");
    }
  }
  return images;
}

ColmapPoints parse_points_binary(ByteCursor cursor) {
  ColmapPoints points;
  const std::uint64_t count = cursor.read_count("the number of points", kPointBytes);
  points.cloud.positions.reserve(3 * count);
  points.cloud.colors.reserve(3 * count);
  points.errors.reserve(count);
  for (; points.cloud.count < count; ++points.cloud.count) {
    cursor.read<std::uint64_t>("a point's id");
    for (int i = 0; i < 3; ++i) add_coordinate(cursor, cursor.read<double>("a point's position"), points);
    for (int i = 0; i < 3; ++i) points.cloud.colors.push_back(cursor.read<std::uint8_t>("a point's colour"));
    points.errors.push_back(cursor.read<double>("a point's error"));
    const std::uint64_t length = cursor.read_count("the length of a track", kTrackBytes);
    cursor.take(length, kTrackBytes, "a point's track");
  }
  cursor.end_of_data("the last point");
  return points;
}

ColmapPoints parse_points_text(LineCursor cursor) {
  ColmapPoints points;
  for (; cursor.next_content_line(); ++points.cloud.count) {
    cursor.whole("a point's id");
    for (int i = 0; i < 3; ++i) add_coordinate(cursor, cursor.number("a point's position"), points);
    for (int i = 0; i < 3; ++i) {
      points.cloud.colors.push_back(static_cast<std::uint8_t>(cursor.whole("a point's colour", UINT8_MAX)));
    }
    points.errors.push_back(cursor.number("a point's error"));
  }
  return points;
}

std::string file_in(const std::string& folder, const char* stem, ColmapFormat format) {
  return (fs::path(folder) / (std::string(stem) + (format == ColmapFormat::kBinary ? ".bin" : ".txt"))).string();
}

bool exists(const std::string& path) {
  std::error_code ignored;
  return fs::exists(path, ignored);
}

/// Rows of a file, in binary as they are and in text between blanks and line ends.
class RowWriter {
 public:
  RowWriter(const std::string& path, std::size_t count, ColmapFormat format)
      : file_(path), is_binary_(format == ColmapFormat::kBinary) {
    if (is_binary_) append_little_endian(bytes_, static_cast<std::uint64_t>(count));
  }

  template <typename T> void add(T value) {
    if (is_binary_) {
      append_little_endian(bytes_, value);
    } else if constexpr (std::is_floating_point_v<T>) {
      add_text(shortest_text(value));
    } else {
      add_text(std::to_string(value));
    }
  }

  void add_text(const std::string& text) { bytes_ += text + " "; }
  void add_name(const std::string& name) { bytes_ += name + (is_binary_ ? '\0' : '\n'); }

  void end_row() {
    if (!is_binary_) bytes_ += '\n';
    file_.write(bytes_);
    bytes_.clear();
  }

  void commit() {
    file_.write(bytes_);
    file_.commit();
  }

 private:
  OutputFile file_;
  bool is_binary_;
  std::string bytes_;
};

void check_writable(const std::string& folder, const ColmapModel& model) {
  const auto check = [&](bool holds, const std::string& reason) {
    if (!holds) throw FormatError(folder + ": " + reason);
  };
  for (const ColmapCamera& camera : model.cameras) {
    const std::string what = "camera " + std::to_string(camera.id);
    check(camera.model != nullptr, what + " has no camera model");
    check(static_cast<int>(camera.params.size()) == camera.model->num_params,
          what + " (" + camera.model->name + ") has " + std::to_string(camera.params.size()) + " parameters, not " +
              std::to_string(camera.model->num_params));
  }
  for (const ColmapImage& image : model.images) {
    check(!image.name.empty() && image.name.find_first_of(std::string_view("\n\r\0", 3)) == std::string::npos,
          "image " + std::to_string(image.id) + " has the name " + printable(image.name));
  }
  const PointCloud& cloud = model.points.cloud;
  const auto check_size = [&](const char* name, std::size_t size, std::size_t expected) {
    check(size == expected, std::string(name) + " of the points has " + std::to_string(size) +
                                " values; it must have " + std::to_string(expected));
  };
  check_size("positions", cloud.positions.size(), 3 * cloud.count);
  if (!cloud.colors.empty()) check_size("colors", cloud.colors.size(), 3 * cloud.count);
  if (!model.points.errors.empty()) check_size("errors", model.points.errors.size(), cloud.count);
}

}  // namespace

const CameraModel* find_camera_model(int id) {
  for (const CameraModel& model : kCameraModels) {
    if (model.id == id) return &model;
  }
  return nullptr;
}

const CameraModel* find_camera_model(std::string_view name) {
  for (const CameraModel& model : kCameraModels) {
    if (model.name == name) return &model;
  }
  return nullptr;
}

std::string find_colmap_folder(const std::string& folder) {
  const fs::path root(folder);
  const fs::path candidates[] = {root, root / "sparse" / "0", root / "sparse"};
  std::string tried;
  for (const fs::path& candidate : candidates) {
    for (const ColmapFormat format : {ColmapFormat::kBinary, ColmapFormat::kText}) {
      if (exists(file_in(candidate.string(), "cameras", format))) return candidate.string();
    }
    tried += (tried.empty() ? "" : ", ") + candidate.string();
  }
  throw FileError(folder, "no COLMAP model here: neither cameras.bin nor cameras.txt is in any of " + tried, ENOENT);
}

ColmapModel read_colmap(const std::string& folder) {
  const std::string binary_cameras = file_in(folder, "cameras", ColmapFormat::kBinary);
  const ColmapFormat format = exists(binary_cameras) ? ColmapFormat::kBinary : ColmapFormat::kText;
  const std::string cameras_file = file_in(folder, "cameras", format);
  const std::string images_file = file_in(folder, "images", format);
  const std::string points_file = file_in(folder, "points3D", format);

  ColmapModel model;
  model.cameras = parse_colmap_cameras(read_file(cameras_file), cameras_file, format);
  model.images = parse_colmap_images(read_file(images_file), images_file, format);
  model.points = parse_colmap_points(read_file(points_file), points_file, format);

  if (model.cameras.empty()) throw FormatError(cameras_file + ": holds no camera");
  if (model.images.empty()) throw FormatError(images_file + ": holds no image");
  std::unordered_set<std::uint32_t> camera_ids;
  for (const ColmapCamera& camera : model.cameras) camera_ids.insert(camera.id);
  for (const ColmapImage& image : model.images) {
    if (camera_ids.count(image.camera_id) != 0) continue;
    throw FormatError(images_file + ": image " + std::to_string(image.id) + " " + printable(image.name) +
                      " refers to camera " + std::to_string(image.camera_id) + ", which " + cameras_file +
                      " does not hold");
  }
  return model;
}

std::vector<ColmapCamera> read_colmap_cameras(const std::string& path) {
  const bool is_text = fs::path(path).extension() == ".txt";
  return parse_colmap_cameras(read_file(path), path, is_text ? ColmapFormat::kText : ColmapFormat::kBinary);
}

std::vector<ColmapCamera> parse_colmap_cameras(std::string_view bytes, const std::string& file, ColmapFormat format) {
  return format == ColmapFormat::kBinary ? parse_cameras_binary(ByteCursor(bytes, file))
                                         : parse_cameras_text(LineCursor(bytes, file));
}

std::vector<ColmapImage> parse_colmap_images(std::string_view bytes, const std::string& file, ColmapFormat format) {
  return format == ColmapFormat::kBinary ? parse_images_binary(ByteCursor(bytes, file))
                                         : parse_images_text(LineCursor(bytes, file));
}

ColmapPoints parse_colmap_points(std::string_view bytes, const std::string& file, ColmapFormat format) {
  return format == ColmapFormat::kBinary ? parse_points_binary(ByteCursor(bytes, file))
                                         : parse_points_text(LineCursor(bytes, file));
}

void write_colmap(const std::string& folder, const ColmapModel& model, ColmapFormat format) {
  check_writable(folder, model);
  std::error_code error;
  fs::create_directories(folder, error);
  if (error) throw FileError(folder, "cannot be made: " + error.message(), error.value());

  RowWriter cameras(file_in(folder, "cameras", format), model.cameras.size(), format);
  for (const ColmapCamera& camera : model.cameras) {
    cameras.add(camera.id);
    if (format == ColmapFormat::kBinary) {
      cameras.add(static_cast<std::int32_t>(camera.model->id));
    } else {
      cameras.add_text(camera.model->name);
    }
    cameras.add(camera.width);
    cameras.add(camera.height);
    for (const double param : camera.params) cameras.add(param);
    cameras.end_row();
  }
  cameras.commit();

  constexpr std::uint64_t kNone = 0;
  RowWriter images(file_in(folder, "images", format), model.images.size(), format);
  for (const ColmapImage& image : model.images) {
    images.add(image.id);
    for (const double q : image.qvec) images.add(q);
    for (const double t : image.tvec) images.add(t);
    images.add(image.camera_id);
    images.add_name(image.name);
    if (format == ColmapFormat::kBinary) images.add(kNone);  // observations; in text, the empty line of end_row
    images.end_row();
  }
  images.commit();

  const PointCloud& cloud = model.points.cloud;
  RowWriter points(file_in(folder, "points3D", format), cloud.count, format);
  for (std::size_t row = 0; row < cloud.count; ++row) {
    points.add(static_cast<std::uint64_t>(row + 1));
    for (std::size_t i = 0; i < 3; ++i) points.add(cloud.positions[3 * row + i]);
    for (std::size_t i = 0; i < 3; ++i) {
      points.add(cloud.colors.empty() ? std::uint8_t{0} : cloud.colors[3 * row + i]);
    }
    points.add(model.points.errors.empty() ? -1.0 : model.points.errors[row]);
    if (format == ColmapFormat::kBinary) points.add(kNone);  // track
    points.end_row();
  }
  points.commit();
}

}  // namespace dsmoe::io
