// The loss of a whole image, band by band.
#pragma once

#include "kernels.h"

namespace gsplat {

// (1 - k) L1 + k (1 - SSIM): the two means, and the gradient to args.grad. Sums and scratch are provided.
template <class T>
void loss(LossArgs<T> args, double *l1, double *ssim, int threads);

}  // namespace gsplat
