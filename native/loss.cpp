#include "loss.h"

#include "buffers.h"
#include "dispatch.h"
#include "threads.h"

namespace gsplat {

template <class T>
void loss(LossArgs<T> args, double *l1, double *ssim, int threads) {
    Buffer sums, scratch;
    const size_t size = size_t(args.H) * size_t(args.W) * 3;
    args.sums = static_cast<double *>(sums.reserve(size_t(args.tasks() + 1) * 2 * sizeof(double)));
    auto *room = static_cast<T *>(scratch.reserve(size_t(threads * args.SCRATCH) * sizeof(T)));
    parallel(threads, args.tasks(), [&](int64_t task, int w) { kernels<T>().loss(args, task, room + w * args.SCRATCH); });
    *l1 = *ssim = 0;
    for (int64_t k = 0; k < args.tasks(); ++k) *l1 += args.sums[2 * k], *ssim += args.sums[2 * k + 1];
    *l1 /= double(size), *ssim /= double(size);
}

template void loss<float>(LossArgs<float>, double *, double *, int);
template void loss<double>(LossArgs<double>, double *, double *, int);

}  // namespace gsplat
