"""The camera: position, orientation, projection and shutter.

Axes are OpenCV's, for the world and the camera alike: +x right, +y down, +z forward. The world's up is
(0, -1, 0). Pixels are sampled at integer coordinates.

Chapters: 01_points, 03_gaussians_in_3d.
"""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass, field
from functools import cached_property
from typing import Protocol, SupportsFloat, SupportsIndex, runtime_checkable

import numpy as np
from jaxtyping import Float64

from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.base.validation import ArrayLike, float64_array, in_range, whole_number
from gsplat_edu.scene.intrinsics import Intrinsics
from gsplat_edu.scene.projection import PINHOLE, Projection, jacobian_bound
from gsplat_edu.scene.projection_formulas import NUMPY
from gsplat_edu.scene.shutter import AT_ONCE, RollingShutter
from gsplat_edu.scene.sight import Optics, Sight, sight

WORLD_UP = (0.0, -1.0, 0.0)
"""The world's up direction: +y points down."""

ROTATION_TOLERANCE = 1e-4
"""Largest entry of R R' - I accepted for a rotation, to allow rotations stored as float32 text."""

WHOLE_SPHERE = 1e-6
"""Largest relative deviation of the angles that an equirectangular image covers from 360 and 180 degrees."""


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


@dataclass(frozen=True, eq=False, init=False, repr=False)
class Camera:
    """A camera in OpenCV axes: a pinhole, unless it has another projection.

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

    `projection` and `shutter` are a pinhole's and None; `through` returns a camera with others.

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
    projection: Projection = field(default=PINHOLE, init=False)
    shutter: RollingShutter | None = field(default=None, init=False)

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

    def __repr__(self) -> str:
        """Return one line: size, lens and shutter, focal lengths, principal point and centre."""
        lens = "pinhole" if self.pinhole else self.projection.kind
        read = "" if self.shutter is None else f" read {self.readout}"
        eye = ", ".join(f"{x:.4g}" for x in self.eye)
        numbers = f"fx={self.fx:.4g}, fy={self.fy:.4g}, cx={self.cx:.4g}, cy={self.cy:.4g}"
        return f"Camera({self.W}x{self.H} px, {lens}{read}, {numbers}, eye=({eye}))"

    def through(self, projection: Projection = PINHOLE, shutter: RollingShutter | None = None) -> Camera:
        """Return this camera with another lens and shutter.

        Args:
            projection: How the lens projects. The focal lengths of an equirectangular one have to be W / 2 pi and
                H / pi px per radian: `Camera.panorama`.
            shutter: How the camera moves while the image is read; None if it does not. R and eye are those at half
                time.

        Raises:
            ArgumentError: the focal lengths or the shutter do not fit an equirectangular image.
        """
        if projection.kind == "equirectangular":
            angles = 2 * np.pi * self.fx / self.W - 1, np.pi * self.fy / self.H - 1
            if np.abs(angles).max() > WHOLE_SPHERE:
                raise ArgumentError(
                    "fx, fy: of an equirectangular image have to be W / 2 pi and H / pi px per radian; "
                    "Camera.panorama makes one"
                )
            if shutter is not None and shutter.axis == 0:
                raise ArgumentError("shutter: an equirectangular image is read by rows, down or up")
        found = copy(self)
        found.__dict__.pop("widest", None)
        object.__setattr__(found, "projection", projection)
        object.__setattr__(found, "shutter", shutter)
        return found

    @classmethod
    def panorama(cls, R: ArrayLike, eye: ArrayLike, H: int, W: int) -> Camera:
        """Make a camera of an equirectangular image: the whole sphere, with the forward direction in the middle.

        Args:
            R: (3, 3) world-to-camera rotation.
            eye: (3,) camera centre, world units.
            H: Image height, px.
            W: Image width, px; twice the height for square pixels at the horizon.

        Raises:
            ShapeError: R is not (3, 3) or eye not (3,).
            ArgumentError: as for the constructor.
        """
        H, W = whole_number("H", H, 1), whole_number("W", W, 1)
        focal = W / (2 * np.pi), H / np.pi
        plain = cls(R, eye, *focal, (W - 1) / 2, (H - 1) / 2, H, W)
        return plain.through(Projection("equirectangular"))

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
    def posed(
        cls, R: ArrayLike, eye: ArrayLike, intrinsics: Intrinsics, shutter: RollingShutter | None = None
    ) -> Camera:
        """Make a camera from a pose and intrinsics.

        Args:
            R: (3, 3) world-to-camera rotation.
            eye: (3,) camera centre, world units.
            intrinsics: Focal lengths, principal point, size and projection.
            shutter: How the camera moves while the image is read.

        Raises:
            ShapeError: R is not (3, 3) or eye not (3,).
            ArgumentError: as for the constructor.
        """
        i = intrinsics
        return cls(R, eye, i.fx, i.fy, i.cx, i.cy, i.H, i.W).through(i.projection, shutter)

    @classmethod
    def from_viewmat(
        cls, viewmat: ArrayLike, K: ArrayLike, width: int, height: int, *, first_pixel: float
    ) -> Camera:
        """Make a camera from a world-to-camera matrix and an intrinsic matrix, as other libraries keep them.

        viewmat = [R, -R eye; 0 1],  K = [fx 0 cx; 0 fy cy; 0 0 1]

        Args:
            viewmat: (4, 4) world to camera, OpenCV axes.
            K: (3, 3) intrinsics, px.
            width: Image width, px.
            height: Image height, px.
            first_pixel: Where K has the centre of the top-left pixel: 0 here and in OpenCV, 0.5 in gsplat and COLMAP.

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
        """Focal lengths, principal point, image size and projection as one value."""
        return Intrinsics(self.W, self.H, self.fx, self.fy, self.cx, self.cy, projection=self.projection)

    @property
    def pinhole(self) -> bool:
        """Whether this is a pinhole at rest: undistorted perspective, and no rolling shutter."""
        return self.projection.plain and self.shutter is None

    @cached_property
    def widest(self) -> float:
        """Largest angle to the optical axis at which the lens projects means, radians; see `Projection.widest`."""
        x = np.array([-0.5, self.W - 0.5]) - self.cx
        y = np.array([-0.5, self.H - 0.5]) - self.cy
        return self.projection.widest(float(np.hypot(np.abs(x).max() / self.fx, np.abs(y).max() / self.fy)))

    @property
    def coefficients(self) -> tuple[float, ...] | None:
        """The coefficients of the distortion, as `gsplat_edu.scene.projection.COEFFICIENTS`; None if there is none."""
        return None if self.projection.distortion is None else self.projection.distortion.coefficients

    @property
    def readout(self) -> str:
        """The direction of a rolling shutter; of a global one, it means nothing."""
        return "down" if self.shutter is None else self.shutter.readout

    @property
    def motion(self) -> tuple[float, ...] | None:
        """Turn and shift during the readout, six numbers; None for a global shutter."""
        return None if self.shutter is None else (*self.shutter.turn.tolist(), *self.shutter.shift.tolist())

    @property
    def exposure(self) -> float:
        """Time for which a row is exposed, by that of the readout; 0 for no motion blur."""
        return 0.0 if self.shutter is None else self.shutter.exposure

    def scaled(self, W: int, H: int) -> Camera:
        """Return the camera of the same photo at another size, see `Intrinsics.scaled`."""
        return Camera.posed(self.R, self.eye, self.intrinsics.scaled(W, H), self.shutter)

    def cropped(self, top: int, left: int, H: int, W: int) -> Camera:
        """Return the camera of a part of the photo: its principal point moves by (-left, -top).

        Args:
            top: First row of the part.
            left: First column of the part.
            H: Height of the part, px.
            W: Width of the part, px.

        Raises:
            ArgumentError: the part is not within the image, the image is a panorama, or its rows are not read at once.
        """
        top, left = whole_number("top", top, 0), whole_number("left", left, 0)
        H, W = whole_number("H", H, 1), whole_number("W", W, 1)
        if top + H > self.H or left + W > self.W:
            raise ArgumentError(
                f"crop: {W}x{H} px at row {top}, column {left} is not within the image of {self.W}x{self.H} px"
            )
        if (H, W) != (self.H, self.W) and (
            self.projection.kind == "equirectangular"
            or (self.shutter is not None and self.shutter.readout != AT_ONCE)
        ):
            raise ArgumentError(
                "crop: a panorama, or a photo with a rolling shutter, has no part with a camera of its own"
            )
        return Camera(self.R, self.eye, self.fx, self.fy, self.cx - left, self.cy - top, H, W).through(
            self.projection, self.shutter
        )

    def sight(self, points: ArrayLike, z_near: float = 0.0, jacobian_limit: float | None = None) -> Sight:
        """See points of the world: image position, depth, Jacobian and direction, by projection and shutter.

        Args:
            points: (N, 3) world units.
            z_near: Smallest depth, world units.
            jacobian_limit: As for `jacobian_bounds`.

        Raises:
            ShapeError: not of shape (N, 3).
            ArgumentError: a coordinate is NaN or infinite.
        """
        x, y, z = float64_array("points", points, ("N", 3)).T
        lens, size = (self.fx, self.fy, self.cx, self.cy), (self.H, self.W)
        rows, eye = [tuple(row) for row in self.R.tolist()], tuple(self.eye.tolist())
        bounds = None if jacobian_limit is None else self.jacobian_bounds(jacobian_limit)
        lens_of = self.projection, self.coefficients, self.widest
        optics = Optics(*lens_of, self.motion, self.readout, bounds, self.exposure)
        with np.errstate(all="ignore"):  # the numbers of points that are not seen mean nothing
            return sight((x, y, z), rows, eye, lens, optics, size, z_near, NUMPY)

    def jacobian_bounds(self, limit: float | None) -> tuple[tuple[float, float], tuple[float, float]]:
        """Return the bounds of x/z and y/z for evaluating the projection's Jacobian.

        Far outside the image, a Gaussian's first-order ellipse grows without bound and would cover the image. The
        bounds are the viewing directions of the image rectangle, enlarged by `limit` about its centre; through a
        distorted lens, those of its edges (`Projection.extent`). Only perspective projections have bounds.

        Args:
            limit: Factor, 1.3 in Kerbl et al.'s code; None for no bounds.

        Returns:
            (low, high) of x/z and of y/z.
        """
        if limit is None or self.projection.kind != "perspective":
            return (-np.inf, np.inf), (-np.inf, np.inf)
        if self.projection.distortion is not None:
            x, y = (
                ((-0.5 - middle) / focal, (size - 0.5 - middle) / focal)
                for size, middle, focal in ((self.W, self.cx, self.fx), (self.H, self.cy, self.fy))
            )
            return self.projection.extent(x, y, self.widest, limit)
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
        """Project points in camera coordinates to the image: u = fx x/z + cx, v = fy y/z + cy for a pinhole.

        A rolling shutter is not considered: the camera coordinates are those at the time of the point (`sight`).

        Args:
            points_cam: (..., 3) camera coordinates, world units.

        Returns:
            u, v: (...) column and row, px; NaN where the projection does not see the point, a pinhole where z <= 0.
            depth: (...) z, or the distance from the camera if the projection is `along_ray`; world units.

        Raises:
            ShapeError: the last axis is not 3.
            ArgumentError: a coordinate is NaN or infinite.
        """
        points = float64_array("points_cam", points_cam, ("...", 3))
        x, y, z = np.moveaxis(points, -1, 0)
        if not self.projection.plain:
            still = Camera.posed(np.eye(3), np.zeros(3), self.intrinsics).sight(points.reshape(-1, 3))
            u, v = (np.where(still.valid, each, np.nan).reshape(x.shape) for each in (still.u, still.v))
            return u, v, np.reshape(still.depth, x.shape)
        depth = np.where(z > 0, z, np.nan)
        u, v = self.fx * x / depth + self.cx, self.fy * y / depth + self.cy
        return np.asarray(u), np.asarray(v), np.array(z)  # for a single point: 0-d arrays, not scalars

    def rays(self) -> Float64[np.ndarray, "H W 3"]:
        """Return the ray of every pixel, in world axes and of depth 1.

        r = R' ((u - cx) / fx, (v - cy) / fy, 1) for a pinhole,  so that eye + z r lies at the camera depth z

        Rays of another projection have the length 1 if its depth is the distance from the camera (`along_ray`), and are
        NaN where a pixel has no ray. `origins` gives where they begin.
        """
        u, v = np.arange(self.W), np.arange(self.H)[:, None]
        x, y = np.broadcast_arrays((u - self.cx) / self.fx, (v - self.cy) / self.fy)
        if self.projection.plain:
            rays: Float64[np.ndarray, "H W 3"] = np.stack([x, y, np.ones_like(x)], axis=-1)
        else:
            rays = self.projection.directions(x, y, self.widest)
        return np.asarray(self._when_read(rays) @ self.R)

    def _when_read(self, vectors: Float64[np.ndarray, "H W 3"]) -> Float64[np.ndarray, "H W 3"]:
        """Turn vectors from the camera's axes when their pixel is read to those at half time."""
        if self.shutter is None:
            return vectors
        h = 0.5 * self.shutter.times(self.H, self.W)[..., None] * self.shutter.turn
        once = np.cross(vectors, h)  # -h x r: the inverse of Cayley's map
        return np.asarray(
            vectors + 2 / (1 + (h * h).sum(axis=-1, keepdims=True)) * (once + np.cross(once, h))
        )

    def origins(self) -> Float64[np.ndarray, "H W 3"]:
        """Return where the ray of every pixel begins, world axes: the camera's centre when the pixel is read.

        Rays of an orthographic projection begin on the plane through the centre.
        """
        eyes = np.broadcast_to(self.eye, (self.H, self.W, 3))
        if self.projection.kind == "orthographic":
            u, v = np.arange(self.W), np.arange(self.H)[:, None]
            x, y = np.broadcast_arrays((u - self.cx) / self.fx, (v - self.cy) / self.fy)
            eyes = eyes + self._when_read(np.stack([x, y, np.zeros_like(x)], axis=-1)) @ self.R
        if self.shutter is None:
            return np.asarray(eyes)
        return np.asarray(eyes + self.shutter.times(self.H, self.W)[..., None] * self.shutter.shift)


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
