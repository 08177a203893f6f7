// A thread per Gaussian.
#include "check.h"
#include "dsmoe/gaussians.h"

namespace dsmoe {
namespace cuda {
namespace {

constexpr int kBlock = 256;

template <class Function> __global__ void __launch_bounds__(kBlock) for_each_kernel(int64_t count, Function function) {
  const int64_t i = int64_t(blockIdx.x) * kBlock + threadIdx.x;
  if (i < count) function(i);
}

template <class Function> void for_each(int64_t count, void* stream, Function function) {
  if (count == 0) return;
  const auto blocks = static_cast<unsigned>((count + kBlock - 1) / kBlock);
  for_each_kernel<<<blocks, kBlock, 0, static_cast<cudaStream_t>(stream)>>>(count, function);
  DSMOE_CHECK_LAUNCH("a pass over the Gaussians");
}

// Functors, since a lambda for the device would need a compiler flag.
template <class S> struct Activate {
  GaussianParameters<const S> raw;
  GaussianParameters<S> values;
  __device__ void operator()(int64_t i) const { dsmoe::activate(raw, values, i); }
};

template <class S> struct ActivateBackward {
  GaussianParameters<const S> raw, values, dL_dvalues;
  GaussianParameters<S> dL_draw;
  __device__ void operator()(int64_t i) const { dsmoe::activate_backward(raw, values, dL_dvalues, dL_draw, i); }
};

template <class S> struct AddView {
  const S* dL_dmeans2D;
  const int32_t* radii;
  S *gradient_sum, *view_count;
  __device__ void operator()(int64_t i) const { dsmoe::add_view(dL_dmeans2D, radii, gradient_sum, view_count, i); }
};

}  // namespace

template <class S>
void activate(const GaussianParameters<const S>& raw, const GaussianParameters<S>& values, int64_t count,
              void* stream) {
  for_each(count, stream, Activate<S>{raw, values});
}

template <class S>
void activate_backward(const GaussianParameters<const S>& raw, const GaussianParameters<const S>& values,
                       const GaussianParameters<const S>& dL_dvalues, const GaussianParameters<S>& dL_draw,
                       int64_t count, void* stream) {
  for_each(count, stream, ActivateBackward<S>{raw, values, dL_dvalues, dL_draw});
}

template <class S>
void add_view(const S* dL_dmeans2D, const int32_t* radii, S* gradient_sum, S* view_count, int64_t count, void* stream) {
  for_each(count, stream, AddView<S>{dL_dmeans2D, radii, gradient_sum, view_count});
}

#define DSMOE_INSTANTIATE(S)                                                                                    \
  template void activate<S>(const GaussianParameters<const S>&, const GaussianParameters<S>&, int64_t, void*);  \
  template void activate_backward<S>(const GaussianParameters<const S>&, const GaussianParameters<const S>&,    \
                                     const GaussianParameters<const S>&, const GaussianParameters<S>&, int64_t, \
                                     void*);                                                                    \
  template void add_view<S>(const S*, const int32_t*, S*, S*, int64_t, void*);
DSMOE_INSTANTIATE(float)
DSMOE_INSTANTIATE(double)
#undef DSMOE_INSTANTIATE

}  // namespace cuda
}  // namespace dsmoe
