// What CUDA reports, in plain words. Throws std::runtime_error. And what stream capture forbids.
#pragma once

#include <cuda_runtime_api.h>

namespace dsmoe {
namespace cuda {

// Throws if `status` is an error; `what` names what was tried.
void check(cudaError_t status, const char* what);

inline bool is_capturing(cudaStream_t stream) {
  cudaStreamCaptureStatus status;
  check(cudaStreamIsCapturing(stream, &status), "asking for the stream's state");
  return status != cudaStreamCaptureStatusNone;
}

// A capture on another thread forbids all threads what might disturb it: to allocate memory, to wait. If that cannot
// touch the capture, this lets the calling thread do it. Without, the capture would be invalid.
class BesideCaptures {
 public:
  BesideCaptures() { check(cudaThreadExchangeStreamCaptureMode(&mode_), "leaving a capture's rules"); }
  BesideCaptures(const BesideCaptures&) = delete;
  BesideCaptures& operator=(const BesideCaptures&) = delete;
  ~BesideCaptures() { cudaThreadExchangeStreamCaptureMode(&mode_); }

 private:
  cudaStreamCaptureMode mode_ = cudaStreamCaptureModeRelaxed;  // then the one to go back to
};

}  // namespace cuda
}  // namespace dsmoe

// After each launch: whether the kernel could be started.
#define DSMOE_CHECK_LAUNCH(kernel) ::dsmoe::cuda::check(cudaGetLastError(), "launching " kernel)
