// Pictures, and their files: PNG, EXR and MP4. Only picture.cpp includes OpenCV.
#pragma once

#include <array>
#include <cstdint>
#include <memory>
#include <string>
#include <vector>

namespace dsmoe::tools {

/// Red, green and blue, or one channel. In PNG and MP4, 0 is black and 1 is white.
struct Picture {
  int width = 0, height = 0, channels = 3;
  std::vector<float> values;  // [channels, H, W]

  std::size_t pixels() const { return static_cast<std::size_t>(width) * height; }
};

using Color = std::array<float, 3>;

/// Reads any picture that OpenCV can, as red, green and blue from 0 to 1. Throws std::runtime_error.
Picture read_picture(const std::string& path);

/// The picture at another width; the height follows. Areas are averaged.
Picture scaled_to_width(const Picture& picture, int width);

/// Writes a .png (8 bits, values are clamped) or an .exr (float32, values as they are). Throws std::runtime_error.
void write_picture(const std::string& path, const Picture& picture);

/// Dark blue at `low` and below, over green, to red at `high` and above.
Picture heat_map(const Picture& numbers, float low, float high);

/// A colour of its own for each number from 0 on; neighbours differ clearly.
Color distinct_color(int64_t number);

/// Each pixel in the colour of its number; black below 0.
Picture label_colors(const std::vector<int32_t>& labels, int width, int height);

/// Pictures of one size and three channels, from left to right.
Picture side_by_side(const std::vector<Picture>& pictures);

/// A curve of a plot.
struct Curve {
  std::string name;
  Color color;
  std::vector<float> values;
};

/// Curves over their index, with axes and a legend; heights from `low` to `high`.
Picture plot(const std::vector<Curve>& curves, float low, float high);

/// An .mp4: H.264 if this OpenCV has it, else MPEG-4.
class VideoFile {
 public:
  /// Throws std::runtime_error if it cannot be written.
  VideoFile(const std::string& path, int width, int height, double frames_per_second);
  ~VideoFile();
  VideoFile(const VideoFile&) = delete;
  VideoFile& operator=(const VideoFile&) = delete;

  void write(const Picture& frame);

 private:
  struct Writer;
  std::unique_ptr<Writer> writer_;
};

}  // namespace dsmoe::tools
