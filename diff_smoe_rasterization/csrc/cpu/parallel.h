// Threads of the CPU backend: one pool for the process, shared by all calls. Functions for several instruction sets.
#pragma once

#include <algorithm>
#include <atomic>
#include <cstdint>
#include <functional>

// Compiles a function once per instruction set. The loader takes the best one that the processor has. The results are
// the same bits in each, because no compiler flag lets products and sums become fused.
#if defined(__x86_64__) && defined(__gnu_linux__) && defined(__GNUC__) && !defined(__clang__)
#define DSMOE_MULTIVERSION __attribute__((target_clones("avx2", "default")))
#else
#define DSMOE_MULTIVERSION
#endif

namespace dsmoe {
namespace cpu {

// Calls worker(0) ... worker(num_threads - 1), at least worker(0), each once, on the calling thread and on threads of
// the pool that are free. Returns when all have ended, and rethrows the first exception. Workers must not wait for
// each other: one thread may run them all.
void run_threads(int num_threads, const std::function<void(int index)>& worker);

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
