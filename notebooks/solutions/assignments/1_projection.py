"""Assignment 1, projection: from the world to an ellipse on the image. For chapters 03 and 04; 10 points.

Write the functions, then run: gsplat-edu grade notebooks/assignments/1_projection.py
"""

import numpy as np

ASSIGNMENT = "projection"


def to_camera(points, R, eye):
    """Return (N, 3) points of the world in the axes of a camera: right, down, forward.

    The rows of R (3, 3) are the camera's axes in the world, and eye (3,) is where it is.
    """
    return (points - eye) @ R.T


def project(points, fx, fy, cx, cy):
    """Return the pixels (N, 2) of points (N, 3) in the camera's axes; (cx, cy) is the image's centre."""
    x, y, z = points.T
    return np.stack([fx * x / z + cx, fy * y / z + cy], axis=-1)


def covariance(scales, quat):
    """Return the covariance (3, 3) of a Gaussian with the standard deviations scales (3,).

    quat (4,) is its rotation: w, x, y, z, of any length but 0.
    """
    w, x, y, z = quat / np.linalg.norm(quat)
    R = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
    return (R * np.square(scales)) @ R.T


def footprint(cov, point, fx, fy):
    """Return the covariance (2, 2), px², of a splat on the image, dilated by 0.3 px².

    cov (3, 3) and the mean, point (3,), are in the camera's axes; the projection is linear at the mean.
    """
    x, y, z = point
    J = np.array([[fx / z, 0, -fx * x / z**2], [0, fy / z, -fy * y / z**2]])
    return J @ cov @ J.T + 0.3 * np.eye(2)
