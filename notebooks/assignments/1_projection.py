"""Assignment 1, projection: from the world to an ellipse on the image. For chapters 03 and 04; 10 points.

Write the functions, then run: gsplat-edu grade notebooks/assignments/1_projection.py
"""

import numpy as np

ASSIGNMENT = "projection"


def to_camera(points, R, eye):
    """Return (N, 3) points of the world in the axes of a camera: right, down, forward.

    The rows of R (3, 3) are the camera's axes in the world, and eye (3,) is where it is.
    """
    raise NotImplementedError("write to_camera")


def project(points, fx, fy, cx, cy):
    """Return the pixels (N, 2) of points (N, 3) in the camera's axes; (cx, cy) is the image's centre."""
    raise NotImplementedError("write project")


def covariance(scales, quat):
    """Return the covariance (3, 3) of a Gaussian with the standard deviations scales (3,).

    quat (4,) is its rotation: w, x, y, z, of any length but 0.
    """
    raise NotImplementedError("write covariance")


def footprint(cov, point, fx, fy):
    """Return the covariance (2, 2), px², of a splat on the image, dilated by 0.3 px².

    cov (3, 3) and the mean, point (3,), are in the camera's axes; the projection is linear at the mean.
    """
    raise NotImplementedError("write footprint")
