// Threads.
#include "cpu/parallel.h"

#include <gtest/gtest.h>

#include <atomic>
#include <set>
#include <stdexcept>
#include <string>
#include <utility>
#include <vector>

namespace dsmoe {
namespace cpu {
namespace {

constexpr int kThreadCounts[] = {1, 2, 3, 7};

TEST(RunThreads, FewerThanOneThreadCountsAsOne) {
  for (const int num_threads : {0, -3}) {
    int calls = 0;
    run_threads(num_threads, [&](int index) {
      EXPECT_EQ(index, 0);
      ++calls;
    });
    EXPECT_EQ(calls, 1);
  }
}

TEST(RunThreads, RunsEachWorkerOnce) {
  for (const int threads : kThreadCounts) {
    std::vector<std::atomic<int>> runs(threads);
    run_threads(threads, [&](int index) { ++runs.at(index); });
    for (const auto& count : runs) EXPECT_EQ(count, 1);
  }
}

TEST(ParallelFor, VisitsEveryIndexOnce) {
  for (const int threads : kThreadCounts) {
    for (const int64_t count : {0, 1, 9, 10, 11, 1000}) {
      std::vector<std::atomic<int>> visits(count);
      parallel_for(threads, count, 10, [&](int64_t begin, int64_t end) {
        EXPECT_LT(begin, end);
        for (int64_t i = begin; i < end; ++i) ++visits[i];
      });
      for (const auto& visit : visits) ASSERT_EQ(visit, 1);
    }
  }
}

TEST(ParallelFor, CutsTheSameChunksForAnyNumberOfThreads) {
  auto chunks = [](int threads) {
    std::vector<std::atomic<int64_t>> ends(95);
    parallel_for(threads, 95, 10, [&](int64_t begin, int64_t end) { ends[begin] = end; });
    std::set<std::pair<int64_t, int64_t>> out;
    for (int64_t begin = 0; begin < 95; ++begin) {
      if (ends[begin] != 0) out.emplace(begin, ends[begin]);
    }
    return out;
  };
  EXPECT_EQ(chunks(1).size(), 10u);
  for (const int threads : kThreadCounts) EXPECT_EQ(chunks(threads), chunks(1));
}

TEST(ParallelFor, PassesAnExceptionOnAndStillJoins) {
  for (const int threads : kThreadCounts) {
    std::atomic<int> running{0};
    auto body = [&](int64_t begin, int64_t) {
      ++running;
      struct Leave {
        std::atomic<int>& running;
        ~Leave() { --running; }
      } leave{running};
      if (begin == 500) throw std::runtime_error("chunk 500");
    };
    try {
      parallel_for(threads, 1000, 10, body);
      FAIL() << "nothing was thrown";
    } catch (const std::runtime_error& error) {
      EXPECT_EQ(std::string(error.what()), "chunk 500");
    }
    EXPECT_EQ(running, 0);
  }
}

TEST(RunThreads, PassesOneOfSeveralExceptionsOn) {
  EXPECT_THROW(run_threads(7, [](int) { throw std::runtime_error("each"); }), std::runtime_error);
}

}  // namespace
}  // namespace cpu
}  // namespace dsmoe
