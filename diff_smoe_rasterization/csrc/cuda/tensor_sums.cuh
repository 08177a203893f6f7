// Sums over a warp's pixels by tensor cores. Everything a Gaussian's gradient needs is a product of two small matrices:
//
//   moments     [Gaussians, 6] = dL/dpower [Gaussians, 64 pixels] x [64 pixels, 6]: 1, u, v, u^2, u v, v^2
//   dL/dfeature [Gaussians, 3] = weights   [Gaussians, 64 pixels] x [64 pixels, 3]: g'
//
// with u and v the pixel's place in the warp's 8x8. They are half-integers, which TF32 holds exactly. Factors that TF32
// does not hold are split in two, so that the products keep 20 bits. Eight Gaussians go at a time: the upper parts of
// their numbers are the upper rows of a 16-row operand, the lower parts the lower ones.
#pragma once

#include "dsmoe/gate.h"
#include "tile_walk.cuh"

namespace dsmoe {
namespace cuda {

#if defined(__CUDA_ARCH__) && __CUDA_ARCH__ >= 800
constexpr bool kHasTensorSums = true;
#else
constexpr bool kHasTensorSums = false;
#endif

// Which kernels sum by tensor cores.
template <class S, int kFeatures>
constexpr bool kSumsByTensors = kHasTensorSums && sizeof(S) == sizeof(float) && kFeatures == kFastFeatures;
constexpr int kTensorSteps = 8;  // of 8 pixels each
constexpr int kTensorRecord = kNumGateMoments + kFastFeatures;
constexpr float kWarpTileCentre = (kWarpTile - 1) / 2.0f;
static_assert(kWarpTile == 8 && kLanePixels == 2, "the places of pixels in the operands");

// A right-hand operand, as the lanes hold it: two numbers a lane for each of two steps.
struct TensorBasis {
  float4 of[kTensorSteps / 2][kWarp];
};

// The numbers of one Gaussian. With a gap behind them, the quads of a warp that read two rows at once meet different
// banks.
struct TensorRow {
  float4 values[kWarp];  // of each lane: dL/dpower and weight of its first pixel, then of its second
  float4 gap;
};

// What one warp keeps in shared memory.
struct TensorStage {
  TensorRow rows[kTensorBatch];
  TensorBasis gradients;  // g', each number in two parts side by side
};

// What TF32 keeps of a number, but for its last bit: where nothing but bits that the operands ignore are masked, the
// compiler copies the number instead, in one more instruction.
inline __device__ float tf32_part(float value) { return __uint_as_float(__float_as_uint(value) & 0xffffc000u); }

// sums += a x b; the low bits of the operands are ignored.
inline __device__ void multiply_add(float (&sums)[4], const float (&a)[4], float2 b) {
#if defined(__CUDA_ARCH__) && __CUDA_ARCH__ >= 800
  asm("mma.sync.aligned.m16n8k8.row.col.f32.tf32.tf32.f32 {%0, %1, %2, %3}, {%4, %5, %6, %7}, {%8, %9}, {%0, %1, %2, "
      "%3};"
      : "+f"(sums[0]), "+f"(sums[1]), "+f"(sums[2]), "+f"(sums[3])
      : "r"(__float_as_uint(a[0])), "r"(__float_as_uint(a[1])), "r"(__float_as_uint(a[2])), "r"(__float_as_uint(a[3])),
        "r"(__float_as_uint(b.x)), "r"(__float_as_uint(b.y)));
#endif
}

// A lane's place in the operands. In step 2 m + h, its two pixels are those of lane 8 m + 2 column + h.
struct TensorLane {
  int row, column;
  __device__ explicit TensorLane(int lane) : row(lane / 4), column(lane % 4) {}
};

// Fills the right-hand operand of the moments, which all warps of the block share. The caller needs a barrier behind.
inline __device__ void fill_moment_basis(TensorBasis& basis) {
  for (int i = threadIdx.x; i < kTensorSteps / 2 * kWarp; i += blockDim.x) {
    const int m = i / kWarp;
    const TensorLane lane(i % kWarp);
    const auto number = [&](int h, int k) {
      const float u = float(2 * lane.column + h) - kWarpTileCentre, v = float(m + k * kLaneStep) - kWarpTileCentre;
      const float numbers[] = {1.0f, u, v, u * u, u * v, v * v, 0.0f, 0.0f};
      return numbers[lane.row];
    };
    basis.of[m][i % kWarp] = make_float4(number(0, 0), number(0, 1), number(1, 0), number(1, 1));
  }
}

// Fills the right-hand operand of the features from each lane's g' of its two pixels.
inline __device__ void fill_gradient_basis(TensorStage& stage, const float (&scaled)[kLanePixels][kFastFeatures],
                                           int lane) {
  for (int f = 0; f < kFastFeatures; ++f) stage.rows[f].values[lane] = make_float4(scaled[0][f], 0, scaled[1][f], 0);
  __syncwarp();
  const TensorLane at(lane);
  const int feature = at.row / 2;
  const auto part = [&](float value) { return at.row % 2 == 0 ? tf32_part(value) : value - tf32_part(value); };
  for (int m = 0; m < kTensorSteps / 2; ++m) {
    float4 basis = make_float4(0, 0, 0, 0);
    if (feature < kFastFeatures) {
      const float4 *pair = &stage.rows[feature].values[8 * m + 2 * at.column], left = pair[0], right = pair[1];
      basis = make_float4(part(left.x), part(left.z), part(right.x), part(right.z));
    }
    stage.gradients.of[m][lane] = basis;
  }
  __syncwarp();
}

// One lane's share of a batch of sums: two of Gaussian `row`'s moments, about the centre of the warp's pixels, and one
// of its features. Lanes with column 3 have none.
struct TensorSums {
  float moments[2];
  float feature;
};

inline __device__ TensorSums sum_pixels(const TensorStage& stage, const TensorBasis& basis, int lane) {
  const TensorLane at(lane);
  // Steps 2 m and 2 m + 1 have sums of their own, which need not wait for each other.
  float moments[2][4] = {}, features[2][4] = {};
  const auto add_step = [](float(&sums)[4], float first, float second, float basis_first, float basis_second) {
    const float upper[2] = {tf32_part(first), tf32_part(second)};
    const float parts[4] = {upper[0], first - upper[0], upper[1], second - upper[1]};
    multiply_add(sums, parts, make_float2(basis_first, basis_second));
  };
  const float4* values = &stage.rows[at.row].values[2 * at.column];
#pragma unroll
  for (int m = 0; m < kTensorSteps / 2; ++m) {
    const float4 moment_basis = basis.of[m][lane], gradient_basis = stage.gradients.of[m][lane];
    const float4 left = values[8 * m], right = values[8 * m + 1];
    add_step(moments[0], left.x, left.z, moment_basis.x, moment_basis.y);
    add_step(features[0], left.y, left.w, gradient_basis.x, gradient_basis.y);
    add_step(moments[1], right.x, right.z, moment_basis.z, moment_basis.w);
    add_step(features[1], right.y, right.w, gradient_basis.z, gradient_basis.w);
  }
  const auto sum = [](const float(&sums)[2][4], int i) {
    return (sums[0][i] + sums[0][i + 2]) + (sums[1][i] + sums[1][i + 2]);
  };
  return {{sum(moments, 0), sum(moments, 1)}, sum(features, 0) + sum(features, 1)};
}

// Moves a lane's moments to the Gaussian's mean; the lanes of a quad hold all six between them.
inline __device__ void recentre(TensorSums& sums, Vec2<float> shift, int lane) {
  const int quad = lane & ~3;
  const auto of = [&](int column, int i) { return __shfl_sync(kAllLanes, sums.moments[i], quad + column); };
  const GateMoments<float> moments = {of(0, 0), of(0, 1), of(1, 0), of(1, 1), of(2, 0), of(2, 1)};
  const GateMoments<float> moved = shift_moments(moments, shift);
  const int column = lane % 4;
  sums.moments[0] = column == 0 ? moved.one : column == 1 ? moved.y : moved.xy;
  sums.moments[1] = column == 0 ? moved.x : column == 1 ? moved.xx : moved.yy;
}

}  // namespace cuda
}  // namespace dsmoe
