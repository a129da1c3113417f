// The loss of a whole image, computed band by band.
#pragma once

#include "kernels.h"

namespace gsplat {

// (1 - k) L1 + k (1 - SSIM): returns the two means and writes the gradient to args.grad. Provides sums and scratch.
template <class T>
void loss(LossArgs<T> args, double *l1, double *ssim, int threads);

}  // namespace gsplat
