// Numbers in files, and cursors over the bytes of a file: they check every step and name file and place in every error.
#pragma once

#include <algorithm>
#include <cstddef>
#include <cstdint>
#include <cstring>
#include <string>
#include <string_view>

#include "io/file.h"

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

/// Returns text as it may stand in a message: quoted, cut before a character that ends after `longest` bytes. Control
/// characters, and bytes that are not UTF-8, are \xNN.
std::string printable(std::string_view text, std::size_t longest = 60);

/// Parses the whole of `text`, in the C locale whatever the program's. False if it is not a number or out of
/// range.
bool parse_number(std::string_view text, double& value);
bool parse_whole(std::string_view text, std::uint64_t& value);

/// Returns the shortest decimal text that reads back as the same double.
std::string shortest_text(double value);

/// Walks binary data. No count is trusted before the bytes that it announces are known to be there.
class ByteCursor {
 public:
  ByteCursor(std::string_view bytes, std::string file, std::size_t offset = 0)
      : bytes_(bytes), file_(std::move(file)), offset_(offset) {}

  std::size_t offset() const { return offset_; }
  std::size_t remaining() const { return bytes_.size() - offset_; }

  template <typename T> T read(const char* what, ByteOrder order = ByteOrder::kLittleEndian) {
    return load<T>(take(1, sizeof(T), what), order);
  }

  /// Reads a 64-bit count of records of at least `record_bytes` each, and checks that so many can follow.
  std::uint64_t read_count(const char* what, std::size_t record_bytes);

  /// Steps over `count` records and returns where they begin.
  const char* take(std::uint64_t count, std::size_t record_bytes, const char* what);

  /// Throws if bytes are left: then a count was wrong, and what was read is not what was written.
  void end_of_data(const char* what) const;

  /// Reads up to a NUL, which is stepped over and not returned.
  std::string_view read_c_string(const char* what);

  [[noreturn]] void fail(const std::string& what, const std::string& reason) const;

 private:
  std::string_view bytes_;
  std::string file_;
  std::size_t offset_;
};

/// Walks text line by line, and each line field by field (separated by blanks).
class LineCursor {
 public:
  LineCursor(std::string_view text, std::string file) : text_(text), file_(std::move(file)) {}

  /// Moves to the next line; false at the end of the text. A line ends with \n or \r\n.
  bool next_line();
  /// Moves to the next line that is neither blank nor begins with '#'.
  bool next_content_line();

  /// The current line's number, from 1 on.
  std::size_t line_number() const { return line_number_; }

  /// Byte offset of the line after this one.
  std::size_t next_offset() const { return next_; }

  bool has_field();
  std::string_view field(const char* what);
  double number(const char* what);
  /// A whole number from 0 to `maximum`.
  std::uint64_t whole(const char* what, std::uint64_t maximum = UINT64_MAX);
  /// All that is left of the line, without the blanks around it.
  std::string_view rest();
  /// Throws if the line has a further field.
  void end_of_line(const char* what);

  [[noreturn]] void fail(const std::string& what, const std::string& reason) const;

 private:
  std::string_view text_;
  std::string file_;
  std::string_view line_;
  std::size_t next_ = 0;
  std::size_t line_number_ = 0;
};

}  // namespace dsmoe::io
