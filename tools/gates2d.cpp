#include "gates2d.h"

#include <algorithm>
#include <atomic>
#include <cmath>
#include <random>
#include <thread>

#include "dsmoe/tiles.h"
#include "dsmoe/training/adam.h"

namespace dsmoe::tools {
namespace {

constexpr int kTile = 16;       // pixels a side; kernels are chosen for each tile
constexpr int kBands = 16;      // of tiles; each sums its gradient by itself, so that threads do not change the sums
constexpr double kFaint = -20;  // a gate below exp(-20) of the greatest one, 2e-9, is left out

double longer_side(const Mixture2d& model) { return std::max(model.width, model.height); }

/// A kernel in pixels, as its tiles and pixels need it.
struct Ellipse {
  Vec2<double> mean;  // pixels; centres of pixels are integers
  double xx, yx, yy;  // L, 1 / pixels
  double offset;      // log p; 0 in the weighted sum

  Ellipse(const Kernel& kernel, const Mixture2d& model) {
    const double side = longer_side(model);
    mean = {kernel.x * side - 0.5, kernel.y * side - 0.5};
    xx = std::exp(kernel.log_xx) / side, yx = kernel.yx / side, yy = std::exp(kernel.log_yy) / side;
    offset = model.mixture == Mixture::kGated ? kernel.log_weight : 0;
  }

  Vec2<double> turned(double dx, double dy) const { return {xx * dx, yx * dx + yy * dy}; }  // L d

  /// log(p G)
  double at(double x, double y) const {
    const auto [u, v] = turned(x - mean.x, y - mean.y);
    return offset - 0.5 * (u * u + v * v);
  }

  Sym2<double> conic() const { return {xx * xx + yx * yx, yx * yy, yy * yy}; }  // L^T L

  /// Bounds of log(p G) over a rectangle of pixels: the distance is convex, so it is greatest in a corner.
  double greatest(const PixelRect<double>& r) const { return offset - 0.5 * least_squared_distance(conic(), mean, r); }
  double least(const PixelRect<double>& r) const {
    return std::min(std::min(at(r.x0, r.y0), at(r.x1, r.y0)), std::min(at(r.x0, r.y1), at(r.x1, r.y1)));
  }
};

double* numbers_of(std::vector<Kernel>& kernels) { return reinterpret_cast<double*>(kernels.data()); }

std::vector<Ellipse> ellipses_of(const Mixture2d& model) {
  std::vector<Ellipse> out;
  for (const Kernel& kernel : model.kernels) out.emplace_back(kernel, model);
  return out;
}

/// The kernels that matter in some pixel of the rectangle.
std::vector<int32_t> relevant_kernels(const std::vector<Ellipse>& ellipses, Mixture mixture,
                                      const PixelRect<double>& rect) {
  double floor = kFaint;  // the kernel itself is what the weighted sum holds
  if (mixture == Mixture::kGated) {
    double best = -HUGE_VAL;
    for (const Ellipse& ellipse : ellipses) best = std::max(best, ellipse.least(rect));
    floor += best;
  }
  std::vector<int32_t> out;
  for (std::size_t i = 0; i < ellipses.size(); ++i) {
    if (ellipses[i].greatest(rect) >= floor) out.push_back(static_cast<int32_t>(i));
  }
  return out;
}

/// A pixel's kernels with their gates.
struct Gates {
  std::vector<double> values;  // [chosen kernels] g; the kernel G in the weighted sum
  int32_t greatest = -1;       // among the kernels of the model

  void evaluate(const std::vector<Ellipse>& ellipses, const std::vector<int32_t>& chosen, Mixture mixture, int x,
                int y) {
    double best = -HUGE_VAL;
    values.clear();
    greatest = -1;
    for (const int32_t i : chosen) {
      values.push_back(ellipses[i].at(x, y));
      if (values.back() > best) best = values.back(), greatest = i;
    }
    const bool gated = mixture == Mixture::kGated;
    double sum = 0;
    for (double& value : values) sum += value = std::exp(gated ? value - best : value);
    for (double& value : values) value = gated ? value / sum : value;
  }
};

struct Rgb {
  double r = 0, g = 0, b = 0;
  void add(double factor, const Kernel& kernel) {
    r += factor * kernel.red, g += factor * kernel.green, b += factor * kernel.blue;
  }
  double dot(const Rgb& other) const { return r * other.r + g * other.g + b * other.b; }
};

/// Calls visit(band, x, y, chosen kernels, gates) for every pixel; the pixels of a band come one after the other.
template <class Visit>
void for_each_pixel(const Mixture2d& model, const std::vector<Ellipse>& ellipses, int num_threads, Visit visit) {
  const int columns = (model.width + kTile - 1) / kTile, tiles = columns * ((model.height + kTile - 1) / kTile);
  std::atomic<int> next{0};
  const auto work = [&] {
    Gates gates;
    for (int band = next++; band < kBands; band = next++) {
      for (int tile = tiles * band / kBands; tile < tiles * (band + 1) / kBands; ++tile) {
        const int x0 = tile % columns * kTile, y0 = tile / columns * kTile;
        const int x1 = std::min(x0 + kTile, model.width), y1 = std::min(y0 + kTile, model.height);
        const auto chosen =
            relevant_kernels(ellipses, model.mixture, {double(x0), double(y0), double(x1 - 1), double(y1 - 1)});
        for (int y = y0; y < y1; ++y) {
          for (int x = x0; x < x1; ++x) {
            gates.evaluate(ellipses, chosen, model.mixture, x, y);
            visit(band, x, y, chosen, gates);
          }
        }
      }
    }
  };
  std::vector<std::thread> threads;
  for (int i = 1; i < std::min(num_threads, kBands); ++i) threads.emplace_back(work);
  work();
  for (std::thread& thread : threads) thread.join();
}

Rgb color_of(const Mixture2d& model, const std::vector<int32_t>& chosen, const Gates& gates) {
  Rgb color;
  for (std::size_t k = 0; k < chosen.size(); ++k) color.add(gates.values[k], model.kernels[chosen[k]]);
  return color;
}

/// Adds to the gradient of a kernel what one pixel says. dL_dlog: by log(p G).
void add_to_gradient(Kernel& gradient, const Ellipse& ellipse, double side, double dx, double dy, double dL_dlog) {
  const auto [u, v] = ellipse.turned(dx, dy);
  gradient.x += dL_dlog * (u * ellipse.xx + v * ellipse.yx) * side;
  gradient.y += dL_dlog * v * ellipse.yy * side;
  gradient.log_xx -= dL_dlog * u * u;
  gradient.yx -= dL_dlog * v * dx / side;
  gradient.log_yy -= dL_dlog * v * ellipse.yy * dy;
  gradient.log_weight += dL_dlog;
}

/// Makes the gradient that of what the shape leaves free.
void tie(KernelShape shape, Mixture mixture, std::vector<Kernel>& gradient) {
  double sum = 0;
  for (Kernel& kernel : gradient) {
    if (mixture == Mixture::kWeightedSum) kernel.log_weight = 0;
    if (shape == KernelShape::kSteered) continue;
    kernel.yx = 0;
    kernel.log_xx = kernel.log_yy = kernel.log_xx + kernel.log_yy;
    sum += kernel.log_xx;
  }
  if (shape != KernelShape::kEqual) return;
  for (Kernel& kernel : gradient) kernel.log_xx = kernel.log_yy = sum;
}

}  // namespace

Drawing draw(const Mixture2d& model, int num_threads) {
  const std::size_t pixels = static_cast<std::size_t>(model.width) * model.height;
  Drawing out = {std::vector<float>(3 * pixels), std::vector<int32_t>(pixels)};
  for_each_pixel(model, ellipses_of(model), num_threads,
                 [&](int, int x, int y, const std::vector<int32_t>& chosen, const Gates& gates) {
                   const Rgb color = color_of(model, chosen, gates);
                   const std::size_t pixel = static_cast<std::size_t>(y) * model.width + x;
                   out.color[pixel] = static_cast<float>(color.r);
                   out.color[pixels + pixel] = static_cast<float>(color.g);
                   out.color[2 * pixels + pixel] = static_cast<float>(color.b);
                   out.greatest[pixel] = gates.greatest;
                 });
  return out;
}

std::vector<double> gates_at(const Mixture2d& model, int x, int y) {
  std::vector<int32_t> all;
  for (std::size_t i = 0; i < model.kernels.size(); ++i) all.push_back(static_cast<int32_t>(i));
  Gates gates;
  gates.evaluate(ellipses_of(model), all, model.mixture, x, y);
  return gates.values;
}

double loss_and_gradient(const Mixture2d& model, const std::vector<float>& target, int num_threads,
                         std::vector<Kernel>& gradient) {
  const std::size_t pixels = static_cast<std::size_t>(model.width) * model.height;
  const std::vector<Ellipse> ellipses = ellipses_of(model);
  const double side = longer_side(model), scale = 1 / (3.0 * model.width * model.height);
  const bool gated = model.mixture == Mixture::kGated;
  std::vector<std::vector<Kernel>> gradients(kBands, std::vector<Kernel>(model.kernels.size()));
  std::vector<double> losses(kBands);
  for_each_pixel(model, ellipses, num_threads,
                 [&](int band, int x, int y, const std::vector<int32_t>& chosen, const Gates& gates) {
                   const Rgb color = color_of(model, chosen, gates);
                   const std::size_t pixel = static_cast<std::size_t>(y) * model.width + x;
                   const Rgb error = {color.r - target[pixel], color.g - target[pixels + pixel],
                                      color.b - target[2 * pixels + pixel]};
                   losses[band] += scale * error.dot(error);
                   const Rgb dL_dcolor = {2 * scale * error.r, 2 * scale * error.g, 2 * scale * error.b};
                   const double base = gated ? dL_dcolor.dot(color) : 0;  // the softmax's: experts against the pixel
                   for (std::size_t k = 0; k < chosen.size(); ++k) {
                     const Kernel& kernel = model.kernels[chosen[k]];
                     const Ellipse& ellipse = ellipses[chosen[k]];
                     Kernel& out = gradients[band][chosen[k]];
                     const double gate = gates.values[k];
                     out.red += gate * dL_dcolor.r, out.green += gate * dL_dcolor.g, out.blue += gate * dL_dcolor.b;
                     const double expert = dL_dcolor.dot({kernel.red, kernel.green, kernel.blue});
                     add_to_gradient(out, ellipse, side, x - ellipse.mean.x, y - ellipse.mean.y,
                                     gate * (expert - base));
                   }
                 });
  gradient.assign(model.kernels.size(), Kernel{});
  double* sums = numbers_of(gradient);
  double loss = 0;
  for (int band = 0; band < kBands; ++band) {
    loss += losses[band];
    const double* part = numbers_of(gradients[band]);
    for (std::size_t i = 0; i < kKernelNumbers * gradient.size(); ++i) sums[i] += part[i];
  }
  tie(model.shape, model.mixture, gradient);
  return loss;
}

Fit::Fit(const std::vector<float>& target, int width, int height, const FitOptions& options)
    : target_(target), options_(options), moment_(options.kernels), square_(options.kernels) {
  model_.width = width, model_.height = height;
  model_.mixture = options.mixture, model_.shape = options.shape;
  const double side = longer_side(model_);
  // A kernel's share of the picture, as the square of two bandwidths.
  const double bandwidth = 0.5 * std::sqrt(width / side * (height / side) / options.kernels);
  std::mt19937 random(options.seed);
  for (int i = 0; i < options.kernels; ++i) {
    const auto x = static_cast<int>(random() % width), y = static_cast<int>(random() % height);
    Kernel kernel = {};
    kernel.x = (x + 0.5) / side, kernel.y = (y + 0.5) / side;
    kernel.log_xx = kernel.log_yy = -std::log(bandwidth);
    const std::size_t pixels = target.size() / 3, pixel = static_cast<std::size_t>(y) * width + x;
    kernel.red = target[pixel], kernel.green = target[pixels + pixel], kernel.blue = target[2 * pixels + pixel];
    model_.kernels.push_back(kernel);
  }
}

double Fit::step() {
  const double loss = loss_and_gradient(model_, target_, options_.num_threads, gradient_);
  ++done_;
  const double beta1 = 0.9, beta2 = 0.99;
  const double rate = options_.rate * std::pow(0.01, double(done_) / options_.iterations);
  AdamTensor<double> tensor = {};
  tensor.parameter = numbers_of(model_.kernels);
  tensor.gradient = numbers_of(gradient_);
  tensor.moment = numbers_of(moment_);
  tensor.square = numbers_of(square_);
  tensor.size = static_cast<int64_t>(kKernelNumbers * model_.kernels.size());
  tensor.row_size = kKernelNumbers;
  tensor.rates = adam_rates<double>(rate, done_, beta1, beta2);
  cpu::adam<double>({tensor}, {adam_constants<double>(beta1, beta2, 1e-15), nullptr}, 1);
  return loss;
}

double psnr(double mean_squared_error) { return -10 * std::log10(mean_squared_error); }

}  // namespace dsmoe::tools
