// Sizes that decide how fast the kernels are, each with its reason. No result depends on them but for the order in
// which numbers are added. What the layout of saved memory depends on (kTileSize, kSegmentLength, kSlotsPerInstance)
// is in constants.h and rasterize_cuda.h.
#pragma once

#include "device.cuh"

namespace dsmoe {
namespace cuda {

// The tile walk.
//
// A warp's square of pixels, each way. Half a tile: a footprint is tested against few pixels, so that most pairs that
// are evaluated count, and two pixels a lane share the terms in x.
constexpr int kWarpTile = 8;
constexpr int kWarpsPerTile = (kTileSize / kWarpTile) * (kTileSize / kWarpTile);
constexpr int kWalkBlock = kWarpsPerTile * kWarp;           // threads: one block a tile
constexpr int kLanePixels = kWarpTile * kWarpTile / kWarp;  // one below the other
constexpr int kLaneStep = kWarpTile / kLanePixels;          // rows between them
static_assert(kWarpsPerTile == kSlotsPerInstance, "each quarter of a tile has its slot");

// Features that come along with an entry: as many floats as one vector load takes.
constexpr int kFeatureChunk = 4;

// Blocks of the backward walk that one multiprocessor holds at once, where the number of features is known: 5 x 128
// threads leave each thread 96 registers, nearly all that the kernel asks for. The general kernel takes what it needs.
constexpr int kBackwardBlocks = 5;
constexpr int kGeneralBackwardBlocks = 1;

// Sums by tensor cores: Gaussians that one warp sums together. They fill the 16 rows of an operand, eight rows for
// dL/dpower and eight for the weights.
constexpr int kTensorBatch = 8;

// Lists of instances.
//
// Threads a block. Large blocks, because the look-back goes from block to block.
constexpr int kListBlock = 256;
constexpr int kListWarps = kListBlock / kWarp;
// Rows of tiles of a warp that are kept in shared memory between counting and listing: three for each of 32 Gaussians.
// Rows beyond them are found again.
constexpr int kKeptRows = 96;
// A warp takes up to 32 Gaussians, and fewer where a multiprocessor would get less than this many warps: half of the 64
// that it can hold, enough to hide the latency of loads.
constexpr int kEnoughWarpsPerMultiprocessor = 32;

// Threads a block of a kernel that writes one number a thread.
constexpr int kStoreBlock = 256;

// Threads of the block that sums one column of a matrix.
constexpr int kColumnBlock = 256;

}  // namespace cuda
}  // namespace dsmoe
