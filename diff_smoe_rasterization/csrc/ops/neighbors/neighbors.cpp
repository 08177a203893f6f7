// The three nearest neighbours of every point: exact, by a k-d tree whose nodes are ranges of one list.
#include "dsmoe/training/neighbors.h"

#include <algorithm>
#include <array>
#include <limits>
#include <numeric>
#include <vector>

#include "cpu/parallel.h"
#include "refuse.h"

namespace dsmoe {
namespace cpu {
namespace {

constexpr int64_t kLeaf = 8;     // points below which a node is searched whole
constexpr int64_t kChunk = 256;  // points that a thread takes at a time

// The smallest squared distances so far, ascending.
struct Nearest {
  std::array<double, kNeighbors> squared;
  Nearest() { squared.fill(std::numeric_limits<double>::infinity()); }

  void add(double distance) {
    if (distance >= squared.back()) return;
    squared.back() = distance;
    for (int i = kNeighbors - 1; i > 0 && squared[i] < squared[i - 1]; --i) std::swap(squared[i], squared[i - 1]);
  }
};

template <class S> class Tree {
 public:
  Tree(const S* points, int64_t count) : points_(points), order_(count), axes_(count) {
    std::iota(order_.begin(), order_.end(), int64_t(0));
    split(0, count);
  }

  // For the point at this position of the order; the point itself does not count.
  Nearest nearest(int64_t place) const {
    Nearest found;
    search(0, static_cast<int64_t>(order_.size()), place, found);
    return found;
  }

  int64_t point(int64_t place) const { return order_[place]; }

 private:
  double coordinate(int64_t place, int axis) const { return static_cast<double>(points_[3 * order_[place] + axis]); }

  // Puts the median along the widest axis into the middle, smaller ones before it, and does so with both halves.
  void split(int64_t begin, int64_t end) {
    if (end - begin <= kLeaf) return;
    int widest = 0;
    double width = -1;
    for (int axis = 0; axis < 3; ++axis) {
      double low = coordinate(begin, axis), high = low;
      for (int64_t i = begin; i < end; ++i) {
        low = std::min(low, coordinate(i, axis));
        high = std::max(high, coordinate(i, axis));
      }
      if (high - low > width) width = high - low, widest = axis;
    }
    const int64_t middle = (begin + end) / 2;
    std::nth_element(order_.begin() + begin, order_.begin() + middle, order_.begin() + end,
                     [&](int64_t a, int64_t b) { return points_[3 * a + widest] < points_[3 * b + widest]; });
    axes_[middle] = static_cast<int8_t>(widest);
    split(begin, middle);
    split(middle + 1, end);
  }

  void visit(int64_t other, int64_t place, Nearest& found) const {
    if (other == place) return;
    double squared = 0;
    for (int axis = 0; axis < 3; ++axis) {
      const double difference = coordinate(other, axis) - coordinate(place, axis);
      squared += difference * difference;
    }
    found.add(squared);
  }

  void search(int64_t begin, int64_t end, int64_t place, Nearest& found) const {
    if (end - begin <= kLeaf) {
      for (int64_t i = begin; i < end; ++i) visit(i, place, found);
      return;
    }
    const int64_t middle = (begin + end) / 2;
    const double beyond = coordinate(place, axes_[middle]) - coordinate(middle, axes_[middle]);
    const bool left = beyond < 0;
    left ? search(begin, middle, place, found) : search(middle + 1, end, place, found);
    visit(middle, place, found);
    if (beyond * beyond >= found.squared.back()) return;
    left ? search(middle + 1, end, place, found) : search(begin, middle, place, found);
  }

  const S* points_;
  std::vector<int64_t> order_;
  std::vector<int8_t> axes_;  // of the node whose middle lies there
};

}  // namespace

template <class S> void mean_squared_distances(const S* points, int64_t count, S* result, int num_threads) {
  refuse_null("cpu::mean_squared_distances", "points", points, "[N, 3]", count);
  refuse_null("cpu::mean_squared_distances", "result", result, "[N]", count);
  const Tree<S> tree(points, count);
  const int64_t others = std::min<int64_t>(kNeighbors, count - 1);
  parallel_for(num_threads, count, kChunk, [&](int64_t begin, int64_t end) {
    for (int64_t place = begin; place < end; ++place) {
      const auto squared = tree.nearest(place).squared;
      const double sum = std::accumulate(squared.begin(), squared.begin() + others, 0.0);
      result[tree.point(place)] = others > 0 ? static_cast<S>(sum / static_cast<double>(others)) : S(0);
    }
  });
}

template void mean_squared_distances<float>(const float*, int64_t, float*, int);
template void mean_squared_distances<double>(const double*, int64_t, double*, int);

}  // namespace cpu
}  // namespace dsmoe
