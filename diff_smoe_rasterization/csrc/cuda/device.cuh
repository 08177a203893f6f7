// What several kernels share: warps, the camera in shared memory.
#pragma once

#include <cstdint>

#include "check.h"
#include "dsmoe/rasterize_cuda.h"
#include "scratch.h"

namespace dsmoe {
namespace cuda {

constexpr int kWarp = 32;
constexpr unsigned kAllLanes = 0xffffffffu;

inline unsigned blocks_for(int64_t items, int block) { return static_cast<unsigned>((items + block - 1) / block); }

// Copies the camera to shared memory; all threads of the block take part. No barrier.
template <class S> __device__ void load_camera(const DeviceCamera<S>& from, PinholeCamera<S>& to) {
  for (int i = threadIdx.x; i < 16; i += blockDim.x) to.view[i] = from.view[i], to.projection[i] = from.projection[i];
  for (int i = threadIdx.x; i < 3; i += blockDim.x) to.position[i] = from.position[i];
  if (threadIdx.x == 0) {
    to.width = from.width, to.height = from.height;
    to.tan_fov_x = from.tan_fov_x, to.tan_fov_y = from.tan_fov_y;
    to.near = from.near;
  }
}
template <class S> __device__ void load_camera(const DeviceCamera<S>& from, LensCamera<S>& to) {
  load_camera<S>(from, static_cast<PinholeCamera<S>&>(to));
  if (threadIdx.x == 0) to.lens = from.lens;
}
template <class S> __device__ void load_camera(const DeviceCamera<S>& from, Camera<S>& to) {
  load_camera<S>(from, static_cast<LensCamera<S>&>(to));
  if (threadIdx.x == 0) to.shutter = from.shutter;
  if (from.shutter == Shutter::kGlobal) return;
  for (int i = threadIdx.x; i < 16; i += blockDim.x) to.view_end[i] = from.view_end[i];
}

// How much of a camera a kernel knows. A kernel for pinholes alone needs the fewest registers.
enum class CameraKind { kPinhole, kLens, kShutter };
template <class S> CameraKind kind_of(const DeviceCamera<S>& camera) {
  if (camera.shutter != Shutter::kGlobal) return CameraKind::kShutter;
  return camera.lens.model != LensModel::kPinhole ? CameraKind::kLens : CameraKind::kPinhole;
}

// Calls body(TypeOf<PinholeCamera<S>>), or with the LensCamera<S> or Camera<S> that is needed.
template <class T> struct TypeOf { using type = T; };
template <class S, class Body> void dispatch_camera(CameraKind kind, const Body& body) {
  if (kind == CameraKind::kPinhole) return body(TypeOf<PinholeCamera<S>>{});
  if (kind == CameraKind::kLens) return body(TypeOf<LensCamera<S>>{});
  body(TypeOf<Camera<S>>{});
}

// Multiprocessors of the current device.
inline int num_multiprocessors() {
  int device = 0, multiprocessors = 0;
  check(cudaGetDevice(&device), "asking for the device");
  check(cudaDeviceGetAttribute(&multiprocessors, cudaDevAttrMultiProcessorCount, device), "asking for its size");
  return multiprocessors;
}

// Whether each instance says in its upper four bits which quarters of its tile the footprint may meet, quarter 0 in
// the lowest of them. The Gaussian is in the bits below.
constexpr int kMarkShift = 28;
inline bool marks_quarters(int64_t num_gaussians) { return num_gaussians < int64_t(1) << kMarkShift; }

// Whether the instances did not fit their memory. Then no tile list is read; the depth order is the list of every tile.
template <class S> __device__ bool overflows(const SavedForward<S>& saved) {
  return *saved.num_instances > saved.capacity;
}

}  // namespace cuda
}  // namespace dsmoe
