#include "io/cursor.h"

#include <algorithm>
#include <charconv>
#include <cstdio>
#include <system_error>

namespace dsmoe::io {

namespace {

constexpr std::string_view kBlanks = " \t\v\f\r";

template <typename T> bool parse_all(std::string_view text, T& value) {
  const auto [end, error] = std::from_chars(text.data(), text.data() + text.size(), value);
  return error == std::errc() && end == text.data() + text.size() && !text.empty();
}

// Bytes of the character of UTF-8 that `text` begins with; 0 if it begins with a control character or with none.
std::size_t printable_bytes(std::string_view text) {
  const auto byte = [&](std::size_t i) { return static_cast<std::uint32_t>(static_cast<unsigned char>(text[i])); };
  const std::uint32_t first = byte(0);
  if (first < 0x80) return first >= ' ' && first <= '~' ? 1 : 0;
  const std::size_t size = first < 0xe0 ? 2 : first < 0xf0 ? 3 : 4;
  if (first < 0xc2 || first > 0xf4 || size > text.size()) return 0;
  std::uint32_t code = first & (0x7f >> size);
  for (std::size_t i = 1; i < size; ++i) {
    if (byte(i) >> 6 != 2) return 0;
    code = code << 6 | (byte(i) & 0x3f);
  }
  constexpr std::uint32_t kLeast[] = {0xa0, 0x800, 0x10000};  // below are controls, and what takes fewer bytes
  const bool surrogate = code >= 0xd800 && code < 0xe000;
  return code >= kLeast[size - 2] && code <= 0x10ffff && !surrogate ? size : 0;
}

}  // namespace

std::string printable(std::string_view text, std::size_t longest) {
  std::string result = "\"";
  std::size_t at = 0;
  while (at < text.size()) {
    const std::size_t size = printable_bytes(text.substr(at)), step = std::max<std::size_t>(size, 1);
    if (at + step > longest) break;
    if (size > 0) {
      result += text.substr(at, size);
    } else {
      char escaped[5];
      std::snprintf(escaped, sizeof(escaped), "\\x%02x", static_cast<unsigned char>(text[at]));
      result += escaped;
    }
    at += step;
  }
  return result + (at < text.size() ? "...\"" : "\"");
}

bool parse_number(std::string_view text, double& value) {
  // from_chars knows no plus sign, which printf("%+g") writes.
  if (text.size() > 1 && text[0] == '+' && text[1] != '-') text.remove_prefix(1);
  return parse_all(text, value);
}

bool parse_whole(std::string_view text, std::uint64_t& value) { return parse_all(text, value); }

std::string shortest_text(double value) {
  char text[32];  // the longest double needs 24
  const auto result = std::to_chars(text, text + sizeof(text), value);
  return std::string(text, result.ptr);
}

std::uint64_t ByteCursor::read_count(const char* what, std::size_t record_bytes) {
  const auto count = read<std::uint64_t>(what);
  if (count > remaining() / record_bytes) {
    fail(what, "is " + std::to_string(count) + ", of at least " + std::to_string(record_bytes) + " bytes each, but " +
                   std::to_string(remaining()) + " bytes follow");
  }
  return count;
}

const char* ByteCursor::take(std::uint64_t count, std::size_t record_bytes, const char* what) {
  if (record_bytes != 0 && count > remaining() / record_bytes) {
    fail(what, "needs " + std::to_string(count) + " x " + std::to_string(record_bytes) + " bytes, but " +
                   std::to_string(remaining()) + " are left (truncated file?)");
  }
  const char* begin = bytes_.data() + offset_;
  offset_ += static_cast<std::size_t>(count) * record_bytes;
  return begin;
}

void ByteCursor::end_of_data(const char* what) const {
  if (remaining() != 0) fail(what, "is followed by " + std::to_string(remaining()) + " bytes that belong to nothing");
}

std::string_view ByteCursor::read_c_string(const char* what) {
  const std::size_t end = bytes_.find('\0', offset_);
  if (end == std::string_view::npos) fail(what, "has no end (truncated file?)");
  const std::string_view text = bytes_.substr(offset_, end - offset_);
  offset_ = end + 1;
  return text;
}

void ByteCursor::fail(const std::string& what, const std::string& reason) const {
  throw FormatError(file_ + ", byte " + std::to_string(offset_) + ": " + what + " " + reason);
}

bool LineCursor::next_line() {
  if (next_ >= text_.size()) return false;
  const std::size_t end = text_.find('\n', next_);
  line_ = text_.substr(next_, end == std::string_view::npos ? end : end - next_);
  next_ = end == std::string_view::npos ? text_.size() : end + 1;
  if (!line_.empty() && line_.back() == '\r') line_.remove_suffix(1);
  ++line_number_;
  return true;
}

bool LineCursor::next_content_line() {
  while (next_line()) {
    if (has_field() && line_.front() != '#') return true;
  }
  return false;
}

bool LineCursor::has_field() {
  line_.remove_prefix(std::min(line_.find_first_not_of(kBlanks), line_.size()));
  return !line_.empty();
}

std::string_view LineCursor::field(const char* what) {
  if (!has_field()) fail(what, "is missing");
  const std::size_t end = std::min(line_.find_first_of(kBlanks), line_.size());
  const std::string_view text = line_.substr(0, end);
  line_.remove_prefix(end);
  return text;
}

double LineCursor::number(const char* what) {
  const std::string_view text = field(what);
  double value = 0;
  if (!parse_number(text, value)) fail(what, "is " + printable(text) + ", which is not a number");
  return value;
}

std::uint64_t LineCursor::whole(const char* what, std::uint64_t maximum) {
  const std::string_view text = field(what);
  std::uint64_t value = 0;
  if (!parse_whole(text, value) || value > maximum) {
    fail(what, "is " + printable(text) + "; it must be a whole number from 0 to " + std::to_string(maximum));
  }
  return value;
}

std::string_view LineCursor::rest() {
  if (!has_field()) return {};
  const std::string_view text = line_.substr(0, line_.find_last_not_of(kBlanks) + 1);
  line_ = {};
  return text;
}

void LineCursor::end_of_line(const char* what) {
  if (has_field()) fail(what, "is followed by " + printable(line_) + ", which does not belong there");
}

void LineCursor::fail(const std::string& what, const std::string& reason) const {
  throw FormatError(file_ + ", line " + std::to_string(line_number_) + ": " + what + " " + reason);
}

}  // namespace dsmoe::io
