// The passes over the pixels of a rendering: dsmoe/passes says what each does.
#include <algorithm>
#include <cstdint>
#include <memory>
#include <vector>

#include "../refuse.h"
#include "dsmoe/rasterize.h"
#include "loops.h"
#include "parallel.h"

namespace dsmoe {
namespace cpu {
namespace {

// The num_features of a pass: tile_pass_impl.h keeps four arrays and the numbers of a State, and six arrays are there.
template <class Pass> constexpr int kScratchFeatures = std::max(Pass::template State<float>::kNum - 2, 0);

// Runs a pass without sums, and the tiles of one with sums. num_features: how many the scratch memory has room for.
template <class S, class Pass>
void walk_tiles(const Frame<S>& frame, const Pass& pass, int num_features = kScratchFeatures<Pass>,
                typename Pass::template Sums<S>* records = nullptr) {
  const auto kernel = tile_kernels<S>().template of_pass<Pass>();
  for_each_tile(frame.config, frame.saved, frame.camera.width, frame.camera.height, num_features,
                [&](const Tile<S>& tile, S* scratch) { return kernel(tile, pass, records, scratch); });
}

constexpr int64_t kGaussianChunk = 4096;  // a few additions each

// Runs a pass with sums. Each tile writes one record per instance. Then each Gaussian sums its own records, which lie
// side by side, in double: a large one has thousands of instances. There are no atomics, so the result does not depend
// on the threads.
template <class S, class Pass>
void sum_pixels(const Frame<S>& frame, const Pass& pass, int num_features = kScratchFeatures<Pass>) {
  using Record = typename Pass::template Sums<S>;
  const int64_t num_gaussians = frame.inputs.num_gaussians;
  std::vector<typename Pass::template Sums<double>> totals(num_gaussians);
  for_each_band(frame, nullptr, [&](const Frame<S>& band) {
    const int64_t* slots = band.saved.instance_offsets;
    const std::unique_ptr<Record[]> records(new Record[slots[num_gaussians]]);
    walk_tiles(band, pass, num_features, records.get());
    parallel_for(frame.config.num_threads, num_gaussians, kGaussianChunk, [&](int64_t begin, int64_t end) {
      for (int64_t i = begin; i < end; ++i) {
        for (int64_t slot = slots[i]; slot < slots[i + 1]; ++slot) {
          Record::for_each([](double& sum, S part) { sum += part; }, totals[i], records[slot]);
        }
      }
    });
  });
  const SumTargets<S> to = pass.targets();
  for (int64_t i = 0; i < num_gaussians; ++i) {
    int number = to.counts != nullptr ? -1 : 0;
    const auto write = [&](double sum) {
      if (number < 0) {
        to.counts[i] = static_cast<int32_t>(sum);
      } else {
        to.numbers[number][i] = static_cast<S>(sum);
      }
      ++number;
    };
    Record::for_each(write, totals[i]);
  }
}

}  // namespace

template <class S> void contributions(const Frame<S>& frame, const ContributionMap<S>& map) {
  const ContributionPass<S> pass = {map};
  refuse_pass("cpu::contributions", frame, pass);
  sum_pixels(frame, pass);
}

template <class S> void importance(const Frame<S>& frame, const ImportanceMap<S>& map) {
  const ImportancePass<S> pass = {map};
  refuse_importance("cpu::importance", frame, pass);
  sum_pixels(frame, pass, kImportanceArrays + 2 * frame.config.num_channels);
}

template <class S> void gate_map(const Frame<S>& frame, const GateMap& map) {
  const GateMapPass<S> pass = gate_map_pass<S>(frame, map);
  refuse_pass("cpu::gate_map", frame, pass);
  for_each_band(frame, nullptr, [&](const Frame<S>& band) { walk_tiles(band, pass); });
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
