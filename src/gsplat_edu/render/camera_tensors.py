"""A camera made of tensors, in whose pose and intrinsics a render is differentiable.

x_cam = R (x - eye);  u = fx x/z + cx,  v = fy y/z + cy

Chapter: 12_the_backward_pass.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.base.validation import whole_number
from gsplat_edu.scene.camera import Camera, CameraLike, as_camera
from gsplat_edu.scene.gaussians import check_tensor
from gsplat_edu.scene.projection import COEFFICIENTS, PINHOLE, Distortion, Projection, jacobian_bound
from gsplat_edu.scene.shutter import MOTION_NUMBERS, RollingShutter

INTRINSICS = ("fx", "fy", "cx", "cy")
"""The entries of `CameraTensors.intrinsics`, px."""

GRADIENT_NUMBERS = 16
"""Numbers of a pinhole's gradient, as kernels return them: R row by row, the eye, fx, fy, cx, cy."""

LENS_GRADIENT_NUMBERS = GRADIENT_NUMBERS + len(COEFFICIENTS) + MOTION_NUMBERS
"""The same of any camera: a pinhole's, the coefficients of the distortion, turn and shift."""


Pose = tuple[Tensor | None, Tensor | None, Tensor | None, Tensor | None, Tensor | None]
"""R, eye, intrinsics, coefficients and motion, or their gradients."""

POSE = 5
"""Number of tensors of a `Pose`."""


@dataclass(frozen=True, eq=False)
class CameraTensors:
    """A camera as float64 tensors on the CPU.

    The gradient in R has nine entries, those of the formulas with any 3 x 3 matrix. Optimise a `twist` instead, since R
    has to stay a rotation: `CameraTensors.moved`.

    Args:
        R: (3, 3) world-to-camera rotation, rows (right, down, forward).
        eye: (3,) camera centre, world units.
        intrinsics: (4,) fx, fy, cx, cy, px.
        H: Image height, px.
        W: Image width, px.
        projection: The kind of projection; its distortion is replaced by `coefficients`.
        coefficients: (15,) of the distortion, as `gsplat_edu.scene.projection.COEFFICIENTS`; None for no distortion.
        motion: (6,) turn and shift of a rolling shutter (`RollingShutter`); None for a global shutter.
        readout: Direction of the rolling shutter.
        exposure: Time for which a row is exposed, by that of the readout; a constant for the gradients.

    Raises:
        ShapeError: a tensor has another shape.
        ArgumentError: a tensor is not float64 on the CPU, or the values are not those of a `Camera`.
    """

    R: Float[Tensor, "3 3"]
    eye: Float[Tensor, "3"]
    intrinsics: Float[Tensor, "4"]
    H: int
    W: int
    projection: Projection = PINHOLE
    coefficients: Float[Tensor, "15"] | None = None
    motion: Float[Tensor, "6"] | None = None
    readout: str = "down"
    exposure: float = 0.0

    def __post_init__(self) -> None:
        """Check the tensors and their values."""
        for name, shape in (("R", (3, 3)), ("eye", (3,)), ("intrinsics", (4,))):
            _check(name, getattr(self, name), shape)
        for name, shape in (("coefficients", (len(COEFFICIENTS),)), ("motion", (MOTION_NUMBERS,))):
            if getattr(self, name) is not None:
                _check(name, getattr(self, name), shape)
        for name in ("H", "W"):
            object.__setattr__(self, name, whole_number(name, getattr(self, name), 1))
        self.value()

    @classmethod
    def of(cls, camera: CameraLike) -> CameraTensors:
        """Return a camera's numbers as tensors, which do not require a gradient."""
        one = as_camera("camera", camera)
        intrinsics = torch.tensor([getattr(one, name) for name in INTRINSICS], dtype=torch.float64)
        coefficients = None
        if one.coefficients is not None:
            coefficients = torch.tensor(one.coefficients, dtype=torch.float64)
        motion, readout = None, "down"
        if one.shutter is not None:
            motion, readout = (
                torch.tensor(np.concatenate([one.shutter.turn, one.shutter.shift])),
                one.shutter.readout,
            )
        R, eye = torch.tensor(one.R), torch.tensor(one.eye)
        lens = one.projection, coefficients
        return cls(R, eye, intrinsics, one.H, one.W, *lens, motion, readout, one.exposure)

    def moved(self, twist: Float[Tensor, "6"]) -> CameraTensors:
        """Turn and move the camera, differentiably: R' = exp([w]x) R,  eye' = eye + t.

        Args:
            twist: (6,) w, a rotation about the camera's own axes, radians; and t, world units. Zero for this camera.

        Returns:
            The camera, differentiable in the twist.

        Raises:
            ShapeError: the twist is not of shape (6,).
            ArgumentError: it is not float64 on the CPU, or an entry is NaN or infinite.
        """
        _check("twist", twist, (6,))
        x, y, z = twist[:3].unbind()
        zero = torch.zeros_like(x)
        cross = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero]).reshape(3, 3)
        return replace(self, R=torch.linalg.matrix_exp(cross) @ self.R, eye=self.eye + twist[3:])

    def with_intrinsics(self, intrinsics: Float[Tensor, "4"]) -> CameraTensors:
        """Return the camera with other intrinsics: (4,) fx, fy, cx, cy, px."""
        return replace(self, intrinsics=intrinsics)

    def value(self) -> Camera:
        """Return the camera as numbers."""
        R, eye, (fx, fy, cx, cy) = (t.numpy(force=True) for t in (self.R, self.eye, self.intrinsics))
        projection, shutter = replace(self.projection, distortion=None), None
        if self.coefficients is not None:
            values = tuple(self.coefficients.tolist())
            projection = replace(projection, distortion=Distortion(values, self.projection.radial_first))
        if self.motion is not None:
            numbers = self.motion.numpy(force=True)
            shutter = RollingShutter(numbers[:3], numbers[3:], self.readout, self.exposure)
        return Camera(R, eye, fx, fy, cx, cy, self.H, self.W).through(projection, shutter)

    def tensors(self) -> tuple[Tensor, ...]:
        """Return R, eye, intrinsics, and those of coefficients and motion that exist."""
        return tuple(tensor for tensor in self.pose() if tensor is not None)

    def pose(self) -> Pose:
        """Return R, eye, intrinsics, coefficients and motion."""
        return self.R, self.eye, self.intrinsics, self.coefficients, self.motion

    @cached_property
    def widest(self) -> float:
        """Largest angle to the optical axis, radians: a constant for the gradients; see `Camera.widest`."""
        return self.value().widest

    @property
    def pinhole(self) -> bool:
        """Whether this is a pinhole at rest. A lens with coefficients is none, not even with zeros."""
        undistorted = self.projection.kind == "perspective" and self.coefficients is None
        return undistorted and self.motion is None

    @property
    def fx(self) -> Float[Tensor, ""]:
        """Focal length along x, px."""
        return self.intrinsics[0]

    @property
    def fy(self) -> Float[Tensor, ""]:
        """Focal length along y, px."""
        return self.intrinsics[1]

    @property
    def cx(self) -> Float[Tensor, ""]:
        """Column of the principal point, px."""
        return self.intrinsics[2]

    @property
    def cy(self) -> Float[Tensor, ""]:
        """Row of the principal point, px."""
        return self.intrinsics[3]

    def jacobian_bounds(self, limit: float | None) -> tuple[tuple[Tensor, Tensor], tuple[Tensor, Tensor]]:
        """Return the bounds of x/z and y/z for the projection's Jacobian; see `Camera.jacobian_bounds`."""
        if limit is None:
            infinity = self.eye.new_tensor(torch.inf)
            return (-infinity, infinity), (-infinity, infinity)
        (x_low, x_high), (y_low, y_high) = (
            tuple(jacobian_bound(size, middle, focal, side * limit) for side in (-1, 1))
            for size, middle, focal in ((self.W, self.cx, self.fx), (self.H, self.cy, self.fy))
        )
        return (x_low, x_high), (y_low, y_high)


def _check(name: str, tensor: Tensor, shape: tuple[int, ...]) -> None:
    check_tensor(name, tensor, shape, {})
    if tensor.dtype != torch.float64 or tensor.device.type != "cpu":
        raise ArgumentError(
            f"{name}: is {tensor.dtype} on {tensor.device}, but has to be torch.float64 on the CPU"
        )


def split_camera(camera: Camera | CameraTensors) -> tuple[Camera, Pose]:
    """Return a camera's numbers, and the tensors that its gradient belongs to: none for a `Camera`."""
    if isinstance(camera, CameraTensors):
        return camera.value(), camera.pose()
    return camera, (None, None, None, None, None)


def gradient_numbers(camera: Camera) -> int:
    """Return how many numbers a kernel's gradient of this camera has."""
    return GRADIENT_NUMBERS if camera.pinhole else LENS_GRADIENT_NUMBERS


def camera_gradients(numbers: Float[Tensor, " numbers"] | None, wanted: Sequence[bool]) -> Pose:
    """Split a kernel's numbers into the gradients of `CameraTensors.pose`.

    Args:
        numbers: `gradient_numbers` of them; None for no gradients.
        wanted: Which of the five are wanted; the others are None.
    """
    if numbers is None:
        return None, None, None, None, None
    found: list[Tensor | None] = [numbers[:9].view(3, 3), numbers[9:12], numbers[12:16], None, None]
    if len(numbers) == LENS_GRADIENT_NUMBERS:
        found[3:] = [numbers[16:-MOTION_NUMBERS], numbers[-MOTION_NUMBERS:]]
    R, eye, intrinsics, coefficients, motion = (
        g if needed else None for g, needed in zip(found, wanted, strict=True)
    )
    return R, eye, intrinsics, coefficients, motion
