#include "io/ply_vertices.h"

#include <algorithm>
#include <cmath>
#include <limits>
#include <optional>
#include <unordered_set>
#include <utility>

#include "io/cursor.h"

namespace dsmoe::io {

namespace {

struct TypeName {
  std::string_view name;
  PlyType type;
};

// The names of 1994 and those with sizes, both in use.
constexpr TypeName kTypeNames[] = {
    {"char", PlyType::kInt8},      {"uchar", PlyType::kUint8},    {"short", PlyType::kInt16},
    {"ushort", PlyType::kUint16},  {"int", PlyType::kInt32},      {"uint", PlyType::kUint32},
    {"float", PlyType::kFloat32},  {"double", PlyType::kFloat64}, {"int8", PlyType::kInt8},
    {"uint8", PlyType::kUint8},    {"int16", PlyType::kInt16},    {"uint16", PlyType::kUint16},
    {"int32", PlyType::kInt32},    {"uint32", PlyType::kUint32},  {"float32", PlyType::kFloat32},
    {"float64", PlyType::kFloat64}};

/// Calls `function` with a value of the C++ type that `type` stands for.
template <typename Function> auto with_type(PlyType type, Function function) {
  switch (type) {
    case PlyType::kInt8:
      return function(std::int8_t{});
    case PlyType::kUint8:
      return function(std::uint8_t{});
    case PlyType::kInt16:
      return function(std::int16_t{});
    case PlyType::kUint16:
      return function(std::uint16_t{});
    case PlyType::kInt32:
      return function(std::int32_t{});
    case PlyType::kUint32:
      return function(std::uint32_t{});
    case PlyType::kFloat32:
      return function(float{});
    default:
      return function(double{});
  }
}

std::size_t size_of(PlyType type) {
  return with_type(type, [](auto zero) { return sizeof(zero); });
}

double load_as_double(const char* bytes, PlyType type, ByteOrder order) {
  return with_type(type, [&](auto zero) { return static_cast<double>(load<decltype(zero)>(bytes, order)); });
}

bool is_float(PlyType type) { return type == PlyType::kFloat32 || type == PlyType::kFloat64; }

struct HeaderProperty {
  std::string name;
  PlyType type;                       // of the value, or of the items of a list
  std::optional<PlyType> count_type;  // of the length of a list
};

struct HeaderElement {
  std::string name;
  std::uint64_t count = 0;
  std::vector<HeaderProperty> properties;

  bool has_lists() const {
    return std::any_of(properties.begin(), properties.end(),
                       [](const HeaderProperty& p) { return p.count_type.has_value(); });
  }
};

enum class PlyFormat { kAscii, kLittleEndian, kBigEndian };

struct Header {
  std::optional<PlyFormat> format;
  std::vector<HeaderElement> elements;
  std::vector<std::string> comments;
  std::vector<std::size_t> comment_lines;
};

PlyFormat read_format(LineCursor& lines) {
  const std::string_view name = lines.field("the format");
  const std::string_view version = lines.field("the format's version");
  if (version != "1.0") lines.fail("the format's version", "is " + printable(version) + "; only 1.0 is known");
  if (name == "ascii") return PlyFormat::kAscii;
  if (name == "binary_little_endian") return PlyFormat::kLittleEndian;
  if (name == "binary_big_endian") return PlyFormat::kBigEndian;
  lines.fail("the format", "is " + printable(name) + "; it must be ascii, binary_little_endian or binary_big_endian");
}

PlyType read_type(LineCursor& lines) {
  const std::string_view name = lines.field("a property's type");
  for (const TypeName& known : kTypeNames) {
    if (known.name == name) return known.type;
  }
  lines.fail("a property's type", "is " + printable(name) + ", which PLY does not know");
}

std::string read_name(LineCursor& lines, const char* what) {
  const std::string_view name = lines.field(what);
  const auto is_control = [](char c) { return (c >= 0 && c < ' ') || c == '\x7f'; };
  if (std::any_of(name.begin(), name.end(), is_control))
    lines.fail(what, "is " + printable(name) + ", which is not a name");
  return std::string(name);
}

HeaderProperty read_property(LineCursor& lines) {
  HeaderProperty property;
  LineCursor ahead = lines;
  if (ahead.field("a property's type") == "list") {
    lines.field("list");
    property.count_type = read_type(lines);
    if (is_float(*property.count_type)) lines.fail("a list's length", "has a floating point type");
  }
  property.type = read_type(lines);
  property.name = read_name(lines, "a property's name");
  return property;
}

Header read_header(LineCursor& lines) {
  if (!lines.next_line() || lines.rest() != "ply") lines.fail("the first line", "is not \"ply\": this is no PLY file");
  Header header;
  std::unordered_set<std::string> element_names;
  std::unordered_set<std::string> property_names;
  while (lines.next_line()) {
    if (!lines.has_field()) continue;
    const std::string_view keyword = lines.field("a keyword");
    if (keyword == "comment") {
      header.comments.emplace_back(lines.rest());
      header.comment_lines.push_back(lines.line_number());
    } else if (keyword == "obj_info") {
      lines.rest();
    } else if (keyword == "format") {
      header.format = read_format(lines);
    } else if (keyword == "element") {
      HeaderElement element;
      element.name = read_name(lines, "an element's name");
      element.count = lines.whole("an element's count");
      if (!element_names.insert(element.name).second)
        lines.fail("element " + printable(element.name), "is there twice");
      header.elements.push_back(std::move(element));
      property_names.clear();
    } else if (keyword == "property") {
      if (header.elements.empty()) lines.fail("a property", "stands before the first element");
      HeaderProperty property = read_property(lines);
      if (!property_names.insert(property.name).second) {
        lines.fail("property " + printable(property.name), "is there twice");
      }
      header.elements.back().properties.push_back(std::move(property));
    } else if (keyword == "end_header") {
      lines.end_of_line("end_header");
      if (!header.format) lines.fail("the header", "has no format line");
      return header;
    } else {
      lines.fail("the header", "has the unknown keyword " + printable(keyword));
    }
    lines.end_of_line("a header line");
  }
  lines.fail("the header", "has no end_header line (truncated file?)");
}

/// Appends a number in the host's byte order. False if `type` cannot hold it.
bool append_value(std::string& bytes, PlyType type, double value) {
  return with_type(type, [&](auto zero) {
    using T = decltype(zero);
    if constexpr (std::numeric_limits<T>::is_integer) {
      if (!(value >= std::numeric_limits<T>::min() && value <= std::numeric_limits<T>::max())) return false;
      if (value != std::floor(value)) return false;
    }
    const T converted = static_cast<T>(value);
    bytes.append(reinterpret_cast<const char*>(&converted), sizeof(T));
    return true;
  });
}

/// Walks the rows of an ascii element, one a line; appends the scalars to `rows` if that is given.
void read_ascii_element(LineCursor& lines, const HeaderElement& element, std::string* rows) {
  for (std::uint64_t row = 0; row < element.count; ++row) {
    do {
      if (!lines.next_line()) {
        lines.fail("element " + printable(element.name), "ends after " + std::to_string(row) + " of " +
                                                             std::to_string(element.count) + " rows (truncated file?)");
      }
    } while (!lines.has_field());
    if (rows == nullptr) continue;
    for (const HeaderProperty& property : element.properties) {
      const char* name = property.name.c_str();
      if (property.count_type) {
        for (auto left = lines.whole(name); left > 0; --left) lines.number(name);
      } else {
        const double value = lines.number(name);
        if (!append_value(*rows, property.type, value)) {
          lines.fail(property.name, "is " + shortest_text(value) + ", which its type cannot hold");
        }
      }
    }
    lines.end_of_line("the last property");
  }
}

/// Walks the rows of a binary element; if it has lists, the scalars are appended to `rows` if that is given.
void read_binary_element(ByteCursor& cursor, const HeaderElement& element, ByteOrder order, std::string* rows) {
  const std::string name = "element " + printable(element.name);
  if (!element.has_lists()) {
    std::size_t stride = 0;
    for (const HeaderProperty& property : element.properties) stride += size_of(property.type);
    cursor.take(element.count, stride, name.c_str());
    return;
  }
  for (std::uint64_t row = 0; row < element.count; ++row) {
    for (const HeaderProperty& property : element.properties) {
      const PlyType first_type = property.count_type.value_or(property.type);
      const char* first = cursor.take(1, size_of(first_type), name.c_str());
      if (property.count_type) {
        const double length = load_as_double(first, first_type, order);
        if (length < 0) cursor.fail(name, "has a list of negative length");
        cursor.take(static_cast<std::uint64_t>(length), size_of(property.type), name.c_str());
      } else if (rows != nullptr) {
        rows->append(first, size_of(property.type));
      }
    }
  }
}

}  // namespace

PlyVertices PlyVertices::read(const std::string& path) { return parse(read_file(path), path); }

PlyVertices PlyVertices::parse(std::string bytes, const std::string& file) {
  PlyVertices vertices;
  vertices.file_ = file;
  vertices.bytes_ = std::move(bytes);
  if (vertices.bytes_.empty()) {
    vertices.fail("it has 0 bytes, so this is no PLY file, whose first line is \"ply\"; write or copy it again");
  }
  LineCursor lines(vertices.bytes_, file);
  Header header = read_header(lines);
  vertices.comments_ = std::move(header.comments);
  vertices.comment_lines_ = std::move(header.comment_lines);
  const PlyFormat format = *header.format;
  const ByteOrder order = format == PlyFormat::kBigEndian ? ByteOrder::kBigEndian : ByteOrder::kLittleEndian;
  ByteCursor binary(vertices.bytes_, file, lines.next_offset());

  for (const HeaderElement& element : header.elements) {
    const bool is_vertex = element.name == "vertex";
    if (element.count > 0 && element.properties.empty()) vertices.fail("element " + element.name + " has no property");
    for (const HeaderProperty& property : element.properties) {
      if (!is_vertex || property.count_type) continue;
      vertices.properties_.push_back({property.name, property.type, vertices.stride_});
      vertices.stride_ += size_of(property.type);
    }

    const std::size_t begin = binary.offset();
    std::string rows;
    if (format == PlyFormat::kAscii) {
      read_ascii_element(lines, element, is_vertex ? &rows : nullptr);
    } else {
      read_binary_element(binary, element, order, is_vertex ? &rows : nullptr);
    }
    if (!is_vertex) continue;

    vertices.count_ = static_cast<std::size_t>(element.count);
    vertices.order_ = format == PlyFormat::kAscii ? host_byte_order() : order;
    if (format == PlyFormat::kAscii || element.has_lists()) {
      vertices.bytes_ = std::move(rows);
    } else {
      vertices.first_row_ = begin;
    }
    return vertices;
  }
  vertices.fail("the header has no element \"vertex\"");
}

const PlyProperty* PlyVertices::find(std::string_view name) const {
  for (const PlyProperty& property : properties_) {
    if (property.name == name) return &property;
  }
  return nullptr;
}

const PlyProperty& PlyVertices::require(std::string_view name) const {
  if (const PlyProperty* property = find(name)) return *property;
  constexpr std::size_t kMostListed = 20;
  std::string names;
  for (std::size_t i = 0; i < properties_.size() && i < kMostListed; ++i) names += " " + properties_[i].name;
  if (properties_.size() > kMostListed) names += " ...";
  fail("element vertex has no scalar property \"" + std::string(name) + "\"; it has" +
       (names.empty() ? std::string(" none") : ":" + names));
}

double PlyVertices::value(std::size_t row, const PlyProperty& property) const {
  return load_as_double(bytes_.data() + first_row_ + row * stride_ + property.offset, property.type, order_);
}

void PlyVertices::fail(const std::string& reason) const { throw FormatError(file_ + ": " + reason); }

std::string ply_header(const std::string& file, std::size_t count, const std::vector<PlyColumn>& columns,
                       const std::vector<std::string>& comments) {
  std::string header = "ply\nformat binary_little_endian 1.0\n";
  for (const std::string& comment : comments) {
    if (comment.find_first_of(std::string_view("\n\r\0", 3)) != std::string::npos) {
      throw FormatError(file + ": the comment " + printable(comment) + " is not one line of text");
    }
    header += "comment " + comment + "\n";
  }
  header += "element vertex " + std::to_string(count) + "\n";
  for (const PlyColumn& column : columns) {
    for (const TypeName& known : kTypeNames) {
      if (known.type != column.type) continue;
      header.append("property ").append(known.name).append(" ").append(column.name).append("\n");
      break;
    }
  }
  return header + "end_header\n";
}

}  // namespace dsmoe::io
