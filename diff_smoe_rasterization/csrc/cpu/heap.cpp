#include <new>

#include "dsmoe/rasterize.h"

namespace dsmoe {
namespace cpu {
namespace {

constexpr std::align_val_t kAlignment{256};  // as Scratch promises

}  // namespace

Heap::~Heap() {
  for (void* block : blocks_) ::operator delete(block, kAlignment);
}

void* Heap::allocate(size_t bytes) {
  blocks_.reserve(blocks_.size() + 1);  // so that no block is lost
  blocks_.push_back(::operator new(bytes, kAlignment));
  return blocks_.back();
}

void* Heap::keep(int, const SavedArray& array) { return allocate(array.bytes()); }

void Heap::release() {}

}  // namespace cpu
}  // namespace dsmoe
