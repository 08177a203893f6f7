#include "picture.h"

#include <algorithm>
#include <cmath>
#include <cstdlib>
#include <filesystem>
#include <opencv2/imgcodecs.hpp>
#include <opencv2/imgproc.hpp>
#include <opencv2/videoio.hpp>
#include <stdexcept>

namespace dsmoe::tools {
namespace {

/// OpenCV's order: blue, green, red, pixel by pixel.
cv::Mat to_mat(const Picture& picture) {
  std::vector<cv::Mat> channels;
  for (int c = picture.channels - 1; c >= 0; --c) {
    const float* values = picture.values.data() + c * picture.pixels();
    channels.emplace_back(picture.height, picture.width, CV_32F, const_cast<float*>(values));
  }
  cv::Mat merged;
  cv::merge(channels, merged);
  return merged;
}

cv::Mat to_bytes(const Picture& picture) {
  cv::Mat bytes;
  to_mat(picture).convertTo(bytes, CV_8U, 255);  // rounds and clamps
  return bytes;
}

/// bytes: 8 bits, blue, green, red.
Picture from_bytes(const cv::Mat& bytes) {
  Picture picture;
  picture.width = bytes.cols, picture.height = bytes.rows;
  picture.values.resize(3 * picture.pixels());
  cv::Mat numbers, channels[3];
  bytes.convertTo(numbers, CV_32F, 1 / 255.0);
  cv::split(numbers, channels);
  for (int c = 0; c < 3; ++c) {
    const cv::Mat& channel = channels[2 - c];
    std::copy(channel.begin<float>(), channel.end<float>(), picture.values.begin() + c * picture.pixels());
  }
  return picture;
}

cv::Scalar scalar_of(const Color& color) { return {color[2] * 255, color[1] * 255, color[0] * 255}; }

}  // namespace

Picture read_picture(const std::string& path) {
  // OpenCV would print a warning of its own.
  if (!std::filesystem::exists(path)) throw std::runtime_error(path + ": no such file");
  const cv::Mat bytes = cv::imread(path, cv::IMREAD_COLOR);
  if (bytes.empty()) throw std::runtime_error(path + ": is not a picture that OpenCV can read");
  return from_bytes(bytes);
}

Picture scaled_to_width(const Picture& picture, int width) {
  const int height = std::max(1, static_cast<int>(std::lround(double(picture.height) * width / picture.width)));
  cv::Mat scaled;
  cv::resize(to_bytes(picture), scaled, cv::Size(width, height), 0, 0, cv::INTER_AREA);
  return from_bytes(scaled);
}

void write_picture(const std::string& path, const Picture& picture) {
  setenv("OPENCV_IO_ENABLE_OPENEXR", "1", 0);  // without it OpenCV refuses EXR
  const bool is_exr = std::filesystem::path(path).extension() == ".exr";
  bool written = false;
  try {
    written = cv::imwrite(path, is_exr ? to_mat(picture) : to_bytes(picture));
  } catch (const cv::Exception& error) {
    throw std::runtime_error(path + ": " + error.err);
  }
  if (!written) throw std::runtime_error(path + ": cannot be written");
}

Picture heat_map(const Picture& numbers, float low, float high) {
  Picture scaled = numbers;
  for (float& value : scaled.values) value = (value - low) / std::max(high - low, 1e-30f);
  cv::Mat colored;
  cv::applyColorMap(to_bytes(scaled), colored, cv::COLORMAP_TURBO);
  return from_bytes(colored);
}

Color distinct_color(int64_t number) {
  // Hues by the golden ratio: each falls into the widest gap that its predecessors leave. Two other steps vary
  // lightness and saturation, so that near hues differ too.
  const auto fraction = [](double x) { return x - std::floor(x); };
  const double hue = fraction(0.61803398875 * number), value = 0.55 + 0.45 * fraction(0.754877666 * number);
  const double saturation = 0.45 + 0.5 * fraction(0.569840291 * number);
  Color color;
  for (int c = 0; c < 3; ++c) {
    const double distance = std::abs(fraction(hue + c / 3.0) * 6 - 3) - 1;
    color[c] = static_cast<float>(value * (1 - saturation * (1 - std::clamp(distance, 0.0, 1.0))));
  }
  return color;
}

Picture label_colors(const std::vector<int32_t>& labels, int width, int height) {
  Picture picture = {width, height, 3, std::vector<float>(3 * labels.size())};
  for (std::size_t i = 0; i < labels.size(); ++i) {
    if (labels[i] < 0) continue;
    const Color color = distinct_color(labels[i]);
    for (int c = 0; c < 3; ++c) picture.values[c * labels.size() + i] = color[c];
  }
  return picture;
}

Picture side_by_side(const std::vector<Picture>& pictures) {
  std::vector<cv::Mat> mats;
  for (const Picture& picture : pictures) mats.push_back(to_bytes(picture));
  cv::Mat joined;
  cv::hconcat(mats, joined);
  return from_bytes(joined);
}

Picture plot(const std::vector<Curve>& curves, float low, float high) {
  constexpr int kWidth = 800, kHeight = 400, kLeft = 50, kBottom = 30, kTop = 30, kRight = 130;
  const cv::Scalar black(0, 0, 0), grey(200, 200, 200);
  cv::Mat page(kHeight, kWidth, CV_8UC3, cv::Scalar(255, 255, 255));
  const auto place = [&](double along, double value) {  // along: 0 to 1
    const double up = (value - low) / (high - low);
    return cv::Point(static_cast<int>(kLeft + along * (kWidth - kLeft - kRight)),
                     static_cast<int>(kHeight - kBottom - up * (kHeight - kBottom - kTop)));
  };
  const auto write = [&](const std::string& text, cv::Point at, const cv::Scalar& color) {
    cv::putText(page, text, at, cv::FONT_HERSHEY_SIMPLEX, 0.45, color, 1, cv::LINE_AA);
  };
  for (double value = low; value <= high; value += 0.25) {
    cv::line(page, place(0, value), place(1, value), grey);
    char text[16];
    std::snprintf(text, sizeof(text), "%.2f", value);
    write(text, place(0, value) + cv::Point(-42, 5), black);
  }
  int line = 0;
  for (const Curve& curve : curves) {
    std::vector<cv::Point> points;
    for (std::size_t i = 0; i < curve.values.size(); ++i) {
      points.push_back(
          place(double(i) / std::max<std::size_t>(curve.values.size() - 1, 1), std::clamp(curve.values[i], low, high)));
    }
    cv::polylines(page, points, false, scalar_of(curve.color), 1, cv::LINE_AA);
    write(curve.name, {kWidth - kRight + 10, kTop + 18 * line++}, scalar_of(curve.color));
  }
  return from_bytes(page);
}

struct VideoFile::Writer {
  std::string path;
  cv::VideoWriter video;
};

VideoFile::VideoFile(const std::string& path, int width, int height, double frames_per_second)
    : writer_(new Writer{path, {}}) {
  const cv::Size even((width + 1) / 2 * 2, (height + 1) / 2 * 2);  // the codecs halve the resolution of colour
  for (const char* codec : {"avc1", "mp4v"}) {
    const int code = cv::VideoWriter::fourcc(codec[0], codec[1], codec[2], codec[3]);
    if (writer_->video.open(path, cv::CAP_FFMPEG, code, frames_per_second, even)) return;
  }
  throw std::runtime_error(path + ": this OpenCV cannot write the video");
}

VideoFile::~VideoFile() = default;

void VideoFile::write(const Picture& frame) {
  cv::Mat even;
  cv::copyMakeBorder(to_bytes(frame), even, 0, frame.height % 2, 0, frame.width % 2, cv::BORDER_REPLICATE);
  writer_->video.write(even);
}

}  // namespace dsmoe::tools
