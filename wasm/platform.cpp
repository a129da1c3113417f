// What native/system.h, buffers.h, threads.h and dispatch.h promise, in a WebAssembly module. The host gives it two functions:
// `refuse`, which does not return, and `now`, milliseconds. After a refusal the module is not used again.
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

void parallel(int, int64_t count, const Task &task) {
    for (int64_t i = 0; i < count; ++i) task(i, 0);
}

}  // namespace gsplat
