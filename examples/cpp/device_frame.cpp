// dsmoe::cuda: what runs a frame of device pointers on a stream.
#include <dsmoe/rasterize_cuda.h>

void render(dsmoe::cuda::Frame<float>& frame, const dsmoe::cuda::Gradients<float>& gradients, cudaStream_t stream) {
  dsmoe::cuda::Run run;
  run.stream = stream;
  dsmoe::cuda::StreamMemory memory(stream);  // or an Allocator of your own
  dsmoe::cuda::forward(frame, run, memory);
  dsmoe::cuda::backward(frame, gradients, run, memory);
}

int main() {}
