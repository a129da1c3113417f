// The calls of the native module that 2D Gaussians need.
#pragma once

#include <nanobind/nanobind.h>

namespace gsplat { void bind_surfels(nanobind::module_ &m); }  // namespace gsplat
