// Renderings with more tile instances than are listed at once are made in bands: rows of tiles whose instances fit. A
// pass over such a rendering lists one band, walks it, and lists the next one in the same memory.
#pragma once

#include <algorithm>
#include <stdexcept>
#include <vector>

#include "check.h"
#include "dsmoe/rasterize_cuda.h"
#include "scratch.h"

namespace dsmoe {
namespace cuda {

// The tiles of the rows that the frame's lists are of.
template <class S> TileGrid band_grid(const Frame<S>& frame) {
  TileGrid grid(frame.camera.width, frame.camera.height);
  grid.rows = std::min(frame.saved.band.end, grid.rows) - frame.saved.band.begin;
  return grid;
}
template <class S> int64_t num_band_tiles(const Frame<S>& frame) {
  return band_tiles(TileGrid(frame.camera.width, frame.camera.height), frame.saved.band);
}

// Scratch memory that is used again and again, by callers who ask for like blocks in the same order.
class ReusedScratch final : public Scratch {
 public:
  explicit ReusedScratch(Scratch& from) : from_(from) {}

  void* allocate(size_t bytes) override {
    if (next_ == blocks_.size()) blocks_.push_back({});
    Block& block = blocks_[next_++];
    if (block.bytes < bytes) block = {from_.allocate(bytes), bytes};
    return block.memory;
  }

  // What was given so far may be given again.
  void rewind() { next_ = 0; }

 private:
  struct Block {
    void* memory = nullptr;
    size_t bytes = 0;
  };

  Scratch& from_;
  std::vector<Block> blocks_;
  size_t next_ = 0;
};

// Cuts the image into bands of at most config.most_instances; a single row may have more. Waits for the counts.
template <class S>
std::vector<TileBand> cut_into_bands(const Frame<S>& frame, ReusedScratch& scratch, const Work& work) {
  const int64_t most = frame.config.most_instances;
  Frame<S> part = frame;
  std::vector<TileBand> bands;
  std::vector<TileBand> left = {{0, TileGrid(frame.camera.width, frame.camera.height).rows}};  // the next one last
  while (!left.empty()) {
    part.saved.band = left.back();
    left.pop_back();
    const TileBand& rows = part.saved.band;
    scratch.rewind();
    part.saved.num_instances = allocate<int64_t>(scratch, 1);
    Work counting = work;
    counting.scratch = &scratch;
    count_instances(part, counting);
    const int64_t count = read(part.saved.num_instances, "counting tile instances", work.stream);
    const int64_t wanted = (count + most - 1) / most, height = rows.end - rows.begin;
    const int parts = static_cast<int>(std::min(wanted, height));
    if (parts <= 1) {
      bands.push_back(rows);
      continue;
    }
    for (int i = parts - 1; i >= 0; --i) {
      left.push_back(
          {static_cast<int>(rows.begin + height * i / parts), static_cast<int>(rows.begin + height * (i + 1) / parts)});
    }
  }
  return bands;
}

// Calls visit(frame) if the frame has lists. Else it makes the lists of one band after the other, and calls visit
// with a frame for each, from top to bottom.
template <class S, class Visit> void for_each_band(const Frame<S>& frame, const Work& work, Visit visit) {
  if (frame.saved.capacity > 0) return visit(frame);
  if (is_capturing(work.stream)) {  // nothing can be counted then
    throw std::runtime_error(
        "rasterize: this rendering has more tile instances than are listed at once, so its lists "
        "are made in bands, which a graph cannot capture; capture its forward pass too");
  }
  ReusedScratch scratch(*work.scratch);
  const auto bands = cut_into_bands(frame, scratch, work);
  Frame<S> part = frame;
  part.saved.segments = nullptr, part.saved.segment_queue = nullptr;
  // The same for all bands, so that all want the same memory. It serves the lists of macro tiles too.
  part.saved.capacity = frame.config.most_instances;
  Work listing = work;
  listing.scratch = &scratch;
  for (const TileBand& band : bands) {
    scratch.rewind();
    part.saved.band = band;
    const int64_t tiles = num_band_tiles(part);
    part.saved.tile_offsets = allocate<int64_t>(scratch, tiles + 2);
    part.saved.num_instances = part.saved.tile_offsets + tiles + 1;
    part.saved.tile_order = allocate<int32_t>(scratch, tiles);
    part.saved.instances = allocate<int32_t>(scratch, part.saved.capacity);
    bin(part, listing);
    visit(part);
  }
}

}  // namespace cuda
}  // namespace dsmoe
