// Threads for one call: started, joined and forgotten, so that there is no pool to configure, fork or leak.
#pragma once

#include <algorithm>
#include <atomic>
#include <cstdint>
#include <exception>
#include <thread>
#include <vector>

namespace dsmoe {
namespace cpu {

// Runs worker(0) ... worker(num_threads - 1), at least worker(0), at once, the last on the calling thread; rethrows the
// first exception.
template <class Worker> void run_threads(int num_threads, Worker worker) {
  num_threads = std::max(1, num_threads);
  std::exception_ptr failure;
  std::atomic_flag failed = ATOMIC_FLAG_INIT;
  auto guarded = [&](int index) {
    try {
      worker(index);
    } catch (...) {
      if (!failed.test_and_set()) failure = std::current_exception();
    }
  };
  std::vector<std::thread> threads;
  int started = 0;
  try {
    threads.reserve(num_threads - 1);
    for (; started < num_threads - 1; ++started) threads.emplace_back(guarded, started);
  } catch (...) {
    // No more threads to be had: the calling thread does their share.
    for (int index = started; index < num_threads - 1; ++index) guarded(index);
  }
  guarded(num_threads - 1);
  for (auto& thread : threads) thread.join();
  if (failure) std::rethrow_exception(failure);
}

// Calls body(begin, end) for chunks of [0, count), each taken by the next free thread. The chunks do not depend on the
// number of threads.
template <class Body> void parallel_for(int num_threads, int64_t count, int64_t chunk, Body body) {
  const int64_t num_chunks = (count + chunk - 1) / chunk;
  std::atomic<int64_t> next{0};
  const int useful_threads = static_cast<int>(std::max<int64_t>(1, std::min<int64_t>(num_threads, num_chunks)));
  run_threads(useful_threads, [&](int) {
    for (int64_t i = next++; i < num_chunks; i = next++) body(i * chunk, std::min(count, (i + 1) * chunk));
  });
}

}  // namespace cpu
}  // namespace dsmoe
