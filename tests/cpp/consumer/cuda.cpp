// Renders and differentiates on a GPU through the installed library: device pointers and a stream, no torch. Exit
// status 77 says that there is no GPU.
#include <cuda_runtime_api.h>

#include <cstdlib>
#include <vector>

#include "dsmoe/rasterize_cuda.h"
#include "scene.h"

namespace {

void check(cudaError_t status) {
  if (status == cudaSuccess) return;
  std::printf("%s\n", cudaGetErrorString(status));
  std::exit(1);
}

// An array in device memory, freed with the object.
template <class T> class Device {
 public:
  explicit Device(size_t size) : size_(size) { check(cudaMalloc(reinterpret_cast<void**>(&data_), size * sizeof(T))); }
  template <size_t kCount> explicit Device(const T (&values)[kCount]) : Device(kCount) { fill(values); }
  ~Device() { cudaFree(data_); }

  void fill(const T* values) { check(cudaMemcpy(data_, values, size_ * sizeof(T), cudaMemcpyHostToDevice)); }
  T* get() const { return data_; }
  std::vector<T> read() const {
    std::vector<T> values(size_);
    check(cudaMemcpy(values.data(), data_, size_ * sizeof(T), cudaMemcpyDeviceToHost));
    return values;
  }

 private:
  T* data_ = nullptr;
  size_t size_;
};

}  // namespace

int main() {
  using namespace scene;
  int devices = 0;
  if (cudaGetDeviceCount(&devices) != cudaSuccess || devices == 0) {
    std::printf("there is no GPU\n");
    return 77;
  }
  const Device<float> mean(kMean), opacity(kOpacity), scale(kScale), rotation(kRotation), expert(kExpert);
  const Device<float> background(kBackground), view(kView), projection(kProjection), position(kPosition);
  const Device<float> color(3 * kPixels), gate_sum(kPixels), dL_dexpert(3);
  const Device<int32_t> radius(1);
  Device<float> dL_dcolor(3 * kPixels);
  std::vector<float> one_pixel(3 * kPixels);
  for (int channel = 0; channel < 3; ++channel) one_pixel[channel * kPixels + kCentre] = 1;
  dL_dcolor.fill(one_pixel.data());

  dsmoe::cuda::Frame<float> frame;
  frame.inputs.num_gaussians = 1;
  frame.inputs.means3D = mean.get();
  frame.inputs.opacities = opacity.get();
  frame.inputs.scales = scale.get();
  frame.inputs.rotations = rotation.get();
  frame.inputs.colors_precomp = expert.get();
  frame.camera.width = frame.camera.height = kSize;
  frame.camera.tan_fov_x = frame.camera.tan_fov_y = kTanFov;
  frame.camera.view = view.get();
  frame.camera.projection = projection.get();
  frame.camera.position = position.get();
  frame.config.blend.mode = dsmoe::BlendMode::kSmoe;
  frame.config.background = background.get();
  frame.images.color = color.get();
  frame.images.gate_sum = gate_sum.get();
  frame.images.radii = radius.get();

  cudaStream_t stream;
  check(cudaStreamCreate(&stream));
  dsmoe::cuda::Run run;
  run.stream = stream;
  bool right = true;
  for (const bool deterministic : {false, true, false}) {  // the last one takes the capacity that the first has learned
    run.deterministic = deterministic;
    dsmoe::cuda::StreamMemory memory(stream);
    dsmoe::cuda::forward(frame, run, memory);
    dsmoe::cuda::Gradients<float> gradients;
    gradients.images.color = dL_dcolor.get();
    gradients.inputs.colors_precomp = dL_dexpert.get();
    dsmoe::cuda::backward(frame, gradients, run, memory);
    check(cudaStreamSynchronize(stream));
    right = is_right(color.read().data(), radius.read()[0], dL_dexpert.read().data()) && right;
  }
  check(cudaStreamDestroy(stream));
  return right ? 0 : 1;
}
