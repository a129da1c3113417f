// A pool of threads that runs numbered tasks. Which thread runs which task is open; kernels do not care.
#pragma once

#include <cstdint>
#include <functional>

namespace gsplat {

// Runs task(0, worker) .. task(count - 1, worker) on up to `threads` threads, the caller among them, and waits for all.
// Tasks do not throw. `worker` is below `threads`, and no two tasks run at once on the same one.
using Task = std::function<void(int64_t, int)>;
void parallel(int threads, int64_t count, const Task &task);

}  // namespace gsplat
