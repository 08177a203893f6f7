// L1, squares and SSIM on the CPU. Threads take bands of rows of one plane. Windows run along each row, then down the
// last eleven rows, which are kept in a ring.
#include "dsmoe/training/image_loss.h"

#include <algorithm>
#include <vector>

#include "cpu/parallel.h"
#include "refuse.h"

namespace dsmoe {

template <class S> void refuse_image_loss(const char* function, const ImageLoss<S>& loss) {
  const int64_t size = loss.planes * loss.height * loss.width;
  refuse_null(function, "image", loss.image, "[planes, height, width]", size);
  if (loss.target == nullptr && loss.target_bytes == nullptr && size > 0) {
    refuse(function, "target and target_bytes are null; one must point to an array [planes, height, width]");
  }
  refuse_null(function, "loss", loss.loss, "[1]", 1);
  refuse_null(function, "sums", loss.sums, "[num_image_loss_sums(...)]", size);
  refuse_null(function, "derivatives", loss.derivatives, "[3, planes, height, width], as a gradient is wanted",
              loss.gradient != nullptr ? size : 0);
}

template void refuse_image_loss(const char*, const ImageLoss<float>&);
template void refuse_image_loss(const char*, const ImageLoss<double>&);

namespace cpu {
namespace {

constexpr int kBand = 64;  // rows

int64_t bands_of(int height) { return (height + kBand - 1) / kBand; }

// padded: [width + 2 kSsimRadius]
template <class S>
DSMOE_MULTIVERSION void blur_row(const S* __restrict padded, S* __restrict out, int width, const SsimWindow<S> window) {
  for (int i = 0; i < width; ++i) {
    S sum = window.taps[kSsimRadius] * padded[i + kSsimRadius];
    for (int k = 0; k < kSsimRadius; ++k) sum += window.taps[k] * (padded[i + k] + padded[i + kSsimTaps - 1 - k]);
    out[i] = sum;
  }
}

// rows: [kSsimTaps] of [width]
template <class S>
DSMOE_MULTIVERSION void blur_column(const S* const* rows, S* __restrict out, int width, const SsimWindow<S> window) {
  static_assert(kSsimTaps == 11, "one pointer per row");
  const S *r0 = rows[0], *r1 = rows[1], *r2 = rows[2], *r3 = rows[3], *r4 = rows[4], *r5 = rows[5], *r6 = rows[6],
          *r7 = rows[7], *r8 = rows[8], *r9 = rows[9], *r10 = rows[10];
  const S* w = window.taps;
  for (int i = 0; i < width; ++i) {
    out[i] = w[5] * r5[i] + w[0] * (r0[i] + r10[i]) + w[1] * (r1[i] + r9[i]) + w[2] * (r2[i] + r8[i]) +
             w[3] * (r3[i] + r7[i]) + w[4] * (r4[i] + r6[i]);
  }
}

// x^2, y^2 and x y of a row.
template <class S>
DSMOE_MULTIVERSION void multiply_row(const S* __restrict x, const S* __restrict y, S* __restrict xx, S* __restrict yy,
                                     S* __restrict xy, int width) {
  for (int i = 0; i < width; ++i) {
    xx[i] = x[i] * x[i];
    yy[i] = y[i] * y[i];
    xy[i] = x[i] * y[i];
  }
}

// means: [kNumSsimMoments, width]; each pixel's SSIM to `values` and its derivatives to the three rows.
template <class S>
DSMOE_MULTIVERSION void ssim_row(const S* __restrict means, S* __restrict values, S* __restrict d_mean,
                                 S* __restrict d_square, S* __restrict d_product, int width) {
  for (int i = 0; i < width; ++i) {
    const SsimMoments<S> moments = {means[i], means[width + i], means[2 * width + i], means[3 * width + i],
                                    means[4 * width + i]};
    const Ssim<S> pixel = ssim(moments);
    values[i] = pixel.value;
    d_mean[i] = pixel.d_mean;
    d_square[i] = pixel.d_square;
    d_product[i] = pixel.d_product;
  }
}

template <class S>
DSMOE_MULTIVERSION double sum_of_differences(const S* __restrict x, const S* __restrict y, int count) {
  double sums[8] = {};
  int i = 0;
  for (; i + 8 <= count; i += 8) {
    for (int j = 0; j < 8; ++j) sums[j] += abs(x[i + j] - y[i + j]);
  }
  for (; i < count; ++i) sums[0] += abs(x[i] - y[i]);
  return ((sums[0] + sums[4]) + (sums[1] + sums[5])) + ((sums[2] + sums[6]) + (sums[3] + sums[7]));
}

template <class S> DSMOE_MULTIVERSION double sum_of_squares(const S* __restrict x, const S* __restrict y, int count) {
  double sums[8] = {};
  int i = 0;
  for (; i + 8 <= count; i += 8) {
    for (int j = 0; j < 8; ++j) sums[j] += (x[i + j] - y[i + j]) * (x[i + j] - y[i + j]);
  }
  for (; i < count; ++i) sums[0] += (x[i] - y[i]) * (x[i] - y[i]);
  return ((sums[0] + sums[4]) + (sums[1] + sums[5])) + ((sums[2] + sums[6]) + (sums[3] + sums[7]));
}

template <class S> DSMOE_MULTIVERSION double sum_of(const S* __restrict x, int count) {
  double sums[8] = {};
  int i = 0;
  for (; i + 8 <= count; i += 8) {
    for (int j = 0; j < 8; ++j) sums[j] += x[i + j];
  }
  for (; i < count; ++i) sums[0] += x[i];
  return ((sums[0] + sums[4]) + (sums[1] + sums[5])) + ((sums[2] + sums[6]) + (sums[3] + sums[7]));
}

template <class S>
DSMOE_MULTIVERSION void gradient_row(const S* __restrict x, const S* __restrict y, const S* __restrict means,
                                     S l1_scale, S l2_scale, S ssim_scale, S* __restrict gradient, int width) {
  for (int i = 0; i < width; ++i) {
    gradient[i] = l1_scale * sign(x[i] - y[i]) + S(2) * l2_scale * (x[i] - y[i]) +
                  ssim_scale * ssim_gradient(x[i], y[i], means[i], means[width + i], means[2 * width + i]);
  }
}

template <class S> DSMOE_MULTIVERSION void from_bytes(const uint8_t* __restrict bytes, S* __restrict out, int count) {
  for (int i = 0; i < count; ++i) out[i] = S(bytes[i]) / S(255);
}

// Moves the window down the rows of one plane. `push` takes the next row of every map. `means` returns the windowed
// means around the row that was pushed kSsimRadius rows ago.
template <class S> class RowBlur {
 public:
  RowBlur(int num_maps, int width)
      : num_maps_(num_maps),
        width_(width),
        window_(ssim_window<S>()),
        padded_(static_cast<size_t>(num_maps) * padded_width()),
        ring_(static_cast<size_t>(kSsimTaps) * num_maps * width),
        means_(static_cast<size_t>(num_maps) * width) {}

  // Where the caller writes the next row of map m, before `push`.
  S* next_row(int m) { return padded_.data() + m * padded_width() + kSsimRadius; }

  void push() {
    for (int m = 0; m < num_maps_; ++m) {
      blur_row(padded_.data() + m * padded_width(), slot(last_, m), width_, window_);
    }
    last_ = (last_ + 1) % kSsimTaps;
  }

  void push_zeros() {
    std::fill_n(slot(last_, 0), static_cast<size_t>(num_maps_) * width_, S(0));
    last_ = (last_ + 1) % kSsimTaps;
  }

  // [num_maps, width]
  const S* means() {
    for (int m = 0; m < num_maps_; ++m) {
      const S* rows[kSsimTaps];
      for (int k = 0; k < kSsimTaps; ++k) rows[k] = slot((last_ + k) % kSsimTaps, m);
      blur_column(rows, means_.data() + static_cast<size_t>(m) * width_, width_, window_);
    }
    return means_.data();
  }

 private:
  int64_t padded_width() const { return width_ + 2 * kSsimRadius; }
  S* slot(int row, int m) { return ring_.data() + (static_cast<size_t>(row) * num_maps_ + m) * width_; }

  int num_maps_, width_;
  int last_ = 0;  // the ring's oldest row, which the next one replaces
  SsimWindow<S> window_;
  std::vector<S> padded_, ring_, means_;
};

// Runs the rows of a band, and those that its windows reach, through the blur: push(row) and then take(row, means) for
// every row of the band.
template <class S, class Push, class Take>
void blur_band(RowBlur<S>& blur, int begin, int end, int height, Push push, Take take) {
  for (int row = begin - kSsimRadius; row < end + kSsimRadius; ++row) {
    if (0 <= row && row < height) {
      push(row);
      blur.push();
    } else {
      blur.push_zeros();
    }
    if (row - kSsimRadius >= begin) take(row - kSsimRadius, blur.means());
  }
}

// Returns the target's row. If the target is bytes, `buffer` holds the row.
template <class S> const S* target_row(const ImageLoss<S>& loss, int64_t index, S* buffer) {
  if (loss.target != nullptr) return loss.target + index;
  from_bytes(loss.target_bytes + index, buffer, loss.width);
  return buffer;
}

// Values and derivatives of one band; returns its share of the loss.
template <class S> double value_band(const ImageLoss<S>& loss, int64_t plane, int begin, int end) {
  const int width = loss.width;
  const int64_t first = plane * loss.height * width, map_size = loss.planes * loss.height * width;
  std::vector<S> values(4 * static_cast<size_t>(width));
  double differences = 0, squares = 0, similarity = 0;
  RowBlur<S> blur(kNumSsimMoments, width);
  const auto push = [&](int row) {
    const int64_t index = first + static_cast<int64_t>(row) * width;
    S *x = blur.next_row(0), *y = blur.next_row(1);
    std::copy_n(loss.image + index, width, x);
    const S* target = target_row(loss, index, y);
    if (target != y) std::copy_n(target, width, y);
    multiply_row(x, y, blur.next_row(2), blur.next_row(3), blur.next_row(4), width);
    if (row < begin || row >= end) return;
    differences += sum_of_differences(x, y, width);
    if (loss.l2_weight != 0) squares += sum_of_squares(x, y, width);
  };
  const auto take = [&](int row, const S* means) {
    S* derivatives[kNumSsimDerivatives];
    for (int m = 0; m < kNumSsimDerivatives; ++m) {
      derivatives[m] = loss.derivatives == nullptr
                           ? values.data() + static_cast<size_t>(1 + m) * width
                           : loss.derivatives + m * map_size + first + static_cast<int64_t>(row) * width;
    }
    ssim_row(means, values.data(), derivatives[0], derivatives[1], derivatives[2], width);
    const int margin = loss.margin;
    if (in_margins(loss, row, margin)) {
      similarity += sum_of(values.data() + margin, width - 2 * margin);
      for (S* derivative : derivatives) {
        std::fill_n(derivative, margin, S(0));
        std::fill_n(derivative + width - margin, margin, S(0));
      }
    } else {
      for (S* derivative : derivatives) std::fill_n(derivative, width, S(0));
    }
  };
  blur_band(blur, begin, end, loss.height, push, take);
  return loss.l1_scale() * differences + loss.l2_scale() * squares + loss.ssim_scale() * similarity;
}

template <class S> void gradient_band(const ImageLoss<S>& loss, int64_t plane, int begin, int end) {
  const int width = loss.width;
  const int64_t first = plane * loss.height * width, map_size = loss.planes * loss.height * width;
  const S l1_scale = static_cast<S>(loss.l1_scale()), l2_scale = static_cast<S>(loss.l2_scale()),
          ssim_scale = static_cast<S>(loss.ssim_scale());
  std::vector<S> buffer(width);
  RowBlur<S> blur(kNumSsimDerivatives, width);
  const auto push = [&](int row) {
    for (int m = 0; m < kNumSsimDerivatives; ++m) {
      std::copy_n(loss.derivatives + m * map_size + first + static_cast<int64_t>(row) * width, width, blur.next_row(m));
    }
  };
  const auto take = [&](int row, const S* means) {
    const int64_t index = first + static_cast<int64_t>(row) * width;
    gradient_row(loss.image + index, target_row(loss, index, buffer.data()), means, l1_scale, l2_scale, ssim_scale,
                 loss.gradient + index, width);
  };
  blur_band(blur, begin, end, loss.height, push, take);
}

// Calls body(chunk, plane, begin, end) for every band of rows.
template <class S, class Body> void for_each_band(const ImageLoss<S>& loss, int num_threads, Body body) {
  const int64_t bands = bands_of(loss.height);
  parallel_for(num_threads, loss.planes * bands, 1, [&](int64_t chunk, int64_t) {
    const int begin = static_cast<int>(chunk % bands) * kBand;
    body(chunk, chunk / bands, begin, std::min(begin + kBand, loss.height));
  });
}

}  // namespace

int64_t num_image_loss_sums(int64_t planes, int height, int) { return planes * bands_of(height); }

template <class S> void image_loss(const ImageLoss<S>& loss, int num_threads) {
  refuse_image_loss("cpu::image_loss", loss);
  for_each_band(loss, num_threads, [&](int64_t chunk, int64_t plane, int begin, int end) {
    loss.sums[chunk] = value_band(loss, plane, begin, end);
  });
  double sum = 0;
  for (int64_t i = 0; i < num_image_loss_sums(loss.planes, loss.height, loss.width); ++i) sum += loss.sums[i];
  *loss.loss = static_cast<S>(loss.offset + sum);
  if (loss.gradient == nullptr) return;
  for_each_band(loss, num_threads,
                [&](int64_t, int64_t plane, int begin, int end) { gradient_band(loss, plane, begin, end); });
}

template void image_loss<float>(const ImageLoss<float>&, int);
template void image_loss<double>(const ImageLoss<double>&, int);

}  // namespace cpu
}  // namespace dsmoe
