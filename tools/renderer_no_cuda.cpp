// Takes the place of renderer_cuda.cpp in a build without CUDA.
#include <stdexcept>

#include "renderer.h"

namespace dsmoe::tools {

std::unique_ptr<Renderer> make_cuda_renderer(const Model&, const RenderOptions&) {
  throw std::runtime_error("this build has no CUDA: CMake found no nvcc; --device cpu renders");
}

bool has_cuda_renderer() { return false; }

}  // namespace dsmoe::tools
