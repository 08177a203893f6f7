// Numbers in files, whatever the byte order of the machine.
#pragma once

#include <algorithm>
#include <cstdint>
#include <cstring>
#include <string>

namespace dsmoe::io {

enum class ByteOrder { kLittleEndian, kBigEndian };

inline ByteOrder host_byte_order() {
  const std::uint16_t one = 1;
  unsigned char first = 0;
  std::memcpy(&first, &one, 1);
  return first == 1 ? ByteOrder::kLittleEndian : ByteOrder::kBigEndian;
}

template <typename T> T load(const char* bytes, ByteOrder order = ByteOrder::kLittleEndian) {
  char copy[sizeof(T)];
  std::memcpy(copy, bytes, sizeof(T));
  if (order != host_byte_order()) std::reverse(copy, copy + sizeof(T));
  T value;
  std::memcpy(&value, copy, sizeof(T));
  return value;
}

template <typename T> void append_little_endian(std::string& bytes, T value) {
  char copy[sizeof(T)];
  std::memcpy(copy, &value, sizeof(T));
  if (host_byte_order() != ByteOrder::kLittleEndian) std::reverse(copy, copy + sizeof(T));
  bytes.append(copy, sizeof(T));
}

}  // namespace dsmoe::io
