// The tile lists, by macro tiles.
#pragma once

#include "dsmoe/rasterize_cuda.h"

namespace dsmoe {
namespace cuda {

// Fills saved.num_instances, instances, tile_offsets and tile_order of the frame, and empties segment_queue.
template <class S> void bin_by_macro_tiles(const Frame<S>& frame, const Work& work);

}  // namespace cuda
}  // namespace dsmoe
