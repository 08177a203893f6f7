// Stage 2, the tile lists: in two steps, so that little is sorted, and each footprint is tested where its tiles are.
//
//   list    each Gaussian, in depth order, for the macro tiles of 64x64 pixels that its bounding box meets
//   sort    these entries by macro tile; one pass of a stable radix sort serves most images
//   test    for each entry, which of the macro tile's 8x8 squares of 8x8 pixels the footprint meets: 64 bits
//   give    each entry to the tiles of 16x16 pixels whose squares it meets, in order
//
// (HiGS, arXiv:2606.00352, sorts by macro tiles too, and has masks of small tiles.) An instance carries the bits of its
// tile's four squares, so that the warps of the walk do not test footprints again.
#include <limits>

#include "macro_kernels.cuh"
#include "macro_lists.h"

namespace dsmoe {
namespace cuda {
namespace {

// Number of blocks for a kernel whose blocks take piece after piece, at most `pieces`.
unsigned resident_blocks(int64_t pieces) {
  return static_cast<unsigned>(min(pieces, int64_t(kResidentBlocks) * num_multiprocessors()));
}

// The memory of a call. `capacity` is the room of each kind of list. Macro tiles seldom have the longer lists: only
// where many Gaussians meet a macro tile by their bounding box and not by their ellipse.
template <class Key> struct Room {
  template <class S>
  Room(const Frame<S>& frame, const Work& work)
      : scratch(*work.scratch),
        stream(work.stream),
        tiles(band_grid(frame)),
        grid(tiles),
        num_tiles(int64_t(tiles.columns) * tiles.rows),
        capacity(max<int64_t>(1, min<int64_t>(frame.saved.capacity, std::numeric_limits<uint32_t>::max()))),
        list_blocks(max<int64_t>(1, blocks_for(frame.inputs.num_gaussians, kListBlock * kListedPerLane))),
        offset_blocks(blocks_for(num_tiles + 1, kSortBlock)) {
    while (int64_t(1) << (passes * kMacroDigit<Key>) < grid.count()) ++passes;
    groups_of_pass = num_groups(capacity) * kMacroBins<Key>;
    const int64_t longs = (list_blocks + 1) + (offset_blocks + 1);
    const int64_t words = 2 * longs + passes * groups_of_pass + num_tiles + kLengthClasses;
    auto* zeros = reinterpret_cast<uint32_t*>(allocate<unsigned long long>(scratch, (words + 1) / 2));
    check(cudaMemsetAsync(zeros, 0, words * sizeof(*zeros), stream), "listing instances");
    list_states = reinterpret_cast<unsigned long long*>(zeros);
    offset_states = list_states + list_blocks + 1;
    groups = zeros + 2 * longs;
    tile_counts = groups + passes * groups_of_pass;
    longer = tile_counts + num_tiles;
    num_entries = allocate<int64_t>(scratch, 1);
  }

  Scratch& scratch;
  const cudaStream_t stream;
  const TileGrid tiles;  // of the band
  const MacroGrid grid;
  const int64_t num_tiles, capacity, list_blocks, offset_blocks;
  int passes = 1;          // of the sort
  int64_t groups_of_pass;  // their numbers
  // Zeroed, in one piece: the states of the look-backs, each followed by its counter, and the counts.
  unsigned long long *list_states, *offset_states;
  uint32_t *groups, *tile_counts, *longer;
  int64_t* num_entries;  // [1] written by the first kernel
};

// Entries by macro tile.
template <class Key> struct Entries {
  Key* keys;        // macro tiles
  int32_t* values;  // Gaussians
};

template <class Key, class S> Entries<Key> list(const Frame<S>& frame, const Room<Key>& room) {
  ListArguments<S, Key> list = {};
  list.saved = frame.saved;
  list.bounds = MacroBounds<S>(frame);
  list.look_back = {room.list_states, reinterpret_cast<unsigned*>(room.list_states + room.list_blocks)};
  list.capacity = room.capacity;
  list.num_entries = room.num_entries;
  list.keys = allocate<Key>(room.scratch, room.capacity);
  list.values = allocate<int32_t>(room.scratch, room.capacity);
  list_macro_tiles_kernel<<<static_cast<unsigned>(room.list_blocks), kListBlock, 0, room.stream>>>(list);
  DSMOE_CHECK_LAUNCH("list_macro_tiles");
  return {list.keys, list.values};
}

template <class Key> Entries<Key> sort(Entries<Key> listed, const Room<Key>& room) {
  Key* keys[2] = {allocate<Key>(room.scratch, room.capacity), listed.keys};
  int32_t* values[2] = {allocate<int32_t>(room.scratch, room.capacity), listed.values};
  RadixPass<Key> pass = {};
  pass.capacity = room.capacity;
  pass.count = room.num_entries;
  pass.strips = allocate<uint32_t>(room.scratch, num_strips(room.capacity) * kMacroBins<Key>);
  pass.keys = listed.keys;
  pass.values = listed.values;
  for (int p = 0; p < room.passes; ++p) {
    pass.sorted_keys = keys[p % 2];
    pass.sorted_values = values[p % 2];
    pass.groups = room.groups + p * room.groups_of_pass;
    pass.shift = p * kMacroDigit<Key>;
    launch_radix_pass<kMacroDigit<Key>>(pass, room.stream);
    pass.keys = pass.sorted_keys;
    pass.values = pass.sorted_values;
  }
  return {const_cast<Key*>(pass.keys), const_cast<int32_t*>(pass.values)};
}

template <class Key> const int64_t* find_offsets(const Key* keys, const Room<Key>& room) {
  MacroOffsetArguments<Key> offsets = {};
  offsets.entries = {room.num_entries, room.capacity};
  offsets.keys = keys;
  offsets.macros = room.grid.count();
  offsets.offsets = allocate<int64_t>(room.scratch, offsets.macros + 1);
  macro_offsets_kernel<<<blocks_for((offsets.macros + 1) * kWarp, kListBlock), kListBlock, 0, room.stream>>>(offsets);
  DSMOE_CHECK_LAUNCH("macro_offsets");
  return offsets.offsets;
}

template <class S, class Key>
TestArguments<S> test(const Frame<S>& frame, const Chunks& chunks, const int32_t* gaussians, unsigned blocks,
                      const Room<Key>& room) {
  TestArguments<S> test = {};
  test.chunks = chunks;
  test.gaussians = gaussians;
  test.saved = frame.saved;
  test.radii = frame.images.radii;
  test.mode = frame.config.blend.mode;
  test.image = TileGrid(frame.camera.width, frame.camera.height);
  test.tiles = room.tiles;
  test.macro_columns = room.grid.columns;
  test.tail_reach = frame.config.blend.tail_reach();
  test.squares = allocate<uint64_t>(room.scratch, room.capacity);
  test.near_first = frame.config.blend.blends_near_first();
  // Whether marks are by some of the pairs for which tiles are listed.
  const bool marks_some = has_tails(test.mode) || test.near_first;
  test.listed = marks_some ? allocate<uint64_t>(room.scratch, room.capacity) : nullptr;
  test.tile_counts = room.tile_counts;
  test_squares_kernel<<<blocks, kChunk, 0, room.stream>>>(test);
  DSMOE_CHECK_LAUNCH("test_squares");
  return test;
}

template <class S, class Key> void add_up_tiles(const SavedForward<S>& saved, const Room<Key>& room) {
  TileOffsetArguments add = {};
  add.tiles = room.num_tiles;
  add.counts = room.tile_counts;
  add.look_back = {room.offset_states, reinterpret_cast<unsigned*>(room.offset_states + room.offset_blocks)};
  add.entries = {room.num_entries, room.capacity};
  add.offsets = saved.tile_offsets;
  add.num_instances = saved.num_instances;
  add.longer = room.longer;
  add.segment_queue = saved.segment_queue;
  add_up_tiles_kernel<<<static_cast<unsigned>(room.offset_blocks), kSortBlock, 0, room.stream>>>(add);
  DSMOE_CHECK_LAUNCH("add_up_tiles");
}

template <class S, class Key>
void give(const Frame<S>& frame, const TestArguments<S>& test, unsigned blocks, const Room<Key>& room) {
  const SavedForward<S>& saved = frame.saved;
  GiveArguments give = {};
  give.chunks = test.chunks;
  give.gaussians = test.gaussians;
  give.squares = test.squares;
  give.listed = test.listed != nullptr ? test.listed : test.squares;
  give.tiles = room.tiles;
  give.macro_columns = room.grid.columns;
  give.tile_offsets = saved.tile_offsets;
  give.num_instances = saved.num_instances;
  give.capacity = saved.capacity;
  give.marked = marks_quarters(frame.inputs.num_gaussians);
  give.instances = saved.instances;
  give.next_of_class = room.longer;
  give.tile_order = saved.tile_order;
  give_to_tiles_kernel<<<blocks, kChunk, 0, room.stream>>>(give);
  DSMOE_CHECK_LAUNCH("give_to_tiles");
}

template <class Key, class S> void bin_by(const Frame<S>& frame, const Work& work) {
  const Room<Key> room(frame, work);
  const Entries<Key> entries = sort(list(frame, room), room);
  const int64_t* offsets = find_offsets(entries.keys, room);
  const int64_t most_chunks = room.capacity / kChunk + room.grid.count();
  const Chunks chunks = {offsets, room.grid.count(), allocate<uint32_t>(room.scratch, most_chunks * kTilesPerMacro)};
  const unsigned blocks = resident_blocks(most_chunks);
  const TestArguments<S> tested = test(frame, chunks, entries.values, blocks, room);
  add_up_tiles(frame.saved, room);
  give(frame, tested, blocks, room);
}

}  // namespace

template <class S> void count_macro_entries(const Frame<S>& frame, int64_t* num_entries, const Work& work) {
  const unsigned blocks = blocks_for(frame.inputs.num_gaussians, kListBlock);
  if (blocks == 0) return;
  count_macro_entries_kernel<S><<<blocks, kListBlock, 0, work.stream>>>(
      frame.saved, MacroBounds<S>(frame), reinterpret_cast<unsigned long long*>(num_entries));
  DSMOE_CHECK_LAUNCH("count_macro_entries");
}

template <class S> void bin_by_macro_tiles(const Frame<S>& frame, const Work& work) {
  const MacroGrid grid(band_grid(frame));
  grid.count() <= std::numeric_limits<uint16_t>::max() ? bin_by<uint16_t>(frame, work) : bin_by<uint32_t>(frame, work);
}

#define DSMOE_INSTANTIATE(S)                                                 \
  template void count_macro_entries(const Frame<S>&, int64_t*, const Work&); \
  template void bin_by_macro_tiles(const Frame<S>&, const Work&);
DSMOE_INSTANTIATE(float)
DSMOE_INSTANTIATE(double)
#undef DSMOE_INSTANTIATE

}  // namespace cuda
}  // namespace dsmoe
