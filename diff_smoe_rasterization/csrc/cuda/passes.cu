// The passes over the pixels of a rendering that read no features: dsmoe/passes says what each does.
#include "../refuse.h"
#include "dsmoe/passes/contributions.h"
#include "dsmoe/passes/gate_map.h"
#include "pass.cuh"

namespace dsmoe {
namespace cuda {

template <class S> void contributions(const Frame<S>& frame, const ContributionMap<S>& map, const Work& work) {
  const ContributionPass<S> pass = {map};
  refuse_pass("cuda::contributions", frame, pass);
  sum_pixels(frame, pass, work);
}

template <class S> void gate_map(const Frame<S>& frame, const GateMap& map, const Work& work) {
  const GateMapPass<S> pass = gate_map_pass<S>(frame, map);
  refuse_pass("cuda::gate_map", frame, pass);
  walk_tiles(frame, pass, work);
}

#define DSMOE_INSTANTIATE(S)                                                            \
  template void contributions(const Frame<S>&, const ContributionMap<S>&, const Work&); \
  template void gate_map(const Frame<S>&, const GateMap&, const Work&);
DSMOE_INSTANTIATE(float)
DSMOE_INSTANTIATE(double)
#undef DSMOE_INSTANTIATE

}  // namespace cuda
}  // namespace dsmoe
