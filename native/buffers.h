// Memory of frames, which outlives them.
#pragma once

#include <cstddef>
#include <cstdint>

namespace gsplat {

// What is asked before a large block is allocated: the bytes that are free, negative where nobody knows. It may throw.
// None at first.
using FreeMemory = int64_t (*)();
void ask_before_large_blocks(FreeMemory free_memory);

// Memory that is kept when its owner goes and handed to the next one that asks, so that frames of changing size do
// not grow the process.
class Buffer {
  public:
    Buffer() = default;
    ~Buffer();
    Buffer(const Buffer &) = delete;
    Buffer &operator=(const Buffer &) = delete;
    // At least `bytes`; what was in it is lost. Throws std::bad_alloc, for a large block also where the system would
    // grant memory that it does not have.
    void *reserve(size_t bytes);
    template <class T>
    T *as() const {
        return static_cast<T *>(data_);
    }

  private:
    void *data_ = nullptr;
    size_t capacity_ = 0;
};

}  // namespace gsplat
