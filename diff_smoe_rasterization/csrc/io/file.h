// Whole files in and out, and the two errors that every reader and writer of this folder throws.
#pragma once

#include <cstddef>
#include <fstream>
#include <stdexcept>
#include <string>
#include <string_view>

namespace dsmoe::io {

/// Base of everything that reading and writing throws; the message names the file, what was read and the reason.
class IoError : public std::runtime_error {
 public:
  using std::runtime_error::runtime_error;
};

/// A file that cannot be found, opened, read or written.
class FileError : public IoError {
 public:
  FileError(const std::string& file_path, const std::string& why, int error)
      : IoError(file_path + ": " + why), path(file_path), reason(why), error_number(error) {}

  const std::string path;
  const std::string reason;
  const int error_number;  // errno
};

/// A file, or data to be written, whose content is not what its format asks for.
class FormatError : public IoError {
 public:
  using IoError::IoError;
};

/// Returns the bytes of a regular file. Throws FileError.
std::string read_file(const std::string& path);

/// A file that appears under its name only when it is complete: bytes go to "<path>.partial" until `commit`.
class OutputFile {
 public:
  explicit OutputFile(const std::string& path);
  ~OutputFile();
  OutputFile(const OutputFile&) = delete;
  OutputFile& operator=(const OutputFile&) = delete;

  void write(std::string_view bytes) { stream_.write(bytes.data(), static_cast<std::streamsize>(bytes.size())); }

  /// Throws FileError if any write failed (a full disk shows here).
  void commit();

 private:
  std::string path_;
  std::string partial_path_;
  std::ofstream stream_;
  bool committed_ = false;
};

}  // namespace dsmoe::io
