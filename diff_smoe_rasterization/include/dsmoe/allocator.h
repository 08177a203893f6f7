// The memory that a pass asks its caller for. The caller decides where it comes from: torch's tensors, a pool, a
// vector.
#pragma once

#include <cstddef>
#include <cstdint>
#include <new>
#include <type_traits>

#include "dsmoe/params.h"

namespace dsmoe {

// Memory for the duration of one call. The callee does not use it after the call has returned; on a GPU, after the work
// that the call has put on its stream.
class Scratch {
 public:
  // Returns `bytes` bytes at a multiple of 256, or null if there is no memory left.
  virtual void* allocate(size_t bytes) = 0;

 protected:
  ~Scratch() = default;
};

enum class NumberType { kFloat, kDouble, kInt32, kInt64 };

// One of the arrays that a forward pass leaves for the backward pass. `columns` numbers of type `type` make a row.
struct SavedArray {
  const char* name;
  NumberType type;
  int64_t rows;  // -1: not known
  int columns;

  size_t bytes() const {
    const bool wide = type == NumberType::kDouble || type == NumberType::kInt64;
    return static_cast<size_t>(rows) * columns * (wide ? 8 : 4);
  }
};

class Allocator : public Scratch {
 public:
  // Returns memory for array number `index` of those that `for_each_array` names, at a multiple of 256 bytes, or null
  // if there is no memory left. It must last until the backward pass has run, or until the caller knows that none
  // will. If an index is asked for again, the array before it is no longer used.
  virtual void* keep(int index, const SavedArray& array) = 0;

  // Says that the callee has done with all that `allocate` has given so far. Later work on the same stream may use it.
  virtual void release() = 0;

 protected:
  ~Allocator() = default;
};

// What an array's elements consist of.
template <class T> struct ElementOf { using Number = T; };
template <class S> struct ElementOf<ProjectedGaussian<S>> { using Number = S; };
template <> struct ElementOf<TileInstance> { using Number = int32_t; };

constexpr NumberType type_of(float) { return NumberType::kFloat; }
constexpr NumberType type_of(double) { return NumberType::kDouble; }
constexpr NumberType type_of(int32_t) { return NumberType::kInt32; }
constexpr NumberType type_of(int64_t) { return NumberType::kInt64; }

template <class T> SavedArray saved_array(const char* name, const T*, int64_t rows) {
  using Number = typename ElementOf<T>::Number;
  return {name, type_of(Number()), rows, static_cast<int>(sizeof(T) / sizeof(Number))};  // NOLINT: T may be a struct
}

// Asks for memory for each saved array that has none yet and whose length is known. Throws std::bad_alloc.
template <class Saved, class Sizes> void allocate_saved(Saved& saved, const Sizes& sizes, Allocator& memory) {
  int next = 0;
  for_each_array(saved, sizes, [&](const char* name, auto*& pointer, int64_t rows) {
    const int index = next++;
    if (rows < 0 || pointer != nullptr) return;
    void* bytes = memory.keep(index, saved_array(name, pointer, rows));
    if (bytes == nullptr && rows > 0) throw std::bad_alloc();
    pointer = static_cast<std::remove_reference_t<decltype(pointer)>>(bytes);
  });
}

}  // namespace dsmoe
