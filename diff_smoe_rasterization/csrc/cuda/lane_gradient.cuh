// The gradients of a warp's Gaussians, from its lanes to global memory.
#pragma once

#include "sh_rows.cuh"

namespace dsmoe {
namespace cuda {

// The gradients of a lane's Gaussian, except by its SH row.
struct LaneGradient {
  GaussianGradient<float> gaussian;
  float dc[3];  // if degree 0 lies apart
};

// Stores the gradients of a warp's Gaussians, zeros included, as far as these exist. rows: the gradients of the SH
// rows, in shared memory. That memory serves the other gradients too, so that the warp writes each array in one piece.
// wanted: the lanes whose Gaussians have rows to write.
template <class Rows>
__device__ void store_gradients(const LaneGradient& gradient, const Rows& rows, const GaussianGradients<float>& to,
                                unsigned wanted) {
  const GaussianGradient<float>& own = gradient.gaussian;
  const int lane = rows.lane(), exist = rows.exist();
  const int64_t first = int64_t(blockIdx.x) * kRowsBlock + threadIdx.x - lane;
  if (to.shs != nullptr) rows.store(to.shs + first * Rows::kLength, wanted);
  if (wanted >> lane & 1) {
    if (to.opacities != nullptr) to.opacities[first + lane] = own.opacity;
    if (to.rotations != nullptr) {
      reinterpret_cast<float4*>(to.rotations)[first + lane] =
          make_float4(own.rotation.x, own.rotation.y, own.rotation.z, own.rotation.w);
    }
  }
  __syncwarp();
  const auto store_threes = [&](float* array, Vec3<float> value, int place) {
    if (array == nullptr) return;
    const WarpRows<3> threes(rows.memory() + place * 3 * kWarp, 3, exist, lane);
    threes.write({value.x, value.y, value.z});
    threes.store(array + 3 * first, wanted);
  };
  store_threes(to.means3D, own.mean, 0);
  store_threes(to.means2D, {own.mean2D.x, own.mean2D.y, 0}, 1);
  store_threes(to.scales, own.scale, 2);
  if (Rows::kDcApart) store_threes(to.dc, load3(gradient.dc), 3);
}

}  // namespace cuda
}  // namespace dsmoe
