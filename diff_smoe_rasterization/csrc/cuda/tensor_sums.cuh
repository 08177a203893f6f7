// Sums over a warp's pixels by tensor cores. Everything a Gaussian's gradient needs is a product of two small matrices:
//
//   moments     [Gaussians, 6] = dL/dpower [Gaussians, 64 pixels] x [64 pixels, 6]: 1, u, v, u^2, u v, v^2
//   dL/dfeature [Gaussians, 3] = weights   [Gaussians, 64 pixels] x [64 pixels, 3]: g'
//
// with u and v the pixel's place in the warp's 8x8. They are half-integers, which TF32 holds exactly. Factors that TF32
// does not hold are split in two, so that the products keep 21 bits. Eight Gaussians go at a time: their dL/dpower are
// the upper rows of one 16-row operand, their weights the lower ones.
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
// Numbers between rows: the quads of a warp that read two rows at once meet different banks.
constexpr int kTensorRow = 2 * kWarpTile * kWarpTile + 4;
constexpr int kTensorRecord = kNumGateMoments + kFastFeatures;
constexpr float kWarpTileCentre = (kWarpTile - 1) / 2.0f;
static_assert(kWarpTile == 8 && kLanePixels == 2, "the places of pixels in the operands");

// A right-hand operand, as the lanes hold it: two numbers a lane for each step.
struct TensorBasis {
  float2 of[kTensorSteps][kWarp];
};

// A Gaussian whose sums are wanted.
struct alignas(16) TensorGaussian {
  Vec2<float> shift;  // of the centre of the warp's pixels from its mean
  int32_t index;
};

// What one warp keeps in shared memory.
struct TensorStage {
  float values[kTensorBatch][kTensorRow];  // dL/dpower and weight of pixel k of lane l, at 4 l + 2 k
  TensorBasis gradients;                   // g', each number in two parts side by side
  TensorGaussian gaussians[kTensorBatch];
};

// What TF32 keeps of a number.
inline __device__ float tf32_part(float value) { return __uint_as_float(__float_as_uint(value) & 0xffffe000u); }

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
  for (int i = threadIdx.x; i < kTensorSteps * kWarp; i += blockDim.x) {
    const int step = i / kWarp;
    const TensorLane lane(i % kWarp);
    const float u = float(2 * lane.column + step % 2) - kWarpTileCentre;
    const auto number = [&](float v) {
      const float numbers[] = {1.0f, u, v, u * u, u * v, v * v, 0.0f, 0.0f};
      return numbers[lane.row];
    };
    const float v = float(step / 2) - kWarpTileCentre;
    basis.of[step][i % kWarp] = make_float2(number(v), number(v + kLaneStep));
  }
}

// Fills the right-hand operand of the features from each lane's g' of its two pixels.
inline __device__ void fill_gradient_basis(TensorStage& stage, const float (&scaled)[kLanePixels][kFastFeatures],
                                           int lane) {
  for (int k = 0; k < kLanePixels; ++k) {
    for (int f = 0; f < kFastFeatures; ++f) stage.values[f][4 * lane + 2 * k] = scaled[k][f];
  }
  __syncwarp();
  const TensorLane at(lane);
  const int feature = at.row / 2;
  for (int step = 0; step < kTensorSteps; ++step) {
    const auto number = [&](int k) {
      if (feature >= kFastFeatures) return 0.0f;
      const int owner = 8 * (step / 2) + 2 * at.column + step % 2;
      const float value = stage.values[feature][4 * owner + 2 * k];
      return at.row % 2 == 0 ? tf32_part(value) : value - tf32_part(value);
    };
    stage.gradients.of[step][lane] = make_float2(number(0), number(1));
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
  // The upper and the lower parts of the numbers have sums of their own, which need not wait for each other.
  float moments[2][4] = {}, features[2][4] = {};
#pragma unroll
  for (int m = 0; m < kTensorSteps / 2; ++m) {
#pragma unroll
    for (int h = 0; h < 2; ++h) {
      const int owner = 8 * m + 2 * at.column + h;
      const float4 both = *reinterpret_cast<const float4*>(&stage.values[at.row][4 * owner]);
      const float all[4] = {both.x, both.y, both.z, both.w};
      float rest[4];
      for (int i = 0; i < 4; ++i) rest[i] = all[i] - tf32_part(all[i]);
      const float2 moment_basis = basis.of[2 * m + h][lane], gradient_basis = stage.gradients.of[2 * m + h][lane];
      multiply_add(moments[0], all, moment_basis);
      multiply_add(features[0], all, gradient_basis);
      multiply_add(moments[1], rest, moment_basis);
      multiply_add(features[1], rest, gradient_basis);
    }
  }
  return {{moments[0][0] + moments[1][0], moments[0][1] + moments[1][1]},
          (features[0][2] + features[1][2]) + (features[0][3] + features[1][3])};
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
