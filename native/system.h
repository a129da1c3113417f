// What the native module asks of its surroundings, and nothing else does: POSIX or Windows here, a browser or node in wasm/platform.cpp.
#pragma once

#include <cstddef>
#include <cstdint>

namespace gsplat {

// Calls `function` in every child that is forked from this process; nothing where there is no fork. Returns true.
bool after_fork_in_child(void (*function)());

// Differs between a process and its forked children.
int64_t process_id();

// Seconds of processor time that this thread has taken so far; on a busy machine steadier than the time that has passed.
double thread_seconds();

// Seconds since some moment.
double wall_seconds();

// Ends the call that Python or JavaScript made with an error of this text.
[[noreturn]] void refuse(const char *reason);

// Memory at a multiple of 4096, null if there is none; `bytes` is a multiple of 4096. Only free_pages frees it.
void *allocate_pages(size_t bytes);
void free_pages(void *pages);

}  // namespace gsplat
