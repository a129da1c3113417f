"""Assignment 2, compositing: from splats to the colour of a pixel. For chapters 02 and 05; 10 points.

Write the functions, then run: gsplat-edu grade notebooks/assignments/2_compositing.py
"""

import numpy as np

ASSIGNMENT = "compositing"


def alpha(dx, dy, conic, opacity):
    """Return the alpha of a splat, (dx, dy) px from its centre.

    conic is A, B, C of A dx² + 2 B dx dy + C dy². At most 0.99; what is below 1/255 is 0.
    """
    raise NotImplementedError("write alpha")


def order(depths):
    """Return the indices of splats with these depths (N,) from near to far; equal depths stay in their order."""
    raise NotImplementedError("write order")


def composite(alphas, colors, background):
    """Return the colour (3,) of a pixel behind layers with alphas (N,) and colors (N, 3), from near to far."""
    raise NotImplementedError("write composite")
