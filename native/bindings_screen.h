// The calls of the native module that gsplat's interface needs.
#pragma once

#include <nanobind/nanobind.h>

namespace gsplat { void bind_screen(nanobind::module_ &m); }  // namespace gsplat
