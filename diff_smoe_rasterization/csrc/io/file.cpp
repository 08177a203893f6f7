#include "io/file.h"

#include <cerrno>
#include <cstdio>
#include <cstring>
#include <filesystem>
#include <system_error>

namespace dsmoe::io {

namespace fs = std::filesystem;

std::string read_file(const std::string& path) {
  std::error_code error;
  const fs::file_status status = fs::status(path, error);
  if (status.type() == fs::file_type::not_found) throw FileError(path, "no such file", ENOENT);
  if (error) throw FileError(path, "cannot be read: " + error.message(), error.value());
  if (fs::is_directory(status)) throw FileError(path, "is a folder, not a file", EISDIR);
  // A device or pipe has no size to check counts against.
  if (!fs::is_regular_file(status)) throw FileError(path, "is not a regular file", EINVAL);

  errno = 0;
  std::ifstream stream(path, std::ios::binary);
  if (!stream) {
    const int number = errno != 0 ? errno : EIO;
    throw FileError(path, std::string("cannot be opened: ") + std::strerror(number), number);
  }
  const auto size = fs::file_size(path, error);
  if (error) throw FileError(path, "cannot be read: " + error.message(), error.value());
  std::string bytes(size, '\0');
  stream.read(bytes.data(), static_cast<std::streamsize>(size));
  if (static_cast<std::uintmax_t>(stream.gcount()) != size) throw FileError(path, "could not be read to its end", EIO);
  return bytes;
}

OutputFile::OutputFile(const std::string& path) {
  std::error_code error;
  // Through a link, so that the rename replaces the file that the link names and not the link.
  const fs::path target = fs::weakly_canonical(path, error);
  path_ = error ? path : target.string();
  const fs::file_status status = fs::status(path_, error);
  if (fs::exists(status) && !fs::is_regular_file(status)) throw FileError(path, "is not a regular file", EINVAL);
  partial_path_ = path_ + ".partial";
  fs::remove(partial_path_, error);  // of a killed run, or a link to another file, which stays
  errno = 0;
  if (std::FILE* created = std::fopen(partial_path_.c_str(), "wbx")) {  // a new file: x follows no link
    std::fclose(created);
    stream_.open(partial_path_, std::ios::binary);
  }
  if (!stream_.is_open()) {
    const int number = errno != 0 ? errno : EIO;
    throw FileError(path, std::string("cannot be written: ") + std::strerror(number), number);
  }
}

OutputFile::~OutputFile() {
  if (committed_) return;
  stream_.close();
  std::error_code ignored;
  fs::remove(partial_path_, ignored);
}

void OutputFile::commit() {
  stream_.close();
  if (!stream_) throw FileError(path_, "could not be written whole; is the disk full?", EIO);
  std::error_code error;
  fs::rename(partial_path_, path_, error);
  if (error) throw FileError(path_, "cannot be written: " + error.message(), error.value());
  committed_ = true;
}

}  // namespace dsmoe::io
