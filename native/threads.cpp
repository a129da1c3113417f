#include "threads.h"

#if defined(__SSE2__)
#include <immintrin.h>
#endif

#include <algorithm>
#include <atomic>
#include <condition_variable>
#include <memory>
#include <mutex>
#include <thread>
#include <vector>

#include "system.h"

namespace gsplat {
namespace {

// Denormal numbers count as zero while this lives: each takes a hundred cycles, and gradients that are only rounding errors
// have denormal squares. Every task runs like this, on every thread.
class FlushDenormals {
  public:
#if defined(__SSE2__)
    FlushDenormals() { _mm_setcsr(before_ | 0x8040); }  // results to zero, inputs as zero
    ~FlushDenormals() { _mm_setcsr(before_); }

  private:
    unsigned before_ = _mm_getcsr();
#elif defined(__aarch64__)
    FlushDenormals() { set(before_ | uint64_t(1) << 24); }
    ~FlushDenormals() { set(before_); }

  private:
    static uint64_t get() {
        uint64_t mode;
        asm volatile("mrs %0, fpcr" : "=r"(mode));
        return mode;
    }
    static void set(uint64_t mode) { asm volatile("msr fpcr, %0" : : "r"(mode)); }
    uint64_t before_ = get();
#endif
};

// A new round number announces work. Workers spin briefly, because the next stage of a frame follows within microseconds,
// and then sleep. The pool lives as long as the process; tasks do not throw.
class Pool {
  public:
    void run(int threads, int64_t count, const Task &task) {
        while (int(workers_.size()) < threads - 1) workers_.emplace_back([this, id = int(workers_.size())] { work(id); });
        {
            std::lock_guard<std::mutex> lock(mutex_);
            task_ = &task;
            count_ = count;
            next_.store(0);
            claim_ = std::clamp<int64_t>(count / (32 * int64_t(threads)), 1, 8);
            helpers_ = threads - 1;
            open_ = true;
            round_.fetch_add(1);
        }
        wake_.notify_all();
        drain(0);
        {  // do not wait for workers that have not joined: their cores may be busy
            std::lock_guard<std::mutex> lock(mutex_);
            open_ = false;
        }
        while (active_.load() > 0) std::this_thread::yield();
    }

  private:
    // Claims several tasks at a time, so that many threads do not wait for one counter.
    void drain(int worker) {
        for (int64_t begin = next_.fetch_add(claim_); begin < count_; begin = next_.fetch_add(claim_))
            for (int64_t i = begin; i < std::min(begin + claim_, count_); ++i) (*task_)(i, worker);
    }

    void work(int id) {
        const FlushDenormals flush;
        uint64_t seen = 0;
        for (;;) {
            for (int spin = 0; spin < 2000 && round_.load() == seen; ++spin) std::this_thread::yield();
            {
                std::unique_lock<std::mutex> lock(mutex_);
                wake_.wait(lock, [&] { return round_.load() != seen; });
                seen = round_.load();
                if (!open_ || id >= helpers_) continue;
                active_.fetch_add(1);
            }
            drain(id + 1);
            active_.fetch_sub(1);
        }
    }

    std::vector<std::thread> workers_;
    std::mutex mutex_;
    std::condition_variable wake_;
    // Each on a cache line of its own: all threads write next_ while they read the others.
    alignas(64) std::atomic<uint64_t> round_{0};
    alignas(64) std::atomic<int64_t> next_{0};
    alignas(64) std::atomic<int> active_{0};
    alignas(64) const Task *task_ = nullptr;
    int64_t count_ = 0, claim_ = 1;
    int helpers_ = 0;
    bool open_ = false;
};

// Held while a round runs. A forked child gets a new mutex: the thread that held the old one may not exist there.
std::mutex *pool_mutex = new std::mutex;
[[maybe_unused]] const bool registered = after_fork_in_child([] { pool_mutex = new std::mutex; });

thread_local ParallelTime time_in_parallel;

// Adds the processor time of its lifetime; two readings of the clock per call of `parallel`, a microsecond at most.
class Clock {
  public:
    ~Clock() { time_in_parallel.seconds += thread_seconds() - start_, ++time_in_parallel.calls; }

  private:
    double start_ = thread_seconds();
};

}  // namespace

const ParallelTime &parallel_time() { return time_in_parallel; }

void parallel(int threads, int64_t count, const Task &task) {
    const Clock clock;
    const FlushDenormals flush;
    if (threads <= 1 || count <= 1) {
        for (int64_t i = 0; i < count; ++i) task(i, 0);
        return;
    }
    static Pool *pool = nullptr;
    static int64_t owner = -1;
    std::lock_guard<std::mutex> lock(*pool_mutex);
    if (owner != process_id()) {  // a forked child does not have its parent's threads
        pool = new Pool;
        owner = process_id();
    }
    pool->run(threads, count, task);
}

}  // namespace gsplat
