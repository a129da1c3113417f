"""The pinhole camera: position, orientation and projection.

Axes are OpenCV's, for the world and the camera alike: +x right, +y down, +z forward. The world's up is
(0, -1, 0). Pixels are sampled at integer coordinates.

Chapters: 01_points, 03_gaussians_in_3d.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol, SupportsFloat, SupportsIndex, runtime_checkable

import numpy as np
from jaxtyping import Float64

from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.base.validation import ArrayLike, float64_array, in_range, whole_number
from gsplat_edu.scene.intrinsics import Intrinsics

WORLD_UP = (0.0, -1.0, 0.0)
"""The world's up direction: +y points down."""

ROTATION_TOLERANCE = 1e-4
"""Largest entry of R R' - I accepted for a rotation, to allow rotations stored as float32 text."""

PARALLEL = 1e-3
"""Smallest eigenvalue of mean(I - d d') at which the intersection of the optical axes d is well defined. Below it
(about 1.8 degrees between axes) the intersection is noise."""

EXTENT_MARGIN = 1.1
"""Factor between the cameras' spread and the extent (the code of Kerbl et al. 2023)."""


def look_at(eye: ArrayLike, target: ArrayLike, up: ArrayLike = WORLD_UP) -> Float64[np.ndarray, "3 3"]:
    """Return the rotation of a camera that looks at a point.

    forward = normalize(target - eye),  right = normalize(forward × up),  down = forward × right

    Args:
        eye: (3,) camera centre, world units.
        target: (3,) point the camera looks at, world units.
        up: (3,) up direction in the image; any length.

    Returns:
        (3, 3) world-to-camera rotation with rows (right, down, forward).

    Raises:
        ShapeError: an argument is not of shape (3,).
        ArgumentError: `target` equals `eye`, or `up` is zero or parallel to the viewing direction.
    """
    eye = float64_array("eye", eye, (3,))
    target = float64_array("target", target, (3,))
    up = float64_array("up", up, (3,))
    distance = np.linalg.norm(target - eye)
    if distance == 0.0:
        raise ArgumentError(
            f"target: equals eye, {tuple(eye.tolist())}; a camera needs another point to look at"
        )
    forward = (target - eye) / distance
    right = np.cross(forward, up)
    sine = np.linalg.norm(right)
    if sine <= 1e-9 * np.linalg.norm(up):
        raise ArgumentError("up: is zero or parallel to the viewing direction; give another up direction")
    right = right / sine
    return np.stack([right, np.cross(forward, right), forward])


def jacobian_bound(size: int, middle: Any, focal: Any, limit: float) -> Any:  # noqa: ANN401
    """Return one bound of x/z for the projection's Jacobian; see `Camera.jacobian_bounds`.

    Args:
        size: Width of the image, px.
        middle: cx, px, a number or a tensor without axes.
        focal: fx, px, of the same kind.
        limit: Signed factor on the distance between the image's centre and its edge.
    """
    return (0.5 * (size - 1) + 0.5 * limit * size - middle) / focal


@dataclass(frozen=True, eq=False, init=False)
class Camera:
    """A pinhole camera in OpenCV axes.

    x_cam = R (x - eye);  u = fx x/z + cx,  v = fy y/z + cy

    Args:
        R: (3, 3) world-to-camera rotation, rows (right, down, forward).
        eye: (3,) camera centre, world units.
        fx: Focal length along x, px.
        fy: Focal length along y, px.
        cx: Column of the principal point, px.
        cy: Row of the principal point, px.
        H: Image height, px.
        W: Image width, px.

    Raises:
        ShapeError: R is not (3, 3) or eye not (3,).
        ArgumentError: R is not a rotation, a focal length is not positive, a size is not a whole number of
            at least 1, or anything is NaN or infinite.
    """

    R: Float64[np.ndarray, "3 3"]
    eye: Float64[np.ndarray, "3"]
    fx: float
    fy: float
    cx: float
    cy: float
    H: int
    W: int

    def __init__(
        self, R: ArrayLike, eye: ArrayLike, fx: float, fy: float, cx: float, cy: float, H: int, W: int
    ) -> None:
        rotation = float64_array("R", R, (3, 3)).copy()
        error = np.abs(rotation @ rotation.T - np.eye(3)).max()
        if error > ROTATION_TOLERANCE or np.linalg.det(rotation) < 0:
            raise ArgumentError(
                "R: is not a rotation; its rows must be (right, down, forward), orthonormal, det +1"
            )
        centre = float64_array("eye", eye, (3,)).copy()
        rotation.flags.writeable = centre.flags.writeable = False
        values = {
            "R": rotation,
            "eye": centre,
            "fx": in_range("fx", fx, 0.0, open_low=True),
            "fy": in_range("fy", fy, 0.0, open_low=True),
            "cx": float(float64_array("cx", cx, ())),
            "cy": float(float64_array("cy", cy, ())),
            "H": whole_number("H", H, 1),
            "W": whole_number("W", W, 1),
        }
        for name, value in values.items():
            object.__setattr__(self, name, value)

    @classmethod
    def looking_at(
        cls, eye: ArrayLike, target: ArrayLike, fx: float, fy: float, H: int, W: int, up: ArrayLike = WORLD_UP
    ) -> Camera:
        """Make a camera at `eye` that looks at `target`, with the principal point at (W/2, H/2).

        Args:
            eye: (3,) camera centre, world units.
            target: (3,) point the camera looks at, world units.
            fx: Focal length along x, px.
            fy: Focal length along y, px.
            H: Image height, px.
            W: Image width, px.
            up: (3,) up direction in the image.

        Raises:
            ShapeError: an argument is not of shape (3,).
            ArgumentError: as for `look_at` and the constructor.
        """
        H, W = whole_number("H", H, 1), whole_number("W", W, 1)
        return cls(look_at(eye, target, up), eye, fx, fy, W / 2, H / 2, H, W)

    @classmethod
    def posed(cls, R: ArrayLike, eye: ArrayLike, intrinsics: Intrinsics) -> Camera:
        """Make a camera from a pose and intrinsics.

        Args:
            R: (3, 3) world-to-camera rotation.
            eye: (3,) camera centre, world units.
            intrinsics: Of a pinhole; `Intrinsics.undistorted` gives that of a lens.

        Raises:
            ShapeError: R is not (3, 3) or eye not (3,).
            ArgumentError: as for the constructor.
        """
        i = intrinsics
        return cls(R, eye, i.fx, i.fy, i.cx, i.cy, i.H, i.W)

    @classmethod
    def from_viewmat(
        cls, viewmat: ArrayLike, K: ArrayLike, width: int, height: int, *, first_pixel: float = 0.0
    ) -> Camera:
        """Make a camera from a world-to-camera matrix and an intrinsic matrix, as other libraries keep them.

        viewmat = [R, -R eye; 0 1],  K = [fx 0 cx; 0 fy cy; 0 0 1]

        Args:
            viewmat: (4, 4) world to camera, OpenCV axes.
            K: (3, 3) intrinsics, px.
            width: Image width, px.
            height: Image height, px.
            first_pixel: Where K has the centre of the top-left pixel: 0 in this package, 0.5 in gsplat and COLMAP.

        Raises:
            ShapeError: viewmat is not (4, 4) or K not (3, 3).
            ArgumentError: viewmat is no rigid motion, K has skew or another last row, or as for the constructor.
        """
        rigid = float64_array("viewmat", viewmat, (4, 4))
        matrix = float64_array("K", K, (3, 3))
        if np.abs(rigid[3] - (0, 0, 0, 1)).max() > ROTATION_TOLERANCE:
            raise ArgumentError("viewmat: its last row has to be (0, 0, 0, 1); give world to camera")
        fx, fy, cx, cy = matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2]
        if np.abs(matrix - [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]).max() > 0:
            raise ArgumentError("K: has to be [fx 0 cx; 0 fy cy; 0 0 1]; a pinhole here has no skew")
        R, shift = rigid[:3, :3], float(float64_array("first_pixel", first_pixel, ()))
        error = np.abs(R @ R.T - np.eye(3)).max()
        if error > ROTATION_TOLERANCE or np.linalg.det(R) < 0:
            raise ArgumentError("viewmat: its (3, 3) part is not a rotation with rows (right, down, forward)")
        return cls(R, -R.T @ rigid[:3, 3], fx, fy, cx - shift, cy - shift, height, width)

    @property
    def viewmat(self) -> Float64[np.ndarray, "4 4"]:
        """World to camera, (4, 4): [R, -R eye; 0 1]."""
        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = self.R, -self.R @ self.eye
        return matrix

    @property
    def intrinsics(self) -> Intrinsics:
        """Focal lengths, principal point and image size as one value."""
        return Intrinsics(self.W, self.H, self.fx, self.fy, self.cx, self.cy)

    def jacobian_bounds(self, limit: float | None) -> tuple[tuple[float, float], tuple[float, float]]:
        """Return the bounds of x/z and y/z for evaluating the projection's Jacobian.

        Far outside the image, a Gaussian's first-order ellipse grows without bound and would cover the image. The
        bounds are the viewing directions of the image rectangle, enlarged by `limit` about its centre.

        Args:
            limit: Factor, 1.3 in Kerbl et al.'s code; None for no bounds.

        Returns:
            (low, high) of x/z and of y/z.
        """
        if limit is None:
            return (-np.inf, np.inf), (-np.inf, np.inf)
        edges = [
            [jacobian_bound(size, middle, focal, side * limit) for side in (-1, 1)]
            for size, middle, focal in ((self.W, self.cx, self.fx), (self.H, self.cy, self.fy))
        ]
        (x_low, x_high), (y_low, y_high) = edges
        return (x_low, x_high), (y_low, y_high)

    def world_to_cam(self, points: ArrayLike) -> Float64[np.ndarray, "*batch 3"]:
        """Transform points from world to camera coordinates: x_cam = R (x - eye).

        Args:
            points: (..., 3) world units.

        Returns:
            (..., 3) camera coordinates, world units: right, down, forward.

        Raises:
            ShapeError: the last axis is not 3.
            ArgumentError: a coordinate is NaN or infinite.
        """
        moved: Float64[np.ndarray, "*batch 3"] = (
            float64_array("points", points, ("...", 3)) - self.eye
        ) @ self.R.T
        return moved

    def project(
        self, points_cam: ArrayLike
    ) -> tuple[Float64[np.ndarray, "*batch"], Float64[np.ndarray, "*batch"], Float64[np.ndarray, "*batch"]]:
        """Project points in camera coordinates to the image: u = fx x/z + cx, v = fy y/z + cy.

        Args:
            points_cam: (..., 3) camera coordinates, world units.

        Returns:
            u, v: (...) column and row, px; NaN where z <= 0, because a point beside or behind the camera has no image.
            z: (...) depth, world units.

        Raises:
            ShapeError: the last axis is not 3.
            ArgumentError: a coordinate is NaN or infinite.
        """
        x, y, z = np.moveaxis(float64_array("points_cam", points_cam, ("...", 3)), -1, 0)
        depth = np.where(z > 0, z, np.nan)
        u, v = self.fx * x / depth + self.cx, self.fy * y / depth + self.cy
        return np.asarray(u), np.asarray(v), np.array(z)  # for a single point: 0-d arrays, not scalars

    def rays(self) -> Float64[np.ndarray, "H W 3"]:
        """Return the ray of every pixel, in world axes and of camera depth 1.

        r = R' ((u - cx) / fx, (v - cy) / fy, 1),  so that eye + z r lies at the camera depth z
        """
        u, v = np.arange(self.W), np.arange(self.H)[:, None]
        x, y = np.broadcast_arrays((u - self.cx) / self.fx, (v - self.cy) / self.fy)
        rays: Float64[np.ndarray, "H W 3"] = np.stack([x, y, np.ones_like(x)], axis=-1) @ self.R
        return rays


@runtime_checkable
class CameraLike(Protocol):
    """Any pinhole camera: the members that the renderers use, named as in `Camera`.

    Arrays may be lists, and numbers may be NumPy scalars; `as_camera` reads and checks them. Other members, such as the
    methods of a chapter's own camera, are ignored.
    """

    @property
    def R(self) -> ArrayLike:
        """World-to-camera rotation (3, 3), rows (right, down, forward)."""

    @property
    def eye(self) -> ArrayLike:
        """Camera centre (3,), world units."""

    @property
    def fx(self) -> SupportsFloat:
        """Focal length along x, px."""

    @property
    def fy(self) -> SupportsFloat:
        """Focal length along y, px."""

    @property
    def cx(self) -> SupportsFloat:
        """Column of the principal point, px."""

    @property
    def cy(self) -> SupportsFloat:
        """Row of the principal point, px."""

    @property
    def H(self) -> SupportsIndex:
        """Image height, px."""

    @property
    def W(self) -> SupportsIndex:
        """Image width, px."""


def as_camera(name: str, camera: CameraLike) -> Camera:
    """Convert to a `Camera`; a `Camera` is returned unchanged.

    Args:
        name: The caller's name for the argument.
        camera: A `Camera`, or any object with its members R, eye, fx, fy, cx, cy, H and W.

    Raises:
        ShapeError: its R is not (3, 3) or its eye not (3,).
        ArgumentError: a member is missing or invalid.
    """
    if isinstance(camera, Camera):
        return camera
    members = ("R", "eye", "fx", "fy", "cx", "cy", "H", "W")
    try:
        missing = [member for member in members if not hasattr(camera, member)]
    except RuntimeError:  # a tensor has an H, but refuses to give that of five axes
        missing = list(members)
    if missing:
        raise ArgumentError(
            f"{name}: is not a camera, a {type(camera).__name__} has no {', '.join(missing)}; "
            "a camera has R, eye, fx, fy, cx, cy, H and W"
        )
    try:
        return Camera(*(getattr(camera, member) for member in members))
    except ArgumentError as error:
        raise type(error)(f"{name}.{error}") from None


def orbit_camera(azimuth: float, elevation: float, size: int, fx: float, radius: float = 3.0) -> Camera:
    """Make a square camera on a sphere around the origin, looking at the origin.

    eye = radius (cos e sin a, sin e, -cos e cos a)

    Args:
        azimuth: Angle around the vertical axis, radians; 0 looks along +z.
        elevation: Angle from the horizon, radians; positive is +y, which is down.
        size: Height and width of the image, px.
        fx: Focal length of both axes, px.
        radius: Distance of the camera from the origin, world units.

    Raises:
        ArgumentError: the radius or focal length is not positive, the size is below 1, or the camera is straight above
            or below the origin, where up is undefined.
    """
    radius = in_range("radius", radius, 0.0, open_low=True)
    azimuth, elevation = (
        float(float64_array(n, a, ())) for n, a in (("azimuth", azimuth), ("elevation", elevation))
    )
    direction = (np.cos(elevation) * np.sin(azimuth), np.sin(elevation), -np.cos(elevation) * np.cos(azimuth))
    return Camera.looking_at(radius * np.array(direction), (0.0, 0.0, 0.0), fx, fx, size, size)


def point_nearest_axes(cameras: Sequence[Camera]) -> Float64[np.ndarray, "3"] | None:
    """Find the point nearest to all optical axes in the least-squares sense.

    p minimises sum_i |(I - d_i d_i') (p - e_i)|²,  e_i: centre of camera i,  d_i: its viewing direction

    Args:
        cameras: At least one.

    Returns:
        (3,) world units; None if the axes are so nearly parallel that their intersection is noise.
    """
    eyes = np.stack([camera.eye for camera in cameras])
    axes = np.stack([camera.R[2] for camera in cameras])
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    A, mean = across.mean(axis=0), eyes.mean(axis=0)
    if np.linalg.eigvalsh(A)[0] < PARALLEL:
        return None
    b = (across @ (eyes - mean)[:, :, None]).mean(axis=0)[:, 0]
    return np.asarray(mean + np.linalg.solve(A, b))


def scene_extent(cameras: Sequence[Camera]) -> float:
    """Measure the scale of a scene by the spread of its cameras.

    1.1 max_i |e_i - mean e|,  e_i: centre of camera i

    Args:
        cameras: At least one.

    Returns:
        World units; 1 if all cameras are at the same place, which does not determine the size.

    Raises:
        ArgumentError: there is no camera.

    Source: the code of Kerbl et al. 2023.
    """
    if not cameras:
        raise ArgumentError("cameras: is empty; the extent of a scene needs at least one camera")
    eyes = np.stack([camera.eye for camera in cameras])
    spread = float(np.linalg.norm(eyes - eyes.mean(axis=0), axis=1).max())
    # Differences within rounding count as the same place.
    return EXTENT_MARGIN * spread if spread > 1e-9 * max(1.0, float(np.abs(eyes).max())) else 1.0
