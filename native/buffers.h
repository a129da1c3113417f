// Memory of frames, reused after they are gone.
#pragma once

#include <cstddef>
#include <cstdint>

namespace gsplat {

// Called before a large block is allocated: returns the free bytes, negative if unknown. It may throw. Initially none.
using FreeMemory = int64_t (*)();
void ask_before_large_blocks(FreeMemory free_memory);

// Memory that is kept when its owner is destroyed and given to the next one, so that frames of changing size do not grow
// the process.
class Buffer {
  public:
    Buffer() = default;
    ~Buffer();
    Buffer(const Buffer &) = delete;
    Buffer &operator=(const Buffer &) = delete;
    // At least `bytes`; previous contents are lost. Throws std::bad_alloc, for a large block also if the system would
    // overcommit.
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
