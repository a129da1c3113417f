// The class Volume of the module: native/volume.h for Python.
#pragma once

#include <nanobind/nanobind.h>

namespace gsplat { void bind_volume(nanobind::module_ &m); }  // namespace gsplat
