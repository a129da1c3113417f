#include "system.h"

#include <chrono>
#include <stdexcept>

#if defined(_WIN32)
#define WIN32_LEAN_AND_MEAN
#define NOMINMAX
#include <windows.h>

#include <malloc.h>
#else
#include <pthread.h>
#include <time.h>
#include <unistd.h>

#include <cstdlib>
#endif

namespace gsplat {

double wall_seconds() { return std::chrono::duration<double>(std::chrono::steady_clock::now().time_since_epoch()).count(); }

void refuse(const char *reason) { throw std::length_error(reason); }

#if defined(_WIN32)

bool after_fork_in_child(void (*)()) { return true; }

int64_t process_id() { return int64_t(GetCurrentProcessId()); }

double thread_seconds() {
    FILETIME started, ended, kernel, user;  // in units of 100 ns
    if (!GetThreadTimes(GetCurrentThread(), &started, &ended, &kernel, &user)) return 0;
    const auto units = [](const FILETIME &time) { return double(uint64_t(time.dwHighDateTime) << 32 | time.dwLowDateTime); };
    return 1e-7 * (units(kernel) + units(user));
}

void *allocate_pages(size_t bytes) { return _aligned_malloc(bytes, 4096); }
void free_pages(void *pages) { _aligned_free(pages); }

#else

bool after_fork_in_child(void (*function)()) {
    pthread_atfork(nullptr, nullptr, function);
    return true;
}

int64_t process_id() { return int64_t(getpid()); }

double thread_seconds() {
    timespec now{};
    clock_gettime(CLOCK_THREAD_CPUTIME_ID, &now);
    return double(now.tv_sec) + 1e-9 * double(now.tv_nsec);
}

void *allocate_pages(size_t bytes) {
    void *pages = nullptr;  // older macOS has no aligned_alloc
    return posix_memalign(&pages, 4096, bytes) ? nullptr : pages;
}
void free_pages(void *pages) { std::free(pages); }

#endif

}  // namespace gsplat
