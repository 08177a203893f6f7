// The fibers of emulator.h, and which of them runs when.
#undef _FORTIFY_SOURCE  // its longjmp refuses to go to another stack

#include "emulator.h"

#include <setjmp.h>
#include <ucontext.h>

#include <algorithm>
#include <cstdio>
#include <memory>
#include <numeric>
#include <random>
#include <vector>

#include "order.h"

dim3 threadIdx, blockIdx, blockDim, gridDim;

namespace emulator {

alignas(256) char dynamic_shared[kSharedBytes];
int multiprocessors = 10;
bool other_captures = false;

namespace {

constexpr size_t kStackBytes = 256 << 10;
constexpr unsigned kMostThreads = 1024;

struct Copy {
  void* to;
  const void* from;
  size_t size;
};

// It runs one thread after another: of each block the one with its number.
struct Fiber {
  enum State { kReady, kAtWarp, kAtBlock, kDone } state;
  Place place;               // where it waits
  unsigned meetings;         // of its warp so far
  std::vector<Copy> copies;  // begun
  bool started = false;
  jmp_buf resume;
  ucontext_t context;
  std::unique_ptr<char[]> stack{new char[kStackBytes]};
};

// Threads that wait for each other: those of a warp, or of a block.
struct Group {
  Fiber::State state;          // of a thread that waits
  unsigned first, live, size;  // threads; live: still running
  unsigned waiting = 0;
  Place place = {};  // where the first of them waits
};

// A warp's meeting is over when all have come to it, and forgotten when all have come to the next one.
struct Warp : Group {
  Meeting meetings[2];
};

std::vector<std::unique_ptr<Fiber>> fibers;
std::vector<Warp> warps(kMostThreads / kLanes);
Group block;
std::vector<const void*> used;  // shared memory of the block
const std::function<void()>* kernel;
unsigned running;  // the thread
jmp_buf scheduler;
std::mt19937 random_numbers;
Order order = Order::kForward;

void to_scheduler() {
  if (_setjmp(fibers[running]->resume) == 0) _longjmp(scheduler, 1);
}

// When all running threads wait, they may go on.
void end_wait(Group& group) {
  if (group.waiting < group.live) return;
  group.waiting = 0;
  for (unsigned i = group.first; i < group.first + group.size; ++i) {
    if (fibers[i]->state == group.state) fibers[i]->state = Fiber::kReady;
  }
}

void wait(Group& group, Place place) {
  Fiber& fiber = *fibers[running];
  fiber.state = group.state, fiber.place = place;
  if (group.waiting++ == 0) group.place = place;
  if (place.line != group.place.line) fail("threads that wait for each other at different places", place);
  end_wait(group);
  if (fiber.state != Fiber::kReady) to_scheduler();
}

void run_threads() {
  for (;;) {
    (*kernel)();
    Fiber& fiber = *fibers[running];
    if (!fiber.copies.empty()) fail("a thread that ends before its copies");
    fiber.state = Fiber::kDone;
    for (Group* group : {static_cast<Group*>(&warps[running / kLanes]), &block}) --group->live, end_wait(*group);
    to_scheduler();
  }
}

// Lets a thread run until it waits or ends.
void resume(unsigned thread) {
  Fiber& fiber = *fibers[thread];
  running = thread;
  threadIdx = {thread % blockDim.x, thread / blockDim.x % blockDim.y, thread / blockDim.x / blockDim.y};
  if (_setjmp(scheduler) != 0) return;
  if (fiber.started) _longjmp(fiber.resume, 1);
  fiber.started = true;
  getcontext(&fiber.context);
  fiber.context.uc_stack.ss_sp = fiber.stack.get(), fiber.context.uc_stack.ss_size = kStackBytes;
  makecontext(&fiber.context, run_threads, 0);
  setcontext(&fiber.context);
}

std::vector<unsigned> in_order(unsigned count) {
  std::vector<unsigned> numbers(count);
  std::iota(numbers.begin(), numbers.end(), 0);
  if (order == Order::kBackward) std::reverse(numbers.begin(), numbers.end());
  if (order == Order::kShuffled) std::shuffle(numbers.begin(), numbers.end(), random_numbers);
  return numbers;
}

// A warp runs until all of its threads wait for others or have ended.
void run_block(unsigned threads) {
  const unsigned num_warps = (threads + kLanes - 1) / kLanes;
  for (unsigned i = 0; i < threads; ++i) fibers[i]->state = Fiber::kReady, fibers[i]->meetings = 0;
  for (unsigned i = 0; i < num_warps; ++i) {
    const unsigned size = std::min<unsigned>(kLanes, threads - i * kLanes);
    static_cast<Group&>(warps[i]) = {Fiber::kAtWarp, i * kLanes, size, size};
  }
  block = {Fiber::kAtBlock, 0, threads, threads};
  used.clear();
  const std::vector<unsigned> warp_order = in_order(num_warps), lane_order = in_order(kLanes);
  for (bool any = true; any;) {
    any = false;
    for (const unsigned warp : warp_order) {
      for (bool more = true; more;) {
        more = false;
        for (const unsigned lane : lane_order) {
          if (lane >= warps[warp].size || fibers[warp * kLanes + lane]->state != Fiber::kReady) continue;
          any = more = true;
          resume(warp * kLanes + lane);
        }
      }
    }
  }
  for (unsigned i = 0; i < threads; ++i) {
    if (fibers[running = i]->state != Fiber::kDone) fail("a thread that waits for ever", fibers[i]->place);
  }
}

}  // namespace

void run_in(Order of) { order = of; }

void launch(const std::function<void()>& thread, dim3 grid, dim3 threads, size_t shared_bytes, void*) {
  const unsigned count = threads.x * threads.y * threads.z;
  if (count == 0 || count > kMostThreads || shared_bytes > kSharedBytes) fail("a block that no card runs");
  if (grid.x == 0 || grid.y == 0 || grid.y > 0xffff || grid.z != 1) fail("a grid that no launch takes");
  while (fibers.size() < count) fibers.push_back(std::make_unique<Fiber>());
  kernel = &thread, gridDim = grid, blockDim = threads;
  for (const unsigned index : in_order(grid.x * grid.y)) {
    blockIdx = {index % grid.x, index / grid.x, 0};
    fill(dynamic_shared, shared_bytes);
    run_block(count);
  }
}

void meet_block(Place place) { wait(block, place); }

const Meeting& meet_warp(unsigned mask, const void* value, size_t size, Place place) {
  if (mask != ~0u) fail("a mask of some lanes, which the emulator does not know", place);
  Warp& warp = warps[running / kLanes];
  Meeting& meeting = warp.meetings[fibers[running]->meetings++ % 2];
  if (warp.waiting == 0) meeting.lanes = 0;
  meeting.lanes |= 1u << running % kLanes;
  memcpy(meeting.values[running % kLanes], value, size);
  wait(warp, place);
  return meeting;
}

void copy_later(void* to, const void* from, size_t size) {
  const auto is_aligned = [size](const void* p) { return reinterpret_cast<uintptr_t>(p) % size == 0; };
  if (!is_aligned(to) || !is_aligned(from)) fail("a copy that is not aligned");
  fibers[running]->copies.push_back({to, from, size});
}

void finish_copies() {
  for (const Copy& copy : fibers[running]->copies) memcpy(copy.to, copy.from, copy.size);
  fibers[running]->copies.clear();
}

void fill(void* memory, size_t bytes) {
  constexpr uint32_t kPattern = 0x7fffdead;
  auto* to = static_cast<char*>(memory);
  for (size_t at = 0; at < bytes; at += sizeof(kPattern))
    memcpy(to + at, &kPattern, std::min(bytes - at, sizeof(kPattern)));
}

bool is_first_use(const void* shared) {
  if (std::find(used.begin(), used.end(), shared) != used.end()) return false;
  used.push_back(shared);
  return true;
}

void fail(const char* what, Place place) {
  fprintf(stderr, "%s:%d: %s (block %u, thread %u)\n", place.file, place.line, what, blockIdx.x, running);
  abort();
}

}  // namespace emulator
