// adam: one pass over a parameter and its moments.
//
//     m = b1 m + (1 - b1) g;   v = b2 v + (1 - b2) g²;   p -= rate (m / c1) / (sqrt(v / c2) + eps)
#include "gaussian_math.h"
#include "isa.h"

namespace gsplat {
namespace GSPLAT_ISA {

template <bool EXTRA, class T>
GSPLAT_INLINE void step(const AdamArgs<T> &a, int64_t begin, int64_t end) {
    const AdamNumbers &n = a.numbers;
    const T b1 = T(n.beta1), b2 = T(n.beta2), n1 = T(1 - n.beta1), n2 = T(1 - n.beta2);
    const T rate = T(n.rate), eps = T(n.eps), c1 = T(1 / n.correction1), c2 = T(1 / n.correction2);
#if defined(__clang__)
#pragma clang loop vectorize(assume_safety)
#else
#pragma GCC ivdep
#endif
    for (int64_t i = begin; i < end; ++i) {
        const T g = EXTRA ? a.gradient[i] + a.extra[i] : a.gradient[i];
        const T m = b1 * a.first[i] + n1 * g, v = b2 * a.second[i] + n2 * g * g;
        a.first[i] = m, a.second[i] = v;
        a.parameter[i] -= rate * (m * c1) / (sqrt_(v * c2) + eps);
    }
}

template <class T>
void adam(const AdamArgs<T> &a, int64_t begin, int64_t end) {
    a.extra ? step<true>(a, begin, end) : step<false>(a, begin, end);
}

template void adam<float>(const AdamArgs<float> &, int64_t, int64_t);
template void adam<double>(const AdamArgs<double> &, int64_t, int64_t);

}  // namespace GSPLAT_ISA
}  // namespace gsplat
