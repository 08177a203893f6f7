// The passes over the pixels of a rendering: dsmoe/passes says what each does.
#include "../refuse.h"
#include "pass.h"

namespace dsmoe {
namespace cpu {

template <class S> void contributions(const Frame<S>& frame, const ContributionMap<S>& map) {
  refuse_contributions("cpu::contributions", frame, map);
  sum_pixels(frame, ContributionPass<S>{map}, tile_kernels<S>().contributions, kScratchFeatures<ContributionPass<S>>);
}

template <class S> void importance(const Frame<S>& frame, const ImportanceMap<S>& map) {
  refuse_importance("cpu::importance", frame, map);
  sum_pixels(frame, ImportancePass<S>{map}, tile_kernels<S>().importance,
             kImportanceArrays + 2 * frame.config.num_channels);
}

template <class S> void gate_map(const Frame<S>& frame, const GateMap& map) {
  refuse_gate_map("cpu::gate_map", frame, map);
  for_each_band(frame, nullptr, [&](const Frame<S>& band) {
    walk_tiles(band, gate_map_pass<S>(frame, map), tile_kernels<S>().gate_map, kScratchFeatures<GateMapPass<S>>);
  });
}

#define DSMOE_INSTANTIATE(S)                                               \
  template void contributions(const Frame<S>&, const ContributionMap<S>&); \
  template void importance(const Frame<S>&, const ImportanceMap<S>&);      \
  template void gate_map(const Frame<S>&, const GateMap&);
DSMOE_INSTANTIATE(float)
DSMOE_INSTANTIATE(double)
#undef DSMOE_INSTANTIATE

}  // namespace cpu
}  // namespace dsmoe
