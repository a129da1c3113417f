"""A page's initial view: its camera, the pivot of orbits, and the up direction."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float64

from gsplat_edu.io.scene import Scene
from gsplat_edu.paths.orbits import common_up, orbit_of_scene
from gsplat_edu.scene.camera import WORLD_UP, Camera
from gsplat_edu.scene.shells import far_shell
from gsplat_edu.survey.geometry import FORWARD, INWARD, Geometry

SIDE = 800
"""Size of the initial image if there is no camera, px; the page replaces it by the window's size."""

ORBIT = 4
"""Cameras of the orbit whose centre becomes the pivot."""

CENTRAL_PART = 0.5
"""Central fraction of a camera's image, along each side, that is searched for its subject."""


MIDDLE_OF = 5
"""Only captures with at least this many cameras have a middle."""

FAR_FROM_MIDDLE = 1.25
"""A camera is at the edge if its distance from the middle exceeds this multiple of the median distance. In a closed
ring, all distances are about equal."""


SUBJECT_PART = 0.9
"""A camera sees a point if it projects into this central fraction of the image, along each side."""

SEEN_BY = 0.7
"""A point belongs to the subject if it is seen by at least this fraction of the number of cameras that see the best
point. There is no subject unless at least this fraction of all cameras sees the best point."""

OUTERMOST = (3.0, 0.1)
"""Ignore this percentage of the subject's points at the left and right side, and at the top and bottom, of an image.
A head is a small part of a person."""

AT_EDGE = 0.1
"""A subject that comes as near as this fraction of the height to the top or bottom of an image reaches it: what most
cameras see ends at `SUBJECT_PART`, but a person does not."""

MARGIN = 0.08
"""Space around the subject on each side of a picture that is fitted to it, as a fraction of the picture."""

LEAST_PART, LEAST_POINTS = 0.1, 16
"""A subject is at least this fraction of the image wide and high, and has at least this number of points."""

MOST_POINTS, MOST_CAMERAS = 4000, 40
"""Examine at most this number of points and of cameras, evenly spaced."""


@dataclass(frozen=True, eq=False)
class Start:
    """The initial view.

    Args:
        camera: The camera.
        pivot: (3,) centre of orbits.
        up: (3,) up direction, of length 1.
        index: Index of the camera in the capture; -1 if it is not from the capture.
    """

    camera: Camera
    pivot: Float64[np.ndarray, "3"]
    up: Float64[np.ndarray, "3"]
    index: int


def first_camera(cameras: Sequence[Camera], allowed: Sequence[int]) -> int:
    """Choose the camera that a page starts at: the first one, unless it is at the edge of the photographed area.

    No photo shows the area beyond the edge of a flight over fields or of an arc around an object. A window wider than
    the photo shows it at once, and a drag soon does. If the first camera is at such an edge, as it often is, the page
    starts at the camera nearest to the middle. A walk through rooms starts at its first camera.

    Args:
        cameras: Those of the capture, at least one.
        allowed: Which of them a page may start at, at least one; in order.

    Returns:
        The index of a camera.
    """
    if len(cameras) < MIDDLE_OF:
        return allowed[0]
    if Geometry(cameras, np.zeros((0, 3))).arrangement not in (FORWARD, INWARD):
        return allowed[0]
    eyes = np.stack([camera.eye for camera in cameras])
    aside = np.linalg.norm(eyes - np.median(eyes, axis=0), axis=1)
    if aside[allowed[0]] <= FAR_FROM_MIDDLE * np.median(aside):
        return allowed[0]
    return min(allowed, key=lambda index: float(aside[index]))


def subjects_of(
    cameras: Sequence[Camera], shown: Sequence[Camera], points: Float[np.ndarray, "N 3"]
) -> list[list[float] | None]:
    """Find the subject, the part that most cameras see, in images. A narrow window shows at least the subject.

    Args:
        cameras: Those of the capture; without any, every point belongs to the subject.
        shown: The cameras of the images.
        points: (N, 3) points of the scene; may be empty.

    Returns:
        For each image the left, top, right and bottom edge of the subject, px; None if there is none, as on a walk
        through rooms, or if it is behind the camera.
    """
    near = points[~far_shell(points)]
    near = near[:: max(1, len(near) // MOST_POINTS)]
    some = cameras[:: max(1, len(cameras) // MOST_CAMERAS)]
    if some and len(near):
        share = np.mean([_is_inside(camera, near, SUBJECT_PART) for camera in some], axis=0)
        near = near[share >= SEEN_BY * share.max()] if share.max() >= SEEN_BY else near[:0]
    return [_edges(camera, near) for camera in shown]


def framed(camera: Camera, subject: Sequence[float] | None, W: int, H: int) -> Camera:
    """Return a camera at the same place whose image shows the subject whole, in the middle, with a margin around it.

    It shows at least as much as the largest part of the given image that has its shape.

    Args:
        camera: A pinhole.
        subject: Left, top, right and bottom edge of the subject in its image, px; None for the middle of the image.
        W: Width of the image, px.
        H: Its height, px.
    """
    scale = max(W / camera.W, H / camera.H)
    u, v = 0.5 * camera.W, 0.5 * camera.H
    if subject is not None:
        left, top, right, bottom = subject
        share = 1.0 - 2.0 * MARGIN
        scale = min(scale, share * W / (right - left), share * H / (bottom - top))
        u, v = 0.5 * (left + right), 0.5 * (top + bottom)
    cx = (camera.cx + 0.5 - u) * scale + 0.5 * W - 0.5  # pixel centres are whole numbers
    cy = (camera.cy + 0.5 - v) * scale + 0.5 * H - 0.5
    return Camera(camera.R, camera.eye, camera.fx * scale, camera.fy * scale, cx, cy, H, W)


def contents_of(shown: Sequence[Camera], points: Float[np.ndarray, "N 3"]) -> list[list[float]]:
    """Find what views show that somebody has chosen: all points in view, whether or not they belong to the subject.

    Args:
        shown: The cameras of the views.
        points: (N, 3) points of the scene; may be empty.

    Returns:
        For each view the left, top, right and bottom edge of its content, px; those of the image if it is nearly empty.
    """
    near = points[~far_shell(points)]
    found = []
    for camera in shown:
        inside = near[_is_inside(camera, near, 1.0)]
        found.append(_edges(camera, inside) or [0.0, 0.0, float(camera.W), float(camera.H)])
    return found


def _is_inside(camera: Camera, points: Float64[np.ndarray, "N 3"], part: float) -> Bool[np.ndarray, " N"]:
    """Return which points lie in the middle part of a camera's image."""
    x, y, z = camera.world_to_cam(points).T
    across, down = 0.5 * part * camera.W / camera.fx, 0.5 * part * camera.H / camera.fy
    inside: Bool[np.ndarray, " N"] = (z > 0) & (abs(x) < across * z) & (abs(y) < down * z)
    return inside


def _edges(camera: Camera, points: Float64[np.ndarray, "N 3"]) -> list[float] | None:
    """Return the edges of points in an image without the outermost ones, inside the image."""
    x, y, z = camera.world_to_cam(points).T
    front = z > 0
    if front.sum() < LEAST_POINTS:
        return None
    edges = []
    for ratio, focal, centre, side, outermost in (
        (x, camera.fx, camera.cx, camera.W, OUTERMOST[0]),
        (y, camera.fy, camera.cy, camera.H, OUTERMOST[1]),
    ):
        ends = np.percentile(focal * ratio[front] / z[front] + centre + 0.5, (outermost, 100 - outermost))
        edges.append(np.clip(ends, 0, side))
    (left, right), (top, bottom) = edges
    if right - left < LEAST_PART * camera.W or bottom - top < LEAST_PART * camera.H:
        return None
    top = 0.0 if top < AT_EDGE * camera.H else top
    bottom = camera.H if bottom > (1 - AT_EDGE) * camera.H else bottom
    return [round(float(edge), 1) for edge in (left, top, right, bottom)]


def start_of(scene: Scene, cameras: Sequence[Camera], index: int = 0) -> Start:
    """Choose the initial view: a camera of the capture, or else the first one of an orbit around the scene.

    Args:
        scene: The scene; it may be empty.
        cameras: The capture's cameras, if any.
        index: The camera to start at.
    """
    up = None if scene.up is None else np.array(scene.up, dtype=np.float64)
    if cameras:
        opaque = scene.gaussians.logit_opacities > 0
        means = scene.gaussians.means[opaque].double().numpy(force=True)
        return start_among(cameras, index, means, up)
    up = np.array(WORLD_UP, dtype=np.float64) if up is None else up / np.linalg.norm(up)
    if len(scene.gaussians):
        orbit = orbit_of_scene(scene.gaussians, ORBIT, SIDE, up)
    else:
        orbit = [Camera.looking_at((0.0, 0.0, -1.0), np.zeros(3), SIDE, SIDE, SIDE, SIDE)]
    centre = Geometry(orbit, np.zeros((0, 3))).centre
    return Start(orbit[0], np.zeros(3) if centre is None else centre, up, -1)


def start_among(
    cameras: Sequence[Camera],
    index: int,
    points: Float[np.ndarray, "N 3"],
    up: Float64[np.ndarray, "3"] | None = None,
) -> Start:
    """Start at a camera of the capture.

    Args:
        cameras: The capture's cameras, at least one.
        index: The camera to start at.
        points: (N, 3) points of the scene; may be empty.
        up: (3,) up direction; None takes that of the cameras.
    """
    up = common_up(cameras) if up is None else up / np.linalg.norm(up)
    near = points[~far_shell(points)]  # a sky is no subject
    return Start(cameras[index], pivot_of(cameras, index, near), up, index)


def pivot_of(
    cameras: Sequence[Camera], index: int, points: Float[np.ndarray, "N 3"]
) -> Float64[np.ndarray, "3"]:
    """Find the pivot of orbits that start at a camera.

    If the cameras surround a subject, the pivot is its centre. If they face one way or wander, their axes have no
    meaningful intersection; the pivot then lies at the median depth of the points in the middle of the camera's image.

    Args:
        cameras: At least one.
        index: The camera that the orbit starts at.
        points: (N, 3) points of the scene; may be empty.

    Returns:
        (3,) a point in front of the camera, on its axis unless the cameras surround a subject.
    """
    camera, geometry = cameras[index], Geometry(cameras, np.asarray(points, dtype=np.float64))
    centre = geometry.centre if geometry.arrangement == INWARD else None
    if centre is not None and camera.world_to_cam(centre[None])[0, 2] > 0:
        return centre
    x, y, z = camera.world_to_cam(geometry.points).T
    across, down = 0.5 * CENTRAL_PART * camera.W / camera.fx, 0.5 * CENTRAL_PART * camera.H / camera.fy
    depths = z[(z > 0) & (abs(x) < across * z) & (abs(y) < down * z)]
    depth = float(np.median(depths)) if depths.size else geometry.depth
    return np.asarray(camera.eye + (depth if depth > 0 else 1.0) * camera.R[2])
