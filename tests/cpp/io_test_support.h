// What the tests of the readers share: bytes made by hand, files that vanish, and damage.
#pragma once

#include <gtest/gtest.h>

#include <cstdint>
#include <cstring>
#include <exception>
#include <filesystem>
#include <fstream>
#include <iterator>
#include <random>
#include <string>

#include "io/file.h"

namespace dsmoe::io {

/// Appends numbers as their bytes, least significant first on every machine; independent of the code under test.
class Bytes {
 public:
  template <typename T> Bytes& put(T value, bool big_endian = false) {
    std::uint64_t bits = 0;
    if constexpr (sizeof(T) == 8) {
      std::memcpy(&bits, &value, 8);
    } else if constexpr (std::is_floating_point_v<T>) {
      std::uint32_t bits32 = 0;
      std::memcpy(&bits32, &value, 4);
      bits = bits32;
    } else {
      bits = static_cast<std::uint64_t>(value);
    }
    for (std::size_t i = 0; i < sizeof(T); ++i) {
      const std::size_t byte = big_endian ? sizeof(T) - 1 - i : i;
      bytes_ += static_cast<char>((bits >> (8 * byte)) & 0xff);
    }
    return *this;
  }
  Bytes& text(const std::string& text) {
    bytes_ += text;
    return *this;
  }
  const std::string& str() const { return bytes_; }

 private:
  std::string bytes_;
};

class TemporaryFolder {
 public:
  TemporaryFolder() {
    std::random_device device;
    path_ = std::filesystem::temp_directory_path() /
            ("dsmoe_io_test_" + std::to_string(device()) + "_" + std::to_string(device()));
    std::filesystem::create_directory(path_);
  }
  ~TemporaryFolder() {
    std::error_code ignored;
    std::filesystem::remove_all(path_, ignored);
  }
  std::string file(const std::string& name) const { return (path_ / name).string(); }

 private:
  std::filesystem::path path_;
};

inline void write_bytes(const std::string& path, const std::string& bytes) {
  std::ofstream(path, std::ios::binary) << bytes;
}

inline std::string read_bytes(const std::string& path) {
  std::ifstream stream(path, std::ios::binary);
  return std::string(std::istreambuf_iterator<char>(stream), {});
}

/// Runs `function` and returns the message of the FormatError that it must throw.
template <typename Function> std::string format_error_of(Function function) {
  try {
    function();
  } catch (const FormatError& error) {
    return error.what();
  }
  ADD_FAILURE() << "nothing was thrown";
  return "";
}

inline void expect_contains(const std::string& text, const std::string& part) {
  EXPECT_NE(text.find(part), std::string::npos) << "\"" << part << "\" is not in: " << text;
}

/// Damages `valid` in many ways, the same on every run, and parses each result: it must be read or refused with
/// FormatError. Anything else (bad_alloc from a count that was believed, out_of_range, a crash) is a failure.
template <typename Parse> void expect_survives_damage(const std::string& valid, Parse parse, int rounds = 4000) {
  std::mt19937 random(20240607);
  const auto below = [&](std::size_t n) { return n == 0 ? 0 : random() % n; };
  int num_refused = 0;
  for (int round = 0; round < rounds; ++round) {
    std::string damaged = valid;
    for (std::size_t left = 1 + below(3); left > 0 && !damaged.empty(); --left) {
      const std::size_t at = below(damaged.size());
      const std::size_t length = 1 + below(12);
      switch (below(6)) {
        case 0:
          damaged[at] = static_cast<char>(damaged[at] ^ (1 << below(8)));
          break;
        case 1:
          damaged[at] = static_cast<char>(below(256));
          break;
        case 2:
          damaged.resize(at);
          break;
        case 3:
          damaged.erase(at, length);
          break;
        case 4:
          damaged.insert(at, damaged.substr(below(damaged.size()), length));
          break;
        default:
          damaged.replace(at, length, length, "\xff\x7f\x80 -9"[below(6)]);
          break;
      }
    }
    try {
      parse(damaged);
    } catch (const FormatError& error) {
      ++num_refused;
      EXPECT_NE(std::string(error.what()).find("damaged"), std::string::npos) << error.what();
    } catch (const std::exception& error) {
      ADD_FAILURE() << "round " << round << ": " << error.what();
    }
  }
  EXPECT_GT(num_refused, rounds / 20);  // else the damage would not reach what the reader looks at
}

}  // namespace dsmoe::io
