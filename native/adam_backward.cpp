// adam_backward: project_backward and a step of Adam, a block of Gaussians at a time.
//
// The gradients of a block stay in a scratch array that the processor's cache holds. The arithmetic is that of the two
// kernels on their own, so the bits are the same.
#include "isa.h"

namespace gsplat {
namespace GSPLAT_ISA {

template <class T>
void adam_backward(const AdamBackwardArgs<T> &args, int64_t block, T *scratch) {
    const int64_t begin = block * BLOCK, rest = args.backward.scene.n - begin, count = rest < BLOCK ? rest : BLOCK;
    T *gradients[GROUPS];
    for (int g = 0; g < GROUPS; ++g) gradients[g] = scratch, scratch += BLOCK * args.widths[g];
    ProjectBackwardArgs<T> backward = args.backward;
    SceneGrads<T> &grads = backward.grads;
    grads.means = gradients[MEANS], grads.quats = gradients[QUATS], grads.log_scales = gradients[LOG_SCALES];
    grads.sh0 = gradients[SH0], grads.sh_rest = gradients[SH_REST], grads.logit_opacities = gradients[LOGIT_OPACITIES];
    grads.first = begin;
    project_backward(backward, block);
    for (int g = 0; g < GROUPS; ++g) {
        const int64_t row = begin * args.widths[g];
        AdamArgs<T> group = args.groups[g];
        group.parameter += row, group.first += row, group.second += row, group.gradient = gradients[g];
        if (group.extra) group.extra += row;
        adam(group, 0, count * args.widths[g]);
    }
}

template void adam_backward<float>(const AdamBackwardArgs<float> &, int64_t, float *);
template void adam_backward<double>(const AdamBackwardArgs<double> &, int64_t, double *);

}  // namespace GSPLAT_ISA
}  // namespace gsplat
