// Threads.
#include "cpu/parallel.h"

#include <gtest/gtest.h>
#include <sys/wait.h>
#include <unistd.h>

#include <atomic>
#include <chrono>
#include <ctime>
#include <set>
#include <stdexcept>
#include <string>
#include <thread>
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

// ---- The pool ----

// The threads that run `count` workers. Each worker waits for the others, up to 10 seconds.
std::set<pid_t> threads_that_meet(int count) {
  std::atomic<int> arrived{0};
  std::vector<pid_t> threads(count);
  const auto give_up = std::chrono::steady_clock::now() + std::chrono::seconds(10);
  run_threads(count, [&](int index) {
    threads[index] = gettid();
    ++arrived;
    while (arrived < count && std::chrono::steady_clock::now() < give_up) std::this_thread::yield();
  });
  return std::set<pid_t>(threads.begin(), threads.end());
}

TEST(RunThreads, HasAThreadForEachWorkerAndKeepsIt) {
  const int more_than_elsewhere = 16;  // or the pool would have threads to choose from
  const auto first = threads_that_meet(more_than_elsewhere);
  EXPECT_EQ(first.size(), 16u);
  EXPECT_EQ(first.count(gettid()), 1u);
  EXPECT_EQ(threads_that_meet(more_than_elsewhere), first);
}

TEST(RunThreads, MayBeCalledFromManyThreadsAndFromAWorker) {
  std::atomic<int> runs{0};
  std::vector<std::thread> callers;
  for (int caller = 0; caller < 4; ++caller) {
    callers.emplace_back([&] {
      for (int call = 0; call < 50; ++call) {
        run_threads(3, [&](int) { run_threads(3, [&](int) { ++runs; }); });
      }
    });
  }
  for (auto& caller : callers) caller.join();
  EXPECT_EQ(runs, 4 * 50 * 3 * 3);
}

TEST(RunThreads, TakesNoProcessorTimeBetweenCalls) {
  threads_that_meet(4);
  const std::clock_t start = std::clock();
  std::this_thread::sleep_for(std::chrono::milliseconds(300));
  // Three threads that waited busily would take 900 ms of processor time if there are as many cores, 300 on one.
  EXPECT_LT(double(std::clock() - start) / CLOCKS_PER_SEC, 0.1);
}

TEST(RunThreads, WorksInAForkedChild) {
  threads_that_meet(3);
  std::atomic<bool> stop{false};
  std::thread busy([&] {  // so that the fork may happen while the pool is in use
    while (!stop) run_threads(3, [](int) {});
  });
  for (int child = 0; child < 20; ++child) {
    const pid_t pid = fork();
    ASSERT_GE(pid, 0);
    if (pid == 0) {
      alarm(30);  // ends a child that hangs
      _exit(threads_that_meet(3).size() == 3 ? 0 : 1);
    }
    int status = 0;
    waitpid(pid, &status, 0);
    EXPECT_TRUE(WIFEXITED(status) && WEXITSTATUS(status) == 0) << "child " << child << " ended with " << status;
  }
  stop = true;
  busy.join();
}

}  // namespace
}  // namespace cpu
}  // namespace dsmoe
