// Sums whose terms have a place each, so that they are added in the same order every time.
#pragma once

#include "reduce.cuh"

namespace dsmoe {
namespace cuda {

// A slot for each instance and each quarter of its tile. A Gaussian's instances have neighbouring slots
// (SavedForward::slot_ranges).
template <class S> struct Slots {
  S* terms;          // [capacity, kSlotsPerInstance, length]; null: there are none
  uint8_t* written;  // [capacity, kSlotsPerInstance] whether the slot's terms were written; zero before
};

template <class S> struct SlotSums {
  int64_t num_gaussians;  // N
  int length;             // numbers a record
  SavedForward<S> saved;  // says which slots are whose
  const int32_t* radii;   // [N] pixels; 0 where no record is wanted
  Slots<S> slots;         // read
  S* records;             // [N, length] written where there is a radius
};

// Where the instances outgrew their memory there is nothing to sum, and nothing is written.
//
// A warp sums the records of 32 Gaussians, one after the other. The lanes take `rows` slots at a time, a lane one
// number of a slot, in double; so neighbouring lanes read neighbouring numbers.
template <class S>
__global__ void __launch_bounds__(kStoreBlock) sum_slots_kernel(const __grid_constant__ SlotSums<S> arguments) {
  if (overflows(arguments.saved)) return;
  const int64_t i = int64_t(blockIdx.x) * kStoreBlock + threadIdx.x;
  const int lane = threadIdx.x % kWarp, length = arguments.length;
  const bool seen = i < arguments.num_gaussians && arguments.radii[i] > 0;
  int64_t begin = 0, end = 0;
  if (seen) {
    begin = arguments.saved.slot_ranges[2 * i] * kSlotsPerInstance;
    end = arguments.saved.slot_ranges[2 * i + 1] * kSlotsPerInstance;
  }
  const int columns = min(length, kWarp), rows = kWarp / columns;  // numbers and slots that are read at once
  const int row = lane / columns, column = lane % columns;
  for (unsigned left = __ballot_sync(kAllLanes, seen); left != 0; left &= left - 1) {
    const int owner = __ffs(left) - 1;
    const int64_t owner_begin = __shfl_sync(kAllLanes, begin, owner), owner_end = __shfl_sync(kAllLanes, end, owner);
    S* record = arguments.records + (i - lane + owner) * length;
    for (int first = 0; first < length; first += columns) {
      const int number = first + column;
      const bool takes = row < rows && number < length;
      double part = 0;
#pragma unroll 4
      for (int64_t slot = owner_begin + row; slot < owner_end; slot += rows) {
        if (takes && arguments.slots.written[slot]) part += double(arguments.slots.terms[slot * length + number]);
      }
      double sum = 0;
      for (int r = 0; r < rows; ++r) sum += __shfl_sync(kAllLanes, part, r * columns + column);
      if (takes && row == 0) record[number] = static_cast<S>(sum);
    }
  }
}

template <class S> void sum_slots(const SlotSums<S>& arguments, cudaStream_t stream) {
  if (arguments.num_gaussians == 0) return;
  sum_slots_kernel<<<blocks_for(arguments.num_gaussians, kStoreBlock), kStoreBlock, 0, stream>>>(arguments);
  DSMOE_CHECK_LAUNCH("sum_slots");
}

}  // namespace cuda
}  // namespace dsmoe
