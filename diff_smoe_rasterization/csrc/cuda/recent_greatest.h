// The greatest of the last numbers. One that was far above the others is forgotten after a while.
#pragma once

#include <algorithm>

namespace dsmoe {

// The greatest of the last n numbers added, kWindow <= n < 2 kWindow.
class RecentGreatest {
 public:
  // More frames than a training has views, so that the largest view of each round is remembered until the next.
  static constexpr int kWindow = 1024;

  void add(double number) {
    if (in_window_ == kWindow) {
      last_window_ = this_window_;
      this_window_ = -1;
      in_window_ = 0;
    }
    this_window_ = std::max(this_window_, number);
    ++in_window_;
  }

  // -1 if nothing was added.
  double greatest() const { return std::max(last_window_, this_window_); }

 private:
  double last_window_ = -1, this_window_ = -1;
  int in_window_ = 0;
};

}  // namespace dsmoe
