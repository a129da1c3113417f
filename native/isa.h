// Declarations of one instruction set's kernels, for its table.
#pragma once

#include "kernels.h"

namespace gsplat {
namespace GSPLAT_ISA {

template <class T> void project(const ProjectArgs<T> &, int64_t block);
template <class T> void count(const IntersectArgs<T> &, int64_t begin, int64_t end, uint32_t *per_tile);
template <class T> void scatter(const IntersectArgs<T> &, int64_t begin, int64_t end, uint32_t *next);
template <class T> void composite(const CompositeArgs<T> &, int32_t tile);
template <class T> void composite_backward(const CompositeBackwardArgs<T> &, int32_t tile);
template <class T> void project_backward(const ProjectBackwardArgs<T> &, int64_t block);
template <class T> void loss(const LossArgs<T> &, int64_t task, T *scratch);
template <class T> void noise(const NoiseArgs<T> &, int64_t begin, int64_t end);
template <class T> void recolor(const RecolorArgs<T> &, int64_t task);
template <class T> void recolor_backward(const RecolorArgs<T> &, int64_t task);
template <class T> void surface_depths(const SurfaceArgs<T> &, int64_t row);
template <class T> void surface_tangents(const SurfaceArgs<T> &, int64_t row);
template <class T> void surface_gradient(const SurfaceArgs<T> &, int64_t row);
template <class T> void normals(const NormalArgs<T> &, int64_t block);
template <class T> void normals_backward(const NormalArgs<T> &, int64_t block);
template <class T> void screen(const ScreenArgs<T> &, int64_t block);
template <class T> void screen_backward(const ScreenArgs<T> &, int64_t block);
template <class T> void radii(const RadiusArgs<T> &, int64_t begin, int64_t end);
template <class T> void harmonic_colors(const HarmonicArgs<T> &, int64_t block);
template <class T> void harmonic_colors_backward(const HarmonicArgs<T> &, int64_t block);
template <class T> void surfels(const SurfelArgs<T> &, int64_t tile, T *scratch);
template <class T> void surfels_backward(const SurfelArgs<T> &, int64_t tile, T *scratch);
template <class T> void adam(const AdamArgs<T> &, int64_t begin, int64_t end);
template <class T> void adam_backward(const AdamBackwardArgs<T> &, int64_t block, T *scratch);

}  // namespace GSPLAT_ISA
}  // namespace gsplat
