"""Assignment 3, the chain of gradients: from a pixel back to a splat. For chapters 08, 12 and 13; 10 points.

Write the functions, then run: gsplat-edu grade notebooks/assignments/3_gradients.py
"""

import numpy as np

ASSIGNMENT = "gradients"


def alpha_gradient(dx, dy, conic, opacity):
    """Return the derivatives (2,) of a splat's alpha by dx and dy.

    The alpha is opacity exp(-(A dx² + 2 B dx dy + C dy²) / 2), without limit and floor; conic is A, B, C.
    """
    raise NotImplementedError("write alpha_gradient")


def layer_gradient(alphas, colors, background, g):
    """Return the derivatives (N,) of a loss by the alphas (N,) of layers, from near to far.

    colors is (N, 3), background (3,); g (3,) is the derivative of the loss by the pixel's colour.
    """
    raise NotImplementedError("write layer_gradient")


def inverse_gradient(gradient, cov):
    """Return the derivatives (2, 2) of a loss by the entries of cov (2, 2), from those by its inverse's."""
    raise NotImplementedError("write inverse_gradient")


def unit_gradient(gradient, quat):
    """Return the derivatives (4,) of a loss by a quaternion, from those by the unit quaternion quat / |quat|."""
    raise NotImplementedError("write unit_gradient")
