"""Drags of the handle in the editor's picture, and where the page shows it."""

import numpy as np
from scipy.spatial.transform import Rotation

from waiting import until_in

ARROW, RING = 88, 64
"""CSS pixels: length of the arrows and radius of the rings."""

SHAPE = "editor.tools.shape"


class Scale:
    """Where the page shows points, and the world units of a CSS pixel at a depth. The page has one device pixel per
    CSS pixel."""

    def __init__(self, shown):
        self.camera = shown.camera()

    def place(self, point):
        """Return the CSS pixel of a point: that of the middle of pixel (0, 0) is (0.5, 0.5)."""
        x, y, z = self.camera.R @ (np.asarray(point) - self.camera.eye)
        return (
            np.array([self.camera.fx * x / z + self.camera.cx, self.camera.fy * y / z + self.camera.cy]) + 0.5
        )

    def pixel(self, point):
        return float((self.camera.R @ (np.asarray(point) - self.camera.eye))[2] / self.camera.fx)


def shape(shown):
    found = shown.tab.evaluate(SHAPE)
    return {name: np.array(value) for name, value in found.items()}


def about(axis, angle):
    return Rotation.from_rotvec(np.asarray(axis) * angle).as_matrix()


def until(tab, expression):
    """Wait until an expression is true in a page."""
    until_in(tab, tab, expression)
