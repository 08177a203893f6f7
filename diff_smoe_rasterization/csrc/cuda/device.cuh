// What several kernels share: warps, scratch memory, the camera in shared memory.
#pragma once

#include <cstdint>

#include "check.h"
#include "dsmoe/rasterize_cuda.h"

namespace dsmoe {
namespace cuda {

constexpr int kWarp = 32;
constexpr unsigned kAllLanes = 0xffffffffu;

inline unsigned blocks_for(int64_t items, int block) { return static_cast<unsigned>((items + block - 1) / block); }

template <class T> T* allocate(Scratch& scratch, int64_t count) {
  void* memory = scratch.allocate(static_cast<size_t>(count) * sizeof(T));
  if (memory == nullptr && count > 0) check(cudaErrorMemoryAllocation, "allocating scratch memory");
  return static_cast<T*>(memory);
}

// Copies the camera to shared memory; all threads of the block take part. No barrier.
template <class S> __device__ void load_camera(const DeviceCamera<S>& from, Camera<S>& to) {
  for (int i = threadIdx.x; i < 16; i += blockDim.x) to.view[i] = from.view[i], to.projection[i] = from.projection[i];
  for (int i = threadIdx.x; i < 3; i += blockDim.x) to.position[i] = from.position[i];
  if (threadIdx.x == 0) {
    to.width = from.width, to.height = from.height;
    to.tan_fov_x = from.tan_fov_x, to.tan_fov_y = from.tan_fov_y;
    to.near = from.near;
  }
}

// The inputs and gradients of Gaussian i alone, as number 0.
template <class S> DSMOE_HD GaussianInputs<S> inputs_of(const GaussianInputs<S>& in, int num_channels, int64_t i) {
  const auto at = [i](const S* base, int size) { return base == nullptr ? nullptr : base + i * size; };
  GaussianInputs<S> out = in;
  out.num_gaussians = 1;
  out.means3D = at(in.means3D, 3), out.opacities = at(in.opacities, 1);
  out.scales = at(in.scales, 3), out.rotations = at(in.rotations, 4), out.cov3D_precomp = at(in.cov3D_precomp, 6);
  out.colors_precomp = at(in.colors_precomp, num_channels);
  out.dc = at(in.dc, 3), out.shs = at(in.shs, 3 * in.num_sh);
  return out;
}

template <class S>
DSMOE_HD GaussianGradients<S> gradients_of(const GaussianGradients<S>& g, int num_channels, int num_sh, int64_t i) {
  const auto at = [i](S* base, int size) { return base == nullptr ? nullptr : base + i * size; };
  GaussianGradients<S> out = g;
  out.means3D = at(g.means3D, 3), out.means2D = at(g.means2D, 3), out.opacities = at(g.opacities, 1);
  out.scales = at(g.scales, 3), out.rotations = at(g.rotations, 4), out.cov3D_precomp = at(g.cov3D_precomp, 6);
  out.colors_precomp = at(g.colors_precomp, num_channels);
  out.dc = at(g.dc, 3), out.shs = at(g.shs, 3 * num_sh);
  return out;
}

// Whether the instances did not fit their memory. Then no tile list is read; the depth order is the list of every tile.
template <class S> __device__ bool overflows(const SavedForward<S>& saved) {
  return *saved.num_instances > saved.capacity;
}

}  // namespace cuda
}  // namespace dsmoe
