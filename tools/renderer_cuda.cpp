// dsmoe::cuda at work: as on the CPU, but every pointer is to memory of the device, and everything runs on a stream.
#include <cuda_runtime_api.h>

#include <stdexcept>
#include <string>

#include "dsmoe/rasterize_cuda.h"
#include "renderer.h"

namespace dsmoe::tools {
namespace {

void check(cudaError_t status, const char* what) {
  if (status != cudaSuccess) throw std::runtime_error(std::string("CUDA: ") + what + ": " + cudaGetErrorString(status));
}

/// An array in device memory, freed with the object.
template <class T> class DeviceArray {
 public:
  explicit DeviceArray(std::size_t size) : size_(size) {
    if (size > 0) check(cudaMalloc(reinterpret_cast<void**>(&data_), bytes()), "allocating");
  }
  explicit DeviceArray(const std::vector<T>& values) : DeviceArray(values.size()) { fill(values.data()); }
  template <std::size_t kSize> explicit DeviceArray(const std::array<T, kSize>& values) : DeviceArray(kSize) {
    fill(values.data());
  }
  ~DeviceArray() { cudaFree(data_); }
  DeviceArray(const DeviceArray&) = delete;
  DeviceArray& operator=(const DeviceArray&) = delete;

  T* get() const { return data_; }
  void fill(const T* values) { check(cudaMemcpy(data_, values, bytes(), cudaMemcpyHostToDevice), "sending"); }
  std::vector<T> read() const {
    std::vector<T> values(size_);
    check(cudaMemcpy(values.data(), data_, bytes(), cudaMemcpyDeviceToHost), "reading back");
    return values;
  }

 private:
  std::size_t bytes() const { return size_ * sizeof(T); }
  T* data_ = nullptr;
  std::size_t size_;
};

/// A stream of its own: it does not wait for others.
class Stream {
 public:
  Stream() { check(cudaStreamCreate(&stream_), "making a stream"); }
  ~Stream() { cudaStreamDestroy(stream_); }
  Stream(const Stream&) = delete;
  Stream& operator=(const Stream&) = delete;
  cudaStream_t get() const { return stream_; }

 private:
  cudaStream_t stream_ = nullptr;
};

class CudaRenderer final : public Renderer {
 public:
  CudaRenderer(const Model& model, const RenderOptions& options)
      : options_(options),
        means3D_(model.means3D),
        dc_(model.dc),
        shs_(model.shs),
        opacities_(model.opacities),
        scales_(model.scales),
        rotations_(model.rotations),
        background_(options.background),
        view_(16),
        projection_(16),
        position_(3),
        radii_(static_cast<std::size_t>(model.count)) {
    frame_.inputs.num_gaussians = model.count;
    frame_.inputs.means3D = means3D_.get();
    frame_.inputs.opacities = opacities_.get();
    frame_.inputs.scales = scales_.get();
    frame_.inputs.rotations = rotations_.get();
    frame_.inputs.dc = dc_.get();
    frame_.inputs.shs = shs_.get();
    frame_.inputs.num_sh = model.num_rest();
    frame_.inputs.sh_degree = model.sh_degree;
    frame_.config = raster_config<float>(options_);
    frame_.config.background = background_.get();
    frame_.images.radii = radii_.get();
  }

  Images render(const View& view) override {
    const auto pixels = static_cast<std::size_t>(view.width) * view.height;
    const DeviceArray<float> color(3 * pixels), alpha(pixels), depth(options_.depth ? pixels : 0);
    const Camera<float> camera = camera_of(view);
    view_.fill(camera.view), projection_.fill(camera.projection), position_.fill(camera.position);
    frame_.camera = {camera.width, camera.height,     camera.tan_fov_x, camera.tan_fov_y, camera.near,
                     view_.get(),  projection_.get(), position_.get(),  camera.lens};
    frame_.images.color = color.get();
    frame_.images.gate_sum = alpha.get();
    frame_.images.depth = depth.get();

    cuda::Run run;
    run.stream = stream_.get();
    run.for_backward = false;
    cuda::StreamMemory memory(run.stream);
    cuda::forward(frame_, run, memory);
    const DeviceArray<int32_t> gaussians(options_.gate_map ? pixels : 0), counts(options_.gate_map ? pixels : 0);
    if (options_.gate_map) cuda::gate_map(frame_, {gaussians.get(), counts.get()}, {run.stream, &memory});
    check(cudaStreamSynchronize(run.stream), "rendering");
    return {view.width, view.height, color.read(), alpha.read(), depth.read(), gaussians.read(), counts.read()};
  }

 private:
  const RenderOptions options_;
  const Stream stream_;
  const DeviceArray<float> means3D_, dc_, shs_, opacities_, scales_, rotations_, background_;
  DeviceArray<float> view_, projection_, position_;
  const DeviceArray<int32_t> radii_;
  cuda::Frame<float> frame_;
};

}  // namespace

std::unique_ptr<Renderer> make_cuda_renderer(const Model& model, const RenderOptions& options) {
  int devices = 0;
  const cudaError_t status = cudaGetDeviceCount(&devices);
  if (status != cudaSuccess || devices == 0) {
    throw std::runtime_error(std::string("there is no GPU: ") + cudaGetErrorString(status) + "; --device cpu renders");
  }
  return std::make_unique<CudaRenderer>(model, options);
}

bool has_cuda_renderer() { return true; }

}  // namespace dsmoe::tools
