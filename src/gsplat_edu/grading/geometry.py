"""Assignment 1: from the world to an ellipse on the image.

It follows chapters 03 and 04.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from gsplat_edu.base.constants import DILATION
from gsplat_edu.grading.assignment import Answer, Part
from gsplat_edu.scene.camera import Camera
from gsplat_edu.scene.gaussian_math import build_cov3d, project_cov3d, quat_to_R

CASES = 4
"""Calls of a function."""


def _to_camera_cases(draws: np.random.Generator) -> Sequence[tuple[Any, ...]]:
    return [
        (draws.normal(size=(n, 3)), quat_to_R(draws.normal(size=4)), draws.normal(size=3))
        for n in range(1, CASES + 1)
    ]


def _project_cases(draws: np.random.Generator) -> Sequence[tuple[Any, ...]]:
    return [
        (
            draws.normal((0, 0, 6), size=(n, 3)),
            draws.uniform(80, 120),
            draws.uniform(150, 200),
            draws.uniform(30, 50),
            draws.uniform(60, 90),
        )
        for n in range(1, CASES + 1)
    ]


def _project(points: np.ndarray, fx: float, fy: float, cx: float, cy: float) -> Answer:
    x, y, z = np.asarray(points).T
    return np.stack([fx * x / z + cx, fy * y / z + cy], axis=-1)


def _covariance_cases(draws: np.random.Generator) -> Sequence[tuple[Any, ...]]:
    return [(draws.uniform(0.1, 2, 3), draws.normal(size=4)) for _ in range(CASES)]


def _turned(scales: np.ndarray, R: np.ndarray) -> Answer:
    return R @ np.diag(np.square(scales)) @ R.T


def _unnormalised(scales: np.ndarray, quat: np.ndarray) -> Answer:
    w, x, y, z = quat
    R = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
    return _turned(scales, R)


def _footprint_cases(draws: np.random.Generator) -> Sequence[tuple[Any, ...]]:
    return [
        (
            build_cov3d(draws.uniform(0.1, 0.5, 3), quat_to_R(draws.normal(size=4))),
            draws.normal((1, 2, 6)),
            draws.uniform(80, 120),
            draws.uniform(150, 200),
        )
        for _ in range(CASES)
    ]


def _jacobian(point: np.ndarray, fx: float, fy: float) -> Answer:
    x, y, z = point
    return np.array([[fx / z, 0, -fx * x / z**2], [0, fy / z, -fy * y / z**2]])


def _footprint(cov: np.ndarray, point: np.ndarray, fx: float, fy: float) -> Answer:
    camera = Camera(np.eye(3), np.zeros(3), fx, fy, 0.0, 0.0, 1, 1)
    return project_cov3d(cov, point, camera) + DILATION * np.eye(2)


def _without_dilation(cov: np.ndarray, point: np.ndarray, fx: float, fy: float) -> Answer:
    return _footprint(cov, point, fx, fy) - DILATION * np.eye(2)


def _without_depth(cov: np.ndarray, point: np.ndarray, fx: float, fy: float) -> Answer:
    J = _jacobian(point, fx, fy) * [1, 1, 0]
    return J @ cov @ J.T + DILATION * np.eye(2)


def _depth_with_a_plus(cov: np.ndarray, point: np.ndarray, fx: float, fy: float) -> Answer:
    J = _jacobian(point, fx, fy) * [1, 1, -1]
    return J @ cov @ J.T + DILATION * np.eye(2)


PARTS = (
    Part(
        "to_camera",
        2,
        _to_camera_cases,
        lambda points, R, eye: (points - eye) @ R.T,
        {
            "the eye is subtracted after the rotation; subtract it before": lambda points, R, eye: (
                points @ R.T - eye
            ),
            "the rotation is the inverse: R's rows are the camera's axes": lambda points, R, eye: (
                (points - eye) @ R
            ),
        },
    ),
    Part(
        "project",
        2,
        _project_cases,
        _project,
        {
            "nothing is divided by the depth": lambda points, fx, fy, cx, cy: (
                points[:, :2] * [fx, fy] + [cx, cy]
            ),
            "the image's centre, (cx, cy), is not added": lambda points, fx, fy, cx, cy: _project(
                points, fx, fy, 0, 0
            ),
            "the focal lengths are swapped: fx belongs to x": lambda points, fx, fy, cx, cy: _project(
                points, fy, fx, cx, cy
            ),
        },
    ),
    Part(
        "covariance",
        3,
        _covariance_cases,
        lambda scales, quat: build_cov3d(scales, quat_to_R(quat)),
        {
            "the scales are not squared: they are standard deviations": lambda scales, quat: _turned(
                np.sqrt(scales), quat_to_R(quat)
            ),
            "the rotation is on the wrong side: it is R S Sᵀ Rᵀ": lambda scales, quat: _turned(
                scales, quat_to_R(quat).T
            ),
            "the quaternion is not normalised": _unnormalised,
            "the quaternion's order is w, x, y, z": lambda scales, quat: _turned(
                scales, quat_to_R([quat[3], *quat[:3]])
            ),
        },
    ),
    Part(
        "footprint",
        3,
        _footprint_cases,
        _footprint,
        {
            f"the dilation of {DILATION} px² is missing on the diagonal": _without_dilation,
            "the Jacobian's third column is missing: moving away moves a point, too": _without_depth,
            "the Jacobian's third column has the wrong sign": _depth_with_a_plus,
        },
    ),
)
"""The functions of the assignment: `to_camera`, `project`, `covariance` and `footprint`."""
