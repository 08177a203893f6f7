// L1, squares and SSIM. One kernel computes the values, and SSIM's derivatives by the local moments; one the gradient;
// one adds up. A block computes one tile of one plane. Windows run along rows, then along columns, in shared memory.
#include "cuda/tuning.cuh"
#include "dsmoe/training/image_loss.h"

namespace dsmoe {
namespace cuda {
namespace {

// The pixels of a tile, and those that its windows reach.
template <class S> struct Tile {
  static constexpr int kWidth = kLossTileWidth<S>, kHeight = kLossTileHeight;
  static constexpr int kPaddedWidth = kWidth + 2 * kSsimRadius, kPaddedHeight = kHeight + 2 * kSsimRadius;
  static constexpr int kStride = (kPaddedWidth + kLossRun - 1) / kLossRun * kLossRun;  // of a padded row, for vectors
  using Padded = S[kPaddedHeight][kStride];
  using Rows = S[kPaddedHeight][kWidth];  // after the window along rows
};

constexpr int kReach = kLossRun + kSsimTaps - 1;  // numbers that the windows of a run reach

template <class S> struct alignas(kLossRun * sizeof(S)) Run { S numbers[kLossRun]; };

// Reads what the windows of a run of columns reach.
template <class S> __device__ void read_along_row(const S* row, S (&to)[kReach]) {
#pragma unroll
  for (int j = 0; j < kReach; j += kLossRun) {
    const Run<S> run = *reinterpret_cast<const Run<S>*>(row + j);
#pragma unroll
    for (int k = 0; k < kLossRun && j + k < kReach; ++k) to[j + k] = run.numbers[k];
  }
}

// The window along columns at a run of pixels, one below the other.
template <class S>
__device__ void blur_column(const typename Tile<S>::Rows& rows, const SsimWindow<S>& window, int row, int column,
                            S (&means)[kLossRun]) {
  S reached[kReach];
#pragma unroll
  for (int j = 0; j < kReach; ++j) reached[j] = rows[row + j][column];
#pragma unroll
  for (int r = 0; r < kLossRun; ++r) {
    means[r] = 0;
#pragma unroll
    for (int k = 0; k < kSsimTaps; ++k) means[r] += window.taps[k] * reached[r + k];
  }
}

// Calls visit(row, column) for the runs of the padded tile's rows, and for_each_column_run for those of the tile's
// columns: the first pixel of each.
template <class S, class Visit> __device__ void for_each_row_run(Visit visit) {
  constexpr int kRuns = Tile<S>::kWidth / kLossRun;
  for (int i = threadIdx.x; i < Tile<S>::kPaddedHeight * kRuns; i += kLossBlock) {
    visit(i / kRuns, i % kRuns * kLossRun);
  }
}
template <class S, class Visit> __device__ void for_each_column_run(Visit visit) {
  for (int i = threadIdx.x; i < Tile<S>::kHeight / kLossRun * Tile<S>::kWidth; i += kLossBlock) {
    visit(i / Tile<S>::kWidth * kLossRun, i % Tile<S>::kWidth);
  }
}

template <class S> int64_t num_blocks(int64_t planes, int height, int width) {
  const int64_t across = (width + Tile<S>::kWidth - 1) / Tile<S>::kWidth;
  const int64_t down = (height + Tile<S>::kHeight - 1) / Tile<S>::kHeight;
  return planes * across * down;
}

// Where this block's tile lies.
struct Place {
  int64_t plane;  // index of the plane's first pixel
  int row, column;
};

template <class S> __device__ Place place_of_block(const ImageLoss<S>& loss) {
  const int across = (loss.width + Tile<S>::kWidth - 1) / Tile<S>::kWidth;
  const int down = (loss.height + Tile<S>::kHeight - 1) / Tile<S>::kHeight;
  const int tile = blockIdx.x % (across * down);
  return {static_cast<int64_t>(blockIdx.x / (across * down)) * loss.height * loss.width,
          tile / across * Tile<S>::kHeight, tile % across * Tile<S>::kWidth};
}

// Calls visit(row, column, index) for the pixels of the tile and those around it that its windows reach. row, column:
// in that padded tile. index: in the image, or -1 outside of it.
template <class S, class Visit> __device__ void for_each_padded(const ImageLoss<S>& loss, Place place, Visit visit) {
  using T = Tile<S>;
  for (int i = threadIdx.x; i < T::kPaddedWidth * T::kPaddedHeight; i += kLossBlock) {
    const int row = place.row + i / T::kPaddedWidth - kSsimRadius;
    const int column = place.column + i % T::kPaddedWidth - kSsimRadius;
    const bool inside = 0 <= row && row < loss.height && 0 <= column && column < loss.width;
    visit(i / T::kPaddedWidth, i % T::kPaddedWidth,
          inside ? place.plane + static_cast<int64_t>(row) * loss.width + column : int64_t(-1));
  }
}

// The block's sum, in thread 0.
__device__ double block_sum(double value) {
  __shared__ double of_warps[32];  // as many as a block may have
  for (int offset = kWarp / 2; offset > 0; offset /= 2) value += __shfl_down_sync(kAllLanes, value, offset);
  if (threadIdx.x % kWarp == 0) of_warps[threadIdx.x / kWarp] = value;
  __syncthreads();
  if (threadIdx.x < kWarp) {
    value = threadIdx.x < blockDim.x / kWarp ? of_warps[threadIdx.x] : 0;
    for (int offset = kWarp / 2; offset > 0; offset /= 2) value += __shfl_down_sync(kAllLanes, value, offset);
  }
  return value;
}

// What numbers of the images are multiplied by.
template <class S> struct LossWeights {
  SsimWindow<S> window;  // along each axis
  S l1;                  // a pixel's |x - y|
  S l2;                  // a pixel's (x - y)^2
  S ssim;                // a pixel's SSIM
};

template <class S>
__global__ void __launch_bounds__(kLossBlock)
    value_kernel(const __grid_constant__ ImageLoss<S> loss, const __grid_constant__ LossWeights<S> weights) {
  using T = Tile<S>;
  alignas(16) __shared__ typename T::Padded image, target;
  __shared__ typename T::Rows rows[kNumSsimMoments];
  const Place place = place_of_block(loss);
  for_each_padded(loss, place, [&](int row, int column, int64_t index) {
    image[row][column] = index < 0 ? S(0) : loss.image[index];
    target[row][column] = index < 0 ? S(0) : target_value(loss, index);
  });
  __syncthreads();

  for_each_row_run<S>([&](int row, int column) {
    S x[kReach], y[kReach], sums[kNumSsimMoments][kLossRun] = {};
    read_along_row(&image[row][column], x);
    read_along_row(&target[row][column], y);
#pragma unroll
    for (int r = 0; r < kLossRun; ++r) {
#pragma unroll
      for (int k = 0; k < kSsimTaps; ++k) {
        const S weighted_x = weights.window.taps[k] * x[r + k], weighted_y = weights.window.taps[k] * y[r + k];
        sums[0][r] += weighted_x;
        sums[1][r] += weighted_y;
        sums[2][r] += weighted_x * x[r + k];
        sums[3][r] += weighted_y * y[r + k];
        sums[4][r] += weighted_x * y[r + k];
      }
    }
#pragma unroll
    for (int m = 0; m < kNumSsimMoments; ++m) {
#pragma unroll
      for (int r = 0; r < kLossRun; ++r) rows[m][row][column + r] = sums[m][r];
    }
  });
  __syncthreads();

  const int64_t map_size = loss.planes * loss.height * loss.width;
  double sum = 0;
  for_each_column_run<S>([&](int first_row, int column) {
    S means[kNumSsimMoments][kLossRun];
#pragma unroll
    for (int m = 0; m < kNumSsimMoments; ++m) blur_column<S>(rows[m], weights.window, first_row, column, means[m]);
#pragma unroll
    for (int r = 0; r < kLossRun; ++r) {
      const int row = first_row + r;
      if (place.row + row >= loss.height || place.column + column >= loss.width) continue;
      const bool counts = in_margins(loss, place.row + row, place.column + column);
      const Ssim<S> pixel = ssim(SsimMoments<S>{means[0][r], means[1][r], means[2][r], means[3][r], means[4][r]});
      const S difference =
          image[row + kSsimRadius][column + kSsimRadius] - target[row + kSsimRadius][column + kSsimRadius];
      sum += weights.l1 * abs(difference) + weights.l2 * (difference * difference) +
             (counts ? weights.ssim * pixel.value : S(0));
      if (loss.derivatives != nullptr) {
        const int64_t index = place.plane + static_cast<int64_t>(place.row + row) * loss.width + place.column + column;
        loss.derivatives[index] = counts ? pixel.d_mean : S(0);
        loss.derivatives[map_size + index] = counts ? pixel.d_square : S(0);
        loss.derivatives[2 * map_size + index] = counts ? pixel.d_product : S(0);
      }
    }
  });
  sum = block_sum(sum);
  if (threadIdx.x == 0) loss.sums[blockIdx.x] = sum;
}

template <class S>
__global__ void __launch_bounds__(kLossBlock)
    gradient_kernel(const __grid_constant__ ImageLoss<S> loss, const __grid_constant__ LossWeights<S> weights) {
  using T = Tile<S>;
  alignas(16) __shared__ typename T::Padded maps[kNumSsimDerivatives];
  __shared__ typename T::Rows rows[kNumSsimDerivatives];
  const Place place = place_of_block(loss);
  const int64_t map_size = loss.planes * loss.height * loss.width;
  for_each_padded(loss, place, [&](int row, int column, int64_t index) {
#pragma unroll
    for (int m = 0; m < kNumSsimDerivatives; ++m) {
      maps[m][row][column] = index < 0 ? S(0) : loss.derivatives[m * map_size + index];
    }
  });
  __syncthreads();

  for_each_row_run<S>([&](int row, int column) {
#pragma unroll
    for (int m = 0; m < kNumSsimDerivatives; ++m) {
      S reached[kReach];
      read_along_row(&maps[m][row][column], reached);
#pragma unroll
      for (int r = 0; r < kLossRun; ++r) {
        S sum = 0;
#pragma unroll
        for (int k = 0; k < kSsimTaps; ++k) sum += weights.window.taps[k] * reached[r + k];
        rows[m][row][column + r] = sum;
      }
    }
  });
  __syncthreads();

  for_each_column_run<S>([&](int first_row, int column) {
    S means[kNumSsimDerivatives][kLossRun];
#pragma unroll
    for (int m = 0; m < kNumSsimDerivatives; ++m) blur_column<S>(rows[m], weights.window, first_row, column, means[m]);
#pragma unroll
    for (int r = 0; r < kLossRun; ++r) {
      const int row = first_row + r;
      if (place.row + row >= loss.height || place.column + column >= loss.width) continue;
      const int64_t index = place.plane + static_cast<int64_t>(place.row + row) * loss.width + place.column + column;
      const S x = loss.image[index], y = target_value(loss, index);
      loss.gradient[index] = weights.l1 * sign(x - y) + S(2) * weights.l2 * (x - y) +
                             weights.ssim * ssim_gradient(x, y, means[0][r], means[1][r], means[2][r]);
    }
  });
}

template <class S> struct SumArguments {
  const double* sums;  // [count] of the tiles
  int64_t count;       // tiles
  double offset;       // added to their sum
  S* loss;             // [1] written
};

// Adds the tiles' sums in a fixed order.
template <class S>
__global__ void __launch_bounds__(kLossSumBlock) sum_kernel(const __grid_constant__ SumArguments<S> arguments) {
  double sum = 0;
  for (int64_t i = threadIdx.x; i < arguments.count; i += kLossSumBlock) sum += arguments.sums[i];
  sum = block_sum(sum);
  if (threadIdx.x == 0) *arguments.loss = static_cast<S>(arguments.offset + sum);
}

}  // namespace

template <class S> int64_t num_image_loss_sums(int64_t planes, int height, int width) {
  return num_blocks<S>(planes, height, width);
}

template <class S> void image_loss(const ImageLoss<S>& loss, void* stream) {
  refuse_image_loss("cuda::image_loss", loss);
  const auto cuda_stream = static_cast<cudaStream_t>(stream);
  const int64_t blocks = num_blocks<S>(loss.planes, loss.height, loss.width);
  const LossWeights<S> weights = {ssim_window<S>(), static_cast<S>(loss.l1_scale()), static_cast<S>(loss.l2_scale()),
                                  static_cast<S>(loss.ssim_scale())};
  const unsigned grid = static_cast<unsigned>(blocks);
  value_kernel<<<grid, kLossBlock, 0, cuda_stream>>>(loss, weights);
  DSMOE_CHECK_LAUNCH("the loss");
  if (loss.gradient != nullptr) {
    gradient_kernel<<<grid, kLossBlock, 0, cuda_stream>>>(loss, weights);
    DSMOE_CHECK_LAUNCH("the gradient of the loss");
  }
  SumArguments<S> sum = {};
  sum.sums = loss.sums;
  sum.count = blocks;
  sum.offset = loss.offset;
  sum.loss = loss.loss;
  sum_kernel<<<1, kLossSumBlock, 0, cuda_stream>>>(sum);
  DSMOE_CHECK_LAUNCH("the sum of the loss");
}

template int64_t num_image_loss_sums<float>(int64_t, int, int);
template int64_t num_image_loss_sums<double>(int64_t, int, int);
template void image_loss<float>(const ImageLoss<float>&, void*);
template void image_loss<double>(const ImageLoss<double>&, void*);

}  // namespace cuda
}  // namespace dsmoe
