// What a C++ compiler needs of CUDA to compile the kernels for the host, after prepare.py. Each thread of a block is a
// fiber; blocks run one after another, and device memory is the host's. Memory that nobody has written holds a pattern:
// NaN, and a large integer. What would hang or be undefined on a GPU ends the program with a message.
#pragma once

#include <math.h>

#include <cstdint>
#include <cstdlib>
#include <cstring>
#include <functional>

#define __CUDACC__ 12
#ifndef __CUDA_ARCH__
#define __CUDA_ARCH__ 800
#endif
#define __CUDA_ARCH_LIST__ 800
#define __global__
#define __device__
#define __host__
#define __grid_constant__
#define __launch_bounds__(...)
#define __forceinline__ inline __attribute__((always_inline))

struct dim3 {
  unsigned x, y, z;
  dim3(unsigned x = 1, unsigned y = 1, unsigned z = 1) : x(x), y(y), z(z) {}
};
struct alignas(8) int2 {
  int x, y;
};
struct alignas(8) float2 {
  float x, y;
};
struct alignas(16) float4 {
  float x, y, z, w;
};
inline int2 make_int2(int x, int y) { return {x, y}; }
inline float2 make_float2(float x, float y) { return {x, y}; }
inline float4 make_float4(float x, float y, float z, float w) { return {x, y, z, w}; }

extern dim3 threadIdx, blockIdx, blockDim, gridDim;

namespace emulator {

constexpr int kLanes = 32;
constexpr size_t kSharedBytes = 48 << 10;  // what every card gives a block
extern char dynamic_shared[kSharedBytes];
extern int multiprocessors;  // that the card says it has
extern bool other_captures;  // another thread captures a graph, and forbids others what might disturb it

// Where something is called, as an argument that is left out.
struct Place {
  const char* file;
  int line;
  Place(const char* file = __builtin_FILE(), int line = __builtin_LINE()) : file(file), line(line) {}
};

// What the lanes of a warp have brought to a meeting. A lane may read it until it goes to another one.
struct Meeting {
  alignas(16) unsigned char values[kLanes][24];
  uint32_t lanes;  // that take part
};

void launch(const std::function<void()>& thread, dim3 grid, dim3 block, size_t shared_bytes, void* stream);
void meet_block(Place place);
const Meeting& meet_warp(unsigned mask, const void* value, size_t size, Place place);
void copy_later(void* to, const void* from, size_t size);  // when the thread waits for its copies
void finish_copies();
void fill(void* memory, size_t bytes);  // with the pattern
bool is_first_use(const void* shared);  // in this block
[[noreturn]] void fail(const char* what, Place place = {});

// Each block finds its shared memory filled with the pattern.
template <class... T> void begin_shared(T&... memory) {
  ((is_first_use(&memory) ? fill(&memory, sizeof(memory)) : void()), ...);
}

inline int lane() { return threadIdx.x % kLanes; }

template <class T> T of_lane(const Meeting& meeting, int lane, Place place) {
  if ((meeting.lanes >> lane & 1) == 0) fail("the value of a lane that does not take part", place);
  T value;
  memcpy(&value, meeting.values[lane], sizeof(value));
  return value;
}

template <class T> T shuffle(unsigned mask, T value, int from, Place place) {
  return of_lane<T>(meet_warp(mask, &value, sizeof(value), place), from, place);
}

template <class To, class From> To same_bits(From from) {
  static_assert(sizeof(To) == sizeof(From), "the same bits");
  To to;
  memcpy(&to, &from, sizeof(to));
  return to;
}

}  // namespace emulator

// ---- Threads that meet ----

inline void __syncthreads(emulator::Place place = {}) { emulator::meet_block(place); }
inline void __syncwarp(unsigned mask = ~0u, emulator::Place place = {}) { emulator::meet_warp(mask, "", 0, place); }
inline unsigned __ballot_sync(unsigned mask, bool set, emulator::Place place = {}) {
  const emulator::Meeting& meeting = emulator::meet_warp(mask, &set, sizeof(set), place);
  unsigned all = 0;
  for (int i = 0; i < emulator::kLanes; ++i) all |= unsigned(meeting.values[i][0]) << i;
  return all & meeting.lanes;
}
inline bool __any_sync(unsigned mask, bool set, emulator::Place place = {}) { return __ballot_sync(mask, set, place); }
template <class T> T __shfl_sync(unsigned mask, T value, int from, emulator::Place place = {}) {
  return emulator::shuffle(mask, value, from % emulator::kLanes, place);
}
template <class T> T __shfl_xor_sync(unsigned mask, T value, int by, emulator::Place place = {}) {
  return emulator::shuffle(mask, value, emulator::lane() ^ by, place);
}
template <class T> T __shfl_up_sync(unsigned mask, T value, int by, emulator::Place place = {}) {
  return emulator::shuffle(mask, value, emulator::lane() - (emulator::lane() < by ? 0 : by), place);
}
template <class T> T __shfl_down_sync(unsigned mask, T value, int by, emulator::Place place = {}) {
  return emulator::shuffle(mask, value, emulator::lane() + (emulator::lane() + by < emulator::kLanes ? by : 0), place);
}

// ---- What a thread does by itself ----

template <class T, class U> T atomicAdd(T* to, U value) {
  const T old = *to;
  *to = old + static_cast<T>(value);
  return old;
}
template <class T> T atomicMax(T* to, T value) {
  const T old = *to;
  *to = old < value ? value : old;
  return old;
}
inline int __popc(unsigned x) { return __builtin_popcount(x); }
inline int __ffs(unsigned x) { return __builtin_ffs(static_cast<int>(x)); }
inline int __clz(int x) { return x == 0 ? 32 : __builtin_clz(x); }
inline float __fmul_rn(float a, float b) { return a * b; }
inline double __dmul_rn(double a, double b) { return a * b; }
inline unsigned __float_as_uint(float x) { return emulator::same_bits<unsigned>(x); }
inline float __uint_as_float(unsigned x) { return emulator::same_bits<float>(x); }
inline float __int_as_float(int x) { return emulator::same_bits<float>(x); }
inline double __hiloint2double(int high, int low) {
  return emulator::same_bits<double>(uint64_t(unsigned(high)) << 32 | unsigned(low));
}
inline size_t __cvta_generic_to_shared(const void* p) { return static_cast<const char*>(p) - emulator::dynamic_shared; }
inline void __pipeline_commit() {}
inline void __pipeline_wait_prior(int) { emulator::finish_copies(); }

// ---- PTX, under the names that prepare.py makes ----

namespace emulator {

inline void cp_async_cg_shared_global(unsigned to, const void* from) { copy_later(dynamic_shared + to, from, 16); }
inline void cp_async_ca_shared_global(unsigned to, const void* from) { copy_later(dynamic_shared + to, from, 4); }

// The approximations are exact here, but for the rounding.
inline float flushed(float x) { return fabsf(x) < 0x1p-126f ? copysignf(0, x) : x; }
inline void ex2_approx_ftz_f32(float& y, float x) { y = flushed(exp2f(flushed(x))); }
inline void rcp_approx_ftz_f32(float& y, float x) { y = flushed(1 / flushed(x)); }
inline void sqrt_approx_ftz_f32(float& y, float x) { y = sqrtf(flushed(x)); }
inline void sqrt_approx_f32(float& y, float x) { y = sqrtf(x); }

// c += a b for matrices in the registers of a warp: a is 16x8, b is 8x8.
inline void mma_sync_aligned_m16n8k8_row_col_f32_tf32_tf32_f32(float& c0, float& c1, float& c2, float& c3, unsigned a0,
                                                               unsigned a1, unsigned a2, unsigned a3, unsigned b0,
                                                               unsigned b1, Place place = {}) {
  struct Operands {
    unsigned a[4], b[2];
  } own = {{a0, a1, a2, a3}, {b0, b1}};
  const Meeting& meeting = meet_warp(~0u, &own, sizeof(own), place);
  const auto tf32 = [](unsigned bits) { return double(__uint_as_float(bits & 0xffffe000u)); };
  const auto add = [&](float& c, int row, int column) {
    double sum = c;
    for (int k = 0; k < 8; ++k) {
      const auto a = of_lane<Operands>(meeting, row % 8 * 4 + k % 4, place).a[row / 8 + k / 4 * 2];
      sum += tf32(a) * tf32(of_lane<Operands>(meeting, column * 4 + k % 4, place).b[k / 4]);
    }
    c = static_cast<float>(sum);
  };
  const int row = lane() / 4, column = lane() % 4 * 2;
  add(c0, row, column), add(c1, row, column + 1), add(c2, row + 8, column), add(c3, row + 8, column + 1);
}

}  // namespace emulator

// ---- The host's side: what is put on a stream is done at once ----

using cudaStream_t = struct CUstream_st*;
using cudaEvent_t = struct CUevent_st*;
enum cudaError_t {
  cudaSuccess,
  cudaErrorMemoryAllocation,
  cudaErrorNoKernelImageForDevice,
  cudaErrorInvalidDeviceFunction,
  cudaErrorStreamCaptureUnsupported
};
enum cudaMemcpyKind { cudaMemcpyDeviceToHost };
enum cudaDeviceAttr { cudaDevAttrMultiProcessorCount };
enum cudaStreamCaptureStatus { cudaStreamCaptureStatusNone };
enum cudaStreamCaptureMode { cudaStreamCaptureModeGlobal, cudaStreamCaptureModeRelaxed };
constexpr unsigned cudaHostAllocPortable = 0;
struct cudaDeviceProp {
  const char* name;
  int major, minor;
};
inline cudaError_t cudaGetLastError() { return cudaSuccess; }
inline const char* cudaGetErrorString(cudaError_t) { return "an error"; }
inline const char* cudaGetErrorName(cudaError_t) { return "an error"; }
inline cudaError_t cudaGetDevice(int* device) { return *device = 0, cudaSuccess; }
inline cudaError_t cudaGetDeviceProperties(cudaDeviceProp* of, int) { return *of = {"emulator", 8, 0}, cudaSuccess; }
inline cudaError_t cudaDeviceGetAttribute(int* value, cudaDeviceAttr, int) {
  return *value = emulator::multiprocessors, cudaSuccess;
}
inline cudaError_t cudaStreamIsCapturing(cudaStream_t, cudaStreamCaptureStatus* is) { return *is = {}, cudaSuccess; }
namespace emulator {
inline thread_local cudaStreamCaptureMode capture_mode = cudaStreamCaptureModeGlobal;
inline cudaError_t unless_forbidden() {
  const bool forbidden = other_captures && capture_mode != cudaStreamCaptureModeRelaxed;
  return forbidden ? cudaErrorStreamCaptureUnsupported : cudaSuccess;
}
}  // namespace emulator
inline cudaError_t cudaThreadExchangeStreamCaptureMode(cudaStreamCaptureMode* mode) {
  const cudaStreamCaptureMode before = emulator::capture_mode;
  emulator::capture_mode = *mode;
  return *mode = before, cudaSuccess;
}
inline cudaError_t cudaStreamSynchronize(cudaStream_t) { return emulator::unless_forbidden(); }
inline cudaError_t cudaMallocAsync(void** memory, size_t bytes, cudaStream_t) {
  *memory = aligned_alloc(256, (bytes + 255) / 256 * 256);
  if (*memory == nullptr) return cudaErrorMemoryAllocation;
  return emulator::fill(*memory, bytes), cudaSuccess;
}
inline cudaError_t cudaHostAlloc(void** memory, size_t bytes, unsigned) {
  const cudaError_t status = emulator::unless_forbidden();
  return status != cudaSuccess ? status : cudaMallocAsync(memory, bytes, {});
}
inline cudaError_t cudaFreeAsync(void* memory, cudaStream_t) { return free(memory), cudaSuccess; }
inline cudaError_t cudaMemsetAsync(void* to, int byte, size_t n, cudaStream_t) {
  return memset(to, byte, n), cudaSuccess;
}
inline cudaError_t cudaMemcpyAsync(void* to, const void* from, size_t bytes, cudaMemcpyKind, cudaStream_t) {
  return memcpy(to, from, bytes), cudaSuccess;
}
inline cudaError_t cudaEventCreate(cudaEvent_t* event) { return *event = nullptr, cudaSuccess; }
inline cudaError_t cudaEventRecord(cudaEvent_t, cudaStream_t) { return cudaSuccess; }
inline cudaError_t cudaEventSynchronize(cudaEvent_t) { return cudaSuccess; }
inline cudaError_t cudaEventElapsedTime(float* ms, cudaEvent_t, cudaEvent_t) { return *ms = 0, cudaSuccess; }
inline cudaError_t cudaEventDestroy(cudaEvent_t) { return cudaSuccess; }
