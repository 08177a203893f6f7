// A progress bar on stderr: drawn in place on a terminal; elsewhere, such as in a job's log, a line a minute at most.
#pragma once

#include <unistd.h>

#include <chrono>
#include <cstdio>
#include <string>

namespace dsmoe::tools {

class Progress {
 public:
  Progress(std::string what, int total) : what_(std::move(what)), total_(total) {}
  ~Progress() {
    if (is_drawn_) std::fputc('\n', stderr);
  }
  Progress(const Progress&) = delete;
  Progress& operator=(const Progress&) = delete;

  /// note: a few words behind the bar.
  void show(int done, const std::string& note = "") {
    const bool is_terminal = isatty(STDERR_FILENO) != 0;
    const auto now = Clock::now();
    const auto least = is_terminal ? std::chrono::milliseconds(100) : std::chrono::milliseconds(60000);
    if (now - shown_ < least && (done < total_ || !is_terminal)) return;
    shown_ = now;
    const double seconds = std::chrono::duration<double>(now - begin_).count();
    const double left = done > 0 ? seconds / done * (total_ - done) : 0;
    const int width = 30, filled = total_ > 0 ? width * done / total_ : width;
    std::fprintf(stderr, "%s%s [%s%s] %d/%d, %.0f s, %.0f s left %s%s", is_terminal ? "\r" : "", what_.c_str(),
                 std::string(filled, '#').c_str(), std::string(width - filled, '.').c_str(), done, total_, seconds,
                 left, note.c_str(), is_terminal ? "\033[K" : "\n");
    is_drawn_ = is_terminal;
  }

 private:
  using Clock = std::chrono::steady_clock;
  std::string what_;
  int total_;
  Clock::time_point begin_ = Clock::now(), shown_ = begin_;
  bool is_drawn_ = false;
};

}  // namespace dsmoe::tools
