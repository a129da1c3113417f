// The table of one instruction set's kernels.
#include "gaussian_math.h"
#include "isa.h"
#include "tile.h"

#define GSPLAT_TEXT_(x) #x
#define GSPLAT_TEXT(x) GSPLAT_TEXT_(x)

namespace gsplat {
namespace GSPLAT_ISA {

template <class T>
static constexpr Kernels<T> kernels() {
    return {project<T>,
            count<T>,
            scatter<T>,
            composite<T>,
            composite_backward<T>,
            project_backward<T>,
            adam<T>,
            adam_backward<T>,
            loss<T>,
            noise<T>,
            recolor<T>,
            recolor_backward<T>,
            surface_depths<T>,
            surface_tangents<T>,
            surface_gradient<T>,
            normals<T>,
            normals_backward<T>,
            screen<T>,
            screen_backward<T>,
            radii<T>,
            harmonic_colors<T>,
            harmonic_colors_backward<T>,
            surfels<T>,
            surfels_backward<T>,
            KEEPS_ROWS ? int64_t(sizeof(KeptRows<T>)) : 0};
}

// Twelve independent chains of vector FMAs, enough to hide their latency and few enough for sixteen registers: a
// unit of cost for this machine. (An array of chains would be kept in memory.)
static int fma_benchmark(int64_t rounds, float *sink) {
    const VF m = splat(0.999f), t = splat(1e-3f);
    VF a = t, b = a + t, c = b + t, d = c + t, e = d + t, f = e + t, g = f + t, h = g + t, i = h + t, j = i + t, k = j + t, l = k + t;
    for (int64_t r = 0; r < rounds; ++r) {
        a = a * m + t, b = b * m + t, c = c * m + t, d = d * m + t, e = e * m + t, f = f * m + t;
        g = g * m + t, h = h * m + t, i = i * m + t, j = j * m + t, k = k * m + t, l = l * m + t;
    }
    *sink = sum(((a + b) + (c + d)) + ((e + f) + (g + h)) + ((i + j) + (k + l)));
    return 12;
}

extern const Isa table;
const Isa table = {GSPLAT_TEXT(GSPLAT_ISA), kernels<float>(), kernels<double>(), fma_benchmark};

}  // namespace GSPLAT_ISA
}  // namespace gsplat
