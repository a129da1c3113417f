// Selection of the kernels of one instruction set.
#pragma once

#include "kernels.h"

namespace gsplat {

// The instruction set in use, set once at import or by name in tests. Throws std::invalid_argument with a reason.
const Isa &isa();
void choose_isa(const char *name);
// Names of the instruction sets that this build has and this machine runs, best last.
int list_isas(const char **names, int capacity);

template <class T>
const Kernels<T> &kernels();

}  // namespace gsplat
