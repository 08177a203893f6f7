// Sizes that decide how fast the kernels are, each with its reason. Results depend on them only through the order in
// which numbers are added. Sizes that decide how memory is laid out are elsewhere: kTileSize in constants.h;
// kSegmentLength in rasterize_cuda.h; kBoxPoints in neighbors.h.
#pragma once

#include "device.cuh"

namespace dsmoe {
namespace cuda {

// A warp that takes up to 32 rows takes fewer if a multiprocessor would get fewer warps than this. It is half of the 64
// that it can hold, enough to hide the latency of loads.
constexpr int kEnoughWarpsPerMultiprocessor = 32;

// How many rows a warp takes: 32, 16, ... or `least`.
inline int rows_per_warp(int64_t rows, int least) {
  const int64_t enough = int64_t(kEnoughWarpsPerMultiprocessor) * num_multiprocessors();
  int count = kWarp;
  while (count > least && rows < enough * count) count /= 2;
  return count;
}

// The tile walk.
//
// A warp's square of pixels, each way. Half a tile: a footprint is tested against few pixels, so that most pairs that
// are evaluated count, and two pixels a lane share the terms in x.
constexpr int kWarpTile = 8;
constexpr int kWarpsPerTile = (kTileSize / kWarpTile) * (kTileSize / kWarpTile);
constexpr int kWalkBlock = kWarpsPerTile * kWarp;           // threads: a tile, or half of one with a long list
constexpr int kLanePixels = kWarpTile * kWarpTile / kWarp;  // one below the other
constexpr int kLaneStep = kWarpTile / kLanePixels;          // rows between them

// Features that come along with an entry: as many floats as one vector load takes.
constexpr int kFeatureChunk = 4;

// Entries of a list that a lane reads ahead. Together the lanes find enough in 96 of them for about one batch of 32.
constexpr int kReadAhead = 3;
// Entries that a warp has found and not taken: up to 31, and all that it finds next.
constexpr int kFoundEntries = 128;
static_assert(kFoundEntries >= kWarp - 1 + kReadAhead * kWarp, "the ring holds what was found");
// Visits between two questions whether all pixels are full, or between two batches of sums by tensor cores.
constexpr int kVisitsPerCheck = 8;

// Visits of the forward walk that are interleaved: what one waits for, the next one hides. And blocks of it that one
// multiprocessor holds at once, where the number of features is known: 6 x 128 threads leave each thread 80 registers,
// all that two visits ask for. Four visits at 96 registers take as long, one at 72 takes 1.06 times that.
constexpr int kBlendUnroll = 2;
constexpr int kBlendBlocks = 6;

// In the forward walk two warps share a square of pixels if the list is longer than this: a few long lists must not
// decide how long the pass takes. Only so many tiles are looked at, the first ones in the order of lengths (below).
// A lane then has one pixel, and registers for more visits that are interleaved.
constexpr int kSharedFrom = 1024;
constexpr unsigned kMostSharedTiles = 128;
constexpr int kSharedBlendUnroll = 4;

// Visits of the backward walk that are interleaved, where it sums by tensor cores.
constexpr int kBackwardUnroll = 2;
// Blocks of the backward walk that one multiprocessor holds at once, where the number of features is known: 5 x 128
// threads leave each thread 96 registers, nearly all that the kernel asks for.
constexpr int kBackwardBlocks = 5;
// The general kernels: as many registers as they need.
constexpr int kGeneralWalkBlocks = 1;

// Sums by tensor cores: how many Gaussians one warp sums together. They fill the 16 rows of an operand, eight rows for
// the upper parts of their numbers and eight for the lower ones.
constexpr int kTensorBatch = 8;
static_assert(kTensorBatch == kVisitsPerCheck, "the walk says where a batch ends");

// Lists of instances.
//
// Threads a block. Large blocks, because the look-back goes from block to block.
constexpr int kListBlock = 256;
constexpr int kListWarps = kListBlock / kWarp;

// Sorts by radix, and the lists of macro tiles.
//
// Threads a block: one for each digit of 8 bits.
constexpr int kSortBlock = 256;
// Pairs that a thread places at a time: as many as keys and values of a block fit 48 KiB.
constexpr int kSortItemsOfFloats = 16;
// Strips, a block each, that one multiprocessor sorts at once. More of them would wait less, but each block adds up the
// strips before it: the sums of all groups, and the strips of its own. With 132 multiprocessors these are 17 rows and
// up to 15, each read at once; with more than 144 the sums take two turns.
constexpr unsigned kStripsPerMultiprocessor = 2, kStripsPerGroup = 16, kRowsAtOnce = 18;
// Copies of a strip's counts in shared memory. Depths share their upper digits, so that many lanes would count at one
// place. And keys that a lane reads at once.
constexpr int kDigitCopies = 8, kKeysAtOnce = 8;
// Bits of a depth that one pass sorts, and of a macro tile with 16 or 32 bits. With 9 bits one pass serves images up to
// 2048x1024; more bits, or longer keys with as many, would not fit 48 KiB.
constexpr int kDepthDigit = 8;
constexpr int kShortMacroDigit = 9, kLongMacroDigit = 8;
// Gaussians that a lane lists in macro tiles: blocks of 1,024 Gaussians look back seldom.
constexpr int kListedPerLane = 4;
// Entries of a macro tile that one block gives to its tiles.
constexpr int kChunk = 256;
// Tiles are walked in the order of their lists' lengths, the longest ones first, so that the last warps to end are
// those of short lists. It is an order by classes of so many instances; the last class has all that are longer.
constexpr int kLengthClass = 64, kLengthClasses = 64;
// Blocks a multiprocessor of kernels whose blocks take piece after piece: more of them fit none.
constexpr int kResidentBlocks = 8;

// The projection and its backward pass.
//
// Threads a block, one Gaussian each. Each thread needs some 200 bytes of shared memory for its row of SH coefficients.
// Small blocks waste less of a multiprocessor's shared memory and registers, which then hold more warps.
constexpr int kRowsBlock = 128;
// Blocks of the backward projection that one multiprocessor holds at once, in the common case: 5 x 128 threads leave
// each thread 96 registers. With the camera's gradient, 35 more sums a thread would not fit them: the compiler decides.
constexpr int kRowsBackwardBlocks = 5;
constexpr int kCameraBackwardBlocks = 1;
// With a rolling shutter 96 registers would spill some 300 bytes: 3 x 128 threads leave each thread 168.
constexpr int kShutterBackwardBlocks = 3;
// The same over the views of a batch, where the sums of 48 SH gradients stay in registers, but for some that spill:
// 3 x 128 threads leave each thread 168.
constexpr int kViewsBackwardBlocks = 3;

// Kernels whose threads do the same small work, one item each.
//
// Threads a block. 256 divides the threads that a multiprocessor holds, whatever the card (1024, 1536 or 2048).
constexpr int kStoreBlock = 256;
// Threads of the block that sums one column of a matrix. A power of two, because the sum halves their number.
constexpr int kColumnBlock = 256;

// Adam.
//
constexpr int kAdamBlock = 256;    // threads, as kStoreBlock
constexpr int kAdamPerThread = 4;  // numbers, a block apart, so that the loads of all four are in flight together
constexpr int kAdamMaxTensors =
    16;  // of one launch: more than a trainer has, in 1 of the 4 KiB for a kernel's arguments

// L1 and SSIM.
//
constexpr int kLossBlock = 256;  // threads: four pixels of a tile each in float, two in double
// Neighbours that a thread computes along a window, from numbers that it reads once: 14 in place of 44.
constexpr int kLossRun = 4;
// The pixels of a tile. Its maps, with the reach of the windows around it, must fit the 48 KiB of shared memory that
// every card gives a block. Double has room for half as many pixels.
constexpr int kLossTileHeight = 32;
template <class S> constexpr int kLossTileWidth = sizeof(S) == 4 ? 32 : 16;
constexpr int kLossSumBlock = 512;  // threads of the one block that adds up the tiles: more of them wait less often

// Neighbours.
//
constexpr int kSearchBlock =
    256;  // threads, a point each. They are the points of one box, and leave out the same boxes

}  // namespace cuda
}  // namespace dsmoe
