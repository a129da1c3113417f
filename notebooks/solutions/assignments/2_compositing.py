"""Assignment 2, compositing: from splats to the colour of a pixel. For chapters 02 and 05; 10 points.

Write the functions, then run: gsplat-edu grade notebooks/assignments/2_compositing.py
"""

import numpy as np

ASSIGNMENT = "compositing"


def alpha(dx, dy, conic, opacity):
    """Return the alpha of a splat, (dx, dy) px from its centre.

    conic is A, B, C of A dx² + 2 B dx dy + C dy². At most 0.99; what is below 1/255 is 0.
    """
    A, B, C = conic
    value = min(opacity * np.exp(-0.5 * (A * dx * dx + 2 * B * dx * dy + C * dy * dy)), 0.99)
    return value if value >= 1 / 255 else 0.0


def order(depths):
    """Return the indices of splats with these depths (N,) from near to far; equal depths stay in their order."""
    return np.argsort(depths, kind="stable")


def composite(alphas, colors, background):
    """Return the colour (3,) of a pixel behind layers with alphas (N,) and colors (N, 3), from near to far."""
    light, color = 1.0, np.zeros(3)
    for a, c in zip(alphas, colors, strict=True):
        color = color + light * a * c
        light = light * (1 - a)
    return color + light * background
