// A thread pool that runs numbered tasks. The assignment of tasks to threads is unspecified.
#pragma once

#include <cstdint>
#include <functional>

namespace gsplat {

// Runs task(0, worker) .. task(count - 1, worker) on up to `threads` threads, including the caller, and waits for all.
// Tasks do not throw; denormal numbers are zero to them. `worker` is below `threads`, and no two tasks run on the same worker at once.
using Task = std::function<void(int64_t, int)>;
void parallel(int threads, int64_t count, const Task &task);

// Seconds of processor time of this thread in calls of `parallel`, and how many calls there were.
struct ParallelTime {
    double seconds = 0;
    int64_t calls = 0;
};
const ParallelTime &parallel_time();

}  // namespace gsplat
