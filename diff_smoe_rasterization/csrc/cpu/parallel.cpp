// The pool of threads. It grows to the most threads that a call has asked for. Its threads sleep between calls.
#include "parallel.h"

#include <pthread.h>

#include <algorithm>
#include <atomic>
#include <condition_variable>
#include <deque>
#include <exception>
#include <mutex>
#include <system_error>
#include <thread>

namespace dsmoe {
namespace cpu {
namespace {

// One call of run_threads. The pool's mutex guards what changes.
struct Job {
  const std::function<void(int)>& worker;
  const int count;
  int next = 0;                          // the first index that no thread has taken
  int running = 0;                       // indices that are taken and still run
  std::exception_ptr failure = nullptr;  // the first
};

class Pool {
 public:
  void run(int count, const std::function<void(int)>& worker) {
    Job job = {worker, count};
    std::unique_lock<std::mutex> lock(mutex_);
    grow(count - 1);
    jobs_.push_back(&job);
    for (int k = 1; k < count; ++k) job_waits_.notify_one();
    while (job.next < job.count) run_next(job, lock);
    job_ends_.wait(lock, [&] { return job.running == 0; });
    if (job.failure) std::rethrow_exception(job.failure);
  }

 private:
  // If no more threads can be had, the calling thread does their share.
  void grow(int num_threads) {
    try {
      for (; num_threads_ < num_threads; ++num_threads_) std::thread([this] { serve(); }).detach();
    } catch (const std::system_error&) {
    }
  }

  [[noreturn]] void serve() {
    std::unique_lock<std::mutex> lock(mutex_);
    for (;;) {
      job_waits_.wait(lock, [&] { return !jobs_.empty(); });
      run_next(*jobs_.front(), lock);
    }
  }

  // Takes the job's next index and runs it without the lock.
  void run_next(Job& job, std::unique_lock<std::mutex>& lock) {
    const int index = job.next++;
    ++job.running;
    if (job.next == job.count) jobs_.erase(std::find(jobs_.begin(), jobs_.end(), &job));
    lock.unlock();
    std::exception_ptr failure;
    try {
      job.worker(index);
    } catch (...) {
      failure = std::current_exception();
    }
    lock.lock();
    if (!job.failure) job.failure = failure;
    if (--job.running == 0) job_ends_.notify_all();
  }

  std::mutex mutex_;
  std::condition_variable job_waits_, job_ends_;
  std::deque<Job*> jobs_;  // with indices that no thread has taken
  int num_threads_ = 0;
};

// Never freed: its threads sleep in it until the process ends.
std::atomic<Pool*> process_pool{nullptr};

Pool& pool() {
  // A forked child has none of the threads: it makes a pool of its own.
  static const int forgets_in_child = pthread_atfork(nullptr, nullptr, [] { process_pool = nullptr; });
  static_cast<void>(forgets_in_child);
  Pool* found = process_pool;
  if (found != nullptr) return *found;
  Pool* made = new Pool;
  if (process_pool.compare_exchange_strong(found, made)) return *made;
  delete made;  // another thread was first
  return *found;
}

}  // namespace

void run_threads(int num_threads, const std::function<void(int)>& worker) {
  if (num_threads <= 1) return worker(0);
  pool().run(num_threads, worker);
}

}  // namespace cpu
}  // namespace dsmoe
