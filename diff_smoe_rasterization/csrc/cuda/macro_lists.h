// The tile lists, by macro tiles.
#pragma once

#include "dsmoe/rasterize_cuda.h"

namespace dsmoe {
namespace cuda {

// Adds to num_entries [1] how many entries the lists of macro tiles will have. They need room as the instances do.
template <class S> void count_macro_entries(const Frame<S>& frame, int64_t* num_entries, const Work& work);

// Fills saved.num_instances, instances, tile_offsets and tile_order of the frame, and empties segment_queue.
template <class S> void bin_by_macro_tiles(const Frame<S>& frame, const Work& work);

}  // namespace cuda
}  // namespace dsmoe
