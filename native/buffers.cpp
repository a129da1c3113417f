#include "buffers.h"

#include <algorithm>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <mutex>
#include <new>
#include <utility>
#include <vector>

#include "system.h"

namespace gsplat {
namespace {

constexpr size_t MAX_SPARES = 32;
constexpr size_t LARGE_BLOCK = size_t(256) << 20;

FreeMemory free_memory = nullptr;

class OutOfMemory : public std::bad_alloc {
  public:
    OutOfMemory(size_t bytes, int64_t free) {
        const double gib = 1.0 / double(1 << 30);
        std::snprintf(text_, sizeof text_, "the renderer needs a block of %.2f GiB, but %.2f GiB are free", double(bytes) * gib,
                      double(free) * gib);
    }
    const char *what() const noexcept override { return text_; }

  private:
    char text_[128];
};

void check_room(size_t bytes) {
    if (bytes < LARGE_BLOCK || !free_memory) return;
    const int64_t free = free_memory();
    if (free >= 0 && bytes > size_t(free)) throw OutOfMemory(bytes, free);
}

struct Spare {
    void *data;
    size_t capacity;
};

// Spare blocks live as long as the process, since frames may be freed during exit.
// A forked child gets a new mutex: the thread that held the old one may not exist there.
std::mutex *spares_lock = new std::mutex;
[[maybe_unused]] const bool registered = after_fork_in_child([] { spares_lock = new std::mutex; });

std::vector<Spare> &spares() {
    static auto *list = [] {
        auto *made = new std::vector<Spare>;
        made->reserve(MAX_SPARES + 2);  // a destructor appends to it and must not throw
        return made;
    }();
    return *list;
}

}  // namespace

void ask_before_large_blocks(FreeMemory function) { free_memory = function; }

#ifdef GSPLAT_SANITIZE
// Exact sizes and real frees, so that the sanitizer sees every overrun; filled with garbage that no kernel may rely on.
Buffer::~Buffer() { std::free(data_); }

void *Buffer::reserve(size_t bytes) {
    std::free(std::exchange(data_, nullptr));
    check_room(bytes);
    data_ = std::malloc(bytes);
    if (!data_) throw std::bad_alloc();
    std::memset(data_, 0xFF, bytes);
    return data_;
}
#else
Buffer::~Buffer() {
    if (!data_) return;
    std::lock_guard<std::mutex> lock(*spares_lock);
    spares().push_back({data_, capacity_});
    if (spares().size() > MAX_SPARES) {
        auto smallest =
            std::min_element(spares().begin(), spares().end(), [](const Spare &a, const Spare &b) { return a.capacity < b.capacity; });
        free_pages(smallest->data);
        spares().erase(smallest);
    }
}

void *Buffer::reserve(size_t bytes) {
    if (data_ && capacity_ >= bytes) return data_;
    std::unique_lock<std::mutex> lock(*spares_lock);
    if (data_) spares().push_back({std::exchange(data_, nullptr), capacity_});
    auto best = spares().end();
    for (auto it = spares().begin(); it != spares().end(); ++it)
        if (it->capacity >= bytes && (best == spares().end() || it->capacity < best->capacity)) best = it;
    if (best != spares().end() && best->capacity <= 4 * bytes + (1 << 20)) {
        data_ = best->data, capacity_ = best->capacity;
        spares().erase(best);
        return data_;
    }
    // No spare fits: grow the largest one instead of keeping both.
    auto grow = spares().end();
    for (auto it = spares().begin(); it != spares().end(); ++it)
        if (it->capacity < bytes && (grow == spares().end() || it->capacity > grow->capacity)) grow = it;
    if (grow != spares().end()) {
        free_pages(grow->data);
        spares().erase(grow);
    }
    lock.unlock();  // the query may wait for Python, which may wait for this lock
    const size_t rounded = (bytes + bytes / 4 + 4095) / 4096 * 4096;
    check_room(rounded);
    data_ = allocate_pages(rounded);
    if (!data_) throw std::bad_alloc();
    capacity_ = rounded;
    return data_;
}
#endif

}  // namespace gsplat
