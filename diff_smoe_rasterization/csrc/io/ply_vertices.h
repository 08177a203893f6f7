// The `vertex` element of any PLY file as named columns, and the header of the PLY files that this project writes.
// Format: Greg Turk, "The PLY Polygon File Format", 1994.
#pragma once

#include <cstddef>
#include <string>
#include <string_view>
#include <vector>

#include "io/cursor.h"

namespace dsmoe::io {

enum class PlyType { kInt8, kUint8, kInt16, kUint16, kInt32, kUint32, kFloat32, kFloat64 };

struct PlyProperty {
  std::string name;
  PlyType type;
  std::size_t offset;  // bytes from the beginning of a row
};

/// Rows of scalar properties. Other elements and list properties are stepped over; elements after `vertex` are not
/// read.
class PlyVertices {
 public:
  /// Reads a file: ascii, binary little endian or binary big endian. Throws FileError, FormatError.
  static PlyVertices read(const std::string& path);

  /// The same from the bytes of a file; `file` names them in errors. Memory stays within some multiples of the bytes.
  static PlyVertices parse(std::string bytes, const std::string& file);

  std::size_t count() const { return count_; }
  const std::vector<PlyProperty>& properties() const { return properties_; }

  /// The text of the header's `comment` lines, in their order.
  const std::vector<std::string>& comments() const { return comments_; }

  /// The number of each of these lines in the file, from 1 on.
  const std::vector<std::size_t>& comment_lines() const { return comment_lines_; }

  /// Returns the column of that name, or null.
  const PlyProperty* find(std::string_view name) const;

  /// Returns the column of that name. Throws FormatError naming it and those that there are.
  const PlyProperty& require(std::string_view name) const;

  double value(std::size_t row, const PlyProperty& property) const;

  [[noreturn]] void fail(const std::string& reason) const;

 private:
  std::string file_;
  std::size_t count_ = 0;
  std::vector<PlyProperty> properties_;
  std::vector<std::string> comments_;
  std::vector<std::size_t> comment_lines_;
  std::string bytes_;          // holds the rows
  std::size_t first_row_ = 0;  // byte offset in bytes_
  std::size_t stride_ = 0;     // bytes from row to row
  ByteOrder order_ = ByteOrder::kLittleEndian;
};

struct PlyColumn {
  std::string name;
  PlyType type;
};

/// Returns the header of a binary little endian file with one `vertex` element.
/// Throws FormatError, naming `file`, for a comment that is not one line.
std::string ply_header(const std::string& file, std::size_t count, const std::vector<PlyColumn>& columns,
                       const std::vector<std::string>& comments);

}  // namespace dsmoe::io
