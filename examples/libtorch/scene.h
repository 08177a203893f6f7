// A COLMAP scene as tensors: training and test views, points, and the scene's scale.
#pragma once

#include <dsmoe/torch.h>
#include <torch/torch.h>

#include <algorithm>
#include <map>
#include <opencv2/imgcodecs.hpp>
#include <opencv2/imgproc.hpp>
#include <stdexcept>

#include "io/colmap.h"

constexpr int kHoldOut = 8;  // every 8th image, by sorted name, is a test image

struct View {
  dsmoe::GaussianRasterizationSettings settings;  // camera and background
  torch::Tensor image;                            // [3, H, W] uint8
};

struct Scene {
  std::vector<View> train, test;
  torch::Tensor points, colors;  // [N, 3] world, double; [N, 3] in [0, 1]
  double extent;                 // 1.1 times the largest distance of a training camera from their mean
};

// Vectors [N, 3] turned by quaternions [N, 4] (w, x, y, z) of any length.
inline torch::Tensor rotated(const torch::Tensor& vectors, const torch::Tensor& quaternions) {
  const auto unit = torch::nn::functional::normalize(quaternions);
  const auto w = unit.slice(1, 0, 1), xyz = unit.slice(1, 1, 4), twice = 2 * torch::linalg_cross(xyz, vectors);
  return vectors + w * twice + torch::linalg_cross(xyz, twice);
}

// Reads the image, its size divided by `divisor`; the intrinsics follow its size.
inline View load_view(const dsmoe::io::ColmapImage& posed, const dsmoe::io::ColmapCamera& camera,
                      const std::string& folder, int divisor, torch::Device device) {
  const std::string path = folder + "/" + posed.name, model = camera.model->name;
  if (model != "PINHOLE" && model != "SIMPLE_PINHOLE")
    throw std::runtime_error(path + ": its lens is " + model + "; `colmap image_undistorter` makes pinhole images");
  cv::Mat pixels = cv::imread(path, cv::IMREAD_COLOR | cv::IMREAD_IGNORE_ORIENTATION);
  if (pixels.empty()) throw std::runtime_error(path + ": not a readable image");
  if (divisor > 1) cv::resize(pixels, pixels, {}, 1.0 / divisor, 1.0 / divisor, cv::INTER_AREA);
  const double sx = 1.0 * pixels.cols / camera.width, sy = 1.0 * pixels.rows / camera.height;
  const auto last = camera.params.end();  // PINHOLE is fx, fy, cx, cy; SIMPLE_PINHOLE f, cx, cy
  const auto K = torch::tensor(
      {{sx * camera.params[0], 0., sx * last[-2]}, {0., sy * last[-3], sy * last[-1]}, {0., 0., 1.}}, torch::kDouble);
  const auto quaternion = torch::tensor(at::ArrayRef<double>(posed.qvec), torch::kDouble).repeat({3, 1});
  const auto rotation = rotated(torch::eye(3, torch::kDouble), quaternion).t();
  const auto translation = torch::tensor(at::ArrayRef<double>(posed.tvec), torch::kDouble);
  const auto bgr = torch::from_blob(pixels.data, {pixels.rows, pixels.cols, 3}, torch::kByte);
  return {dsmoe::settings_from_camera(K, rotation, translation, pixels.cols, pixels.rows, torch::zeros(3, device)),
          bgr.flip(2).permute({2, 0, 1}).contiguous().to(device)};
}

inline Scene load_scene(const std::string& folder, const std::string& images, int divisor, torch::Device device) {
  auto model = dsmoe::io::read_colmap(dsmoe::io::find_colmap_folder(folder));
  std::map<std::uint32_t, const dsmoe::io::ColmapCamera*> cameras;
  for (const auto& camera : model.cameras) cameras[camera.id] = &camera;
  std::sort(model.images.begin(), model.images.end(), [](const auto& a, const auto& b) { return a.name < b.name; });
  Scene scene;
  for (size_t i = 0; i < model.images.size(); ++i) {
    const auto& posed = model.images[i];
    auto& views = i % kHoldOut == 0 ? scene.test : scene.train;
    views.push_back(load_view(posed, *cameras.at(posed.camera_id), folder + "/" + images, divisor, device));
  }
  std::vector<torch::Tensor> centers;
  for (const View& view : scene.train) centers.push_back(view.settings.campos);
  const auto all = torch::stack(centers);
  const double radius = (all - all.mean(0, true)).norm(2, 1).max().item<double>();
  scene.extent = radius > 1e-6 ? 1.1 * radius : 1;
  auto& cloud = model.points.cloud;
  if (cloud.colors.empty()) cloud.colors.assign(3 * cloud.count, 128);
  const auto count = static_cast<int64_t>(cloud.count);
  scene.points = torch::from_blob(cloud.positions.data(), {count, 3}, torch::kDouble).clone().to(device);
  scene.colors = torch::from_blob(cloud.colors.data(), {count, 3}, torch::kByte).to(device, torch::kFloat) / 255;
  return scene;
}
