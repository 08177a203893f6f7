// Long lists in the forward pass. In an image with few tiles the warps with the longest list would decide how long the
// blend takes. So a list that is longer than its share is blended in segments, by several warps at once. With A and B
// two parts of a list, one behind the other, and T_A the transmittance of A alone, the sums compose exactly:
//
//   T = T_A T_B,   S = S_A + T_A S_B,   W = W_A + T_A W_B
//
// But a pixel stops at one pair, and a segment that does not know the T in front of it cannot tell which. Hence:
//
//   transmit  each segment's T alone, all segments at once
//   blend     each segment from the T in front of it, with the cuts and the stop of a whole walk. The last warp that
//             is done with its segment appends them to one another, in their order
//
// The result depends on the lists, and not on when which warp runs. Segments are as long as those of the backward pass.
#pragma once

#include "dsmoe/blend.h"
#include "segments.cuh"

namespace dsmoe {
namespace cuda {

// What a lane's pixel has blended so far.
template <class S, int kSums> struct BlendedPixel {
  PixelState<S> state;
  S sums[kSums];  // of weighted features
  int32_t last;   // entries of the list that the numerator has seen
};

// What a warp of the forward pass walks: a segment of a tile's list or, where it has no segments, all of it.
struct ListPart {
  int tile, segment, segments;
};

// The segments of the long lists of a rendering, those of one list side by side and in order.
template <class S> struct LongLists {
  int rows;                                // segments there is room for; 0: no list is long
  int* count;                              // [1] segments there are; where they have no room, no list is long
  ListPart* parts;                         // [rows]
  int* arrivals;                           // [rows, quarters] in a list's first row, how many warps are done
  S* transmittances;                       // [rows, pixels of a tile] each segment's T alone
  BlendedPixel<S, kFastFeatures>* blends;  // [rows, pixels of a tile] each segment's, from the T in front of it

  __device__ int num_segments() const { return rows > 0 && *count <= rows ? *count : 0; }

  static __device__ int64_t at(int row, const WarpTile<S>& tile, int k) {
    return int64_t(row) * (kTileSize * kTileSize) + (tile.quarter * kLanePixels + k) * kWarp + tile.lane;
  }
};

// Whether a tile's list has more than its share of all instances, and enough for three segments.
template <class S> __device__ bool is_long(const SavedForward<S>& saved, int64_t length) {
  return length > max<int64_t>(2 * kSegmentLength, *saved.num_instances / kListShares);
}

// The part of a list that a warp of the blend walks. The first blocks have a tile each, the others a segment. Returns
// tile -1 where there is nothing to walk.
template <class S>
__device__ ListPart part_of_block(const SavedForward<S>& saved, const LongLists<S>& lists, int tiles) {
  const int tile = blockIdx.x, row = tile - tiles, segments = lists.num_segments();
  if (row >= 0) return row < segments ? lists.parts[row] : ListPart{-1, 0, 0};
  const bool split = segments > 0 && is_long(saved, saved.tile_offsets[tile + 1] - saved.tile_offsets[tile]);
  return {split ? -1 : tile, 0, 0};
}

template <class S> struct LongListArguments {
  SavedForward<S> saved;  // tile_offsets and num_instances are read
  int tiles;
  LongLists<S> lists;  // written
};

// One block.
template <class S>
__global__ void __launch_bounds__(kLongListBlock)
    find_long_lists_kernel(const __grid_constant__ LongListArguments<S> arguments) {
  __shared__ int count;
  const SavedForward<S>& saved = arguments.saved;
  const LongLists<S>& lists = arguments.lists;
  if (threadIdx.x == 0) count = 0;
  __syncthreads();
  for (int tile = threadIdx.x; tile < arguments.tiles && !overflows(saved); tile += kLongListBlock) {
    const int64_t length = saved.tile_offsets[tile + 1] - saved.tile_offsets[tile];
    if (!is_long(saved, length)) continue;
    const int segments = static_cast<int>((length + kSegmentLength - 1) / kSegmentLength);
    const int row = atomicAdd(&count, segments);
    if (row + segments > lists.rows) continue;
    for (int s = 0; s < segments; ++s) lists.parts[row + s] = {tile, s, segments};
    for (int quarter = 0; quarter < kWarpsPerTile; ++quarter) lists.arrivals[row * kWarpsPerTile + quarter] = 0;
  }
  __syncthreads();
  if (threadIdx.x == 0) *lists.count = count;
  if (saved.segment_queue == nullptr || count > lists.rows) return;
  // The four quarters of a segment stand side by side: the backward pass gives them to one block.
  for (int row = threadIdx.x; row < count; row += kLongListBlock) {
    const ListPart part = lists.parts[row];
    if (part.segment == 0) continue;  // the backward pass walks it without being told
    int2* entries = segment_queue(saved).entries;
    const int first = 1 + atomicAdd(&entries[0].x, kWarpsPerTile);
    for (int quarter = 0; quarter < kWarpsPerTile; ++quarter) {
      entries[first + quarter] = make_int2(part.tile * kWarpsPerTile + quarter, part.segment);
    }
  }
}

// Finds the long lists of the frame. Lists of more than kMostSegments in all are not long: that bounds the memory.
template <class S> LongLists<S> find_long_lists(const Frame<S>& frame, const Work& work) {
  constexpr int kPixels = kTileSize * kTileSize;
  Scratch& scratch = *work.scratch;
  LongLists<S> lists = {};
  // A list of three segments is longer than two of them.
  lists.rows = static_cast<int>(min<int64_t>(kMostSegments, frame.saved.capacity * 3 / (2 * kSegmentLength)));
  if (lists.rows == 0) return lists;
  lists.count = allocate<int>(scratch, 1);
  lists.parts = allocate<ListPart>(scratch, lists.rows);
  lists.arrivals = allocate<int>(scratch, lists.rows * kWarpsPerTile);
  lists.transmittances = allocate<S>(scratch, int64_t(lists.rows) * kPixels);
  lists.blends = allocate<BlendedPixel<S, kFastFeatures>>(scratch, int64_t(lists.rows) * kPixels);
  find_long_lists_kernel<S>
      <<<1, kLongListBlock, 0, work.stream>>>({frame.saved, static_cast<int>(num_band_tiles(frame)), lists});
  DSMOE_CHECK_LAUNCH("find_long_lists");
  return lists;
}

// Multiplies up T over a part of a list.
template <class S, BlendMode kMode> struct TransmitVisitor {
  static constexpr bool kBackToFront = false, kStopsEarly = true;  // behind a full pixel nobody asks for T
  static constexpr bool kReadsFeatures = false, kInSegments = false;
  static constexpr int kUnroll = kTransmitUnroll;

  __device__ __forceinline__ void begin_batch(int32_t) {}

  __device__ __forceinline__ void visit(const StagedGaussian<S, false>& staged) {
    const auto gaussian = staged;
    const ColumnExponent<S, S> exponent(gaussian.conic, S(tile.x) - gaussian.mean.x);
    const S dy = S(tile.y) - gaussian.mean.y, least_alpha = cut.of(gaussian.opacity);
#pragma unroll
    for (int k = 0; k < kLanePixels; ++k) {
      const auto gate = evaluate_gate<kMode>(exponent.at(below(dy, k)), gaussian.opacity, least_alpha);
      transmittance[k] = gate.counts ? transmittance[k] * (S(1) - gate.alpha) : transmittance[k];
    }
  }

  __device__ __forceinline__ bool is_done() const {
    bool open = false;
    for (int k = 0; k < kLanePixels; ++k) open |= transmittance[k] >= S(kTransmittanceCut);
    return !__any_sync(kAllLanes, open);
  }

  const BlendArguments<S>& arguments;
  const WarpTile<S>& tile;
  AlphaCut<S> cut;
  S (&transmittance)[kLanePixels];
};

}  // namespace cuda
}  // namespace dsmoe
