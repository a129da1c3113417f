// The calls of the native module that surfaces need.
#pragma once

#include <nanobind/nanobind.h>

namespace gsplat { void bind_surface(nanobind::module_ &m); }  // namespace gsplat
