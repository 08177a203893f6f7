// Which Gaussian has the greatest gate in each pixel.
#include "../refuse.h"
#include "bands.h"
#include "dsmoe/rasterize.h"
#include "tile_kernels.h"
#include "tile_loop.h"

namespace dsmoe {
namespace cpu {

template <class S> void gate_map(const Frame<S>& frame, const GateMap& map) {
  refuse_gate_map("cpu::gate_map", frame, map);
  const auto& kernels = tile_kernels<S>();
  for_each_band(frame, nullptr, [&](const Frame<S>& band) {
    for_each_tile(frame.config, band.saved, frame.camera.width, frame.camera.height, 0,
                  [&](const Tile<S>& tile, S* scratch) { return kernels.gate_map(tile, map, scratch); });
  });
}

#define DSMOE_INSTANTIATE(S) template void gate_map(const Frame<S>&, const GateMap&);
DSMOE_INSTANTIATE(float)
DSMOE_INSTANTIATE(double)
#undef DSMOE_INSTANTIATE

}  // namespace cpu
}  // namespace dsmoe
