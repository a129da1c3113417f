// What native/system.h, buffers.h, threads.h and dispatch.h promise, in a WebAssembly module. The host gives it two functions:
// `refuse`, which does not return, and `now`, milliseconds. After a refusal the module is not used again.
//
// It is built twice: for one thread, and with GSPLAT_THREADS for several, which need a page that may share memory. Then every worker of
// the host has an instance of the module with the same memory, a stack of its own, and calls `work`, which does not return.
#include <algorithm>
#include <atomic>
#include <cstdlib>
#include <cstring>
#include <new>
#include <utility>

#include "../native/buffers.h"
#include "../native/dispatch.h"
#include "../native/system.h"
#include "../native/threads.h"

extern "C" {
__attribute__((import_module("host"), import_name("refuse"))) void host_refuse(const char *reason, size_t length);
__attribute__((import_module("host"), import_name("now"))) double host_now();
}

namespace gsplat {
namespace wasm { extern const Isa table; }

void refuse(const char *reason) {
    host_refuse(reason, std::strlen(reason));
    __builtin_trap();
}

[[maybe_unused]] const std::new_handler before = std::set_new_handler([] { refuse("there is not enough memory"); });

double wall_seconds() { return 1e-3 * host_now(); }
double thread_seconds() { return wall_seconds(); }

// Freed blocks go back to the allocator of the module, which merges neighbours; a fresh page costs nothing here.
Buffer::~Buffer() { std::free(data_); }

void *Buffer::reserve(size_t bytes) {
    if (data_ && capacity_ >= bytes) return data_;
    std::free(std::exchange(data_, nullptr));
    capacity_ = (bytes + bytes / 4 + 63) / 64 * 64;
    data_ = capacity_ < bytes ? nullptr : std::aligned_alloc(64, capacity_);
    if (!data_) refuse("there is not enough memory for this many Gaussians and pixels");
    return data_;
}

template <>
const Kernels<float> &kernels<float>() {
    return wasm::table.f32;
}
template <>
const Kernels<double> &kernels<double>() {
    return wasm::table.f64;
}

const ParallelTime &parallel_time() {
    static const ParallelTime none;
    return none;
}

#if defined(GSPLAT_THREADS)

namespace {

constexpr int32_t CLOSED = -1, FOREVER = -1;
constexpr int SPINS = 20000;

// What the workers do now. They join a round while it is open; the caller closes it when all that joined have left, and does not wait
// for those whose cores are busy.
struct Round {
    alignas(64) std::atomic<uint32_t> number{0};
    alignas(64) std::atomic<int64_t> next{0};
    alignas(64) std::atomic<int32_t> joined{CLOSED};
    alignas(64) const Task *task = nullptr;
    int64_t count = 0, claim = 1;
    int threads = 1;
};
Round current;

void drain(int worker) {
    for (int64_t begin = current.next.fetch_add(current.claim); begin < current.count; begin = current.next.fetch_add(current.claim))
        for (int64_t i = begin; i < std::min(begin + current.claim, current.count); ++i) (*current.task)(i, worker);
}

bool join() {
    for (int32_t others = current.joined.load(); others != CLOSED;)
        if (current.joined.compare_exchange_weak(others, others + 1)) return true;
    return false;
}

uint32_t *address_of(std::atomic<uint32_t> &number) { return reinterpret_cast<uint32_t *>(&number); }

}  // namespace

void parallel(int threads, int64_t count, const Task &task) {
    if (threads <= 1 || count <= 1) {
        for (int64_t i = 0; i < count; ++i) task(i, 0);
        return;
    }
    current.task = &task, current.count = count, current.threads = threads;
    current.claim = std::clamp<int64_t>(count / (32 * int64_t(threads)), 1, 8);
    current.next.store(0);
    current.joined.store(0);
    current.number.fetch_add(1);
    __builtin_wasm_memory_atomic_notify(reinterpret_cast<int32_t *>(address_of(current.number)), uint32_t(threads));
    drain(0);
    int32_t none = 0;
    while (!current.joined.compare_exchange_weak(none, CLOSED)) none = 0;
}

// Takes part in every round, as the worker of this number; the caller of `parallel` is worker 0.
extern "C" __attribute__((export_name("work"))) void work(int32_t worker) {
    for (uint32_t seen = 0;;) {
        for (int spin = 0; spin < SPINS && current.number.load() == seen;) ++spin;
        __builtin_wasm_memory_atomic_wait32(reinterpret_cast<int32_t *>(address_of(current.number)), int32_t(seen), FOREVER);
        seen = current.number.load();
        if (!join()) continue;
        if (worker < current.threads) drain(worker);
        current.joined.fetch_sub(1);
    }
}

#else

void parallel(int, int64_t count, const Task &task) {
    for (int64_t i = 0; i < count; ++i) task(i, 0);
}

#endif

}  // namespace gsplat
