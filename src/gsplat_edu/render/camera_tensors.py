"""A camera made of tensors, in whose pose and intrinsics a render is differentiable.

x_cam = R (x - eye);  u = fx x/z + cx,  v = fy y/z + cy

Chapter: 12_the_backward_pass.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.base.validation import whole_number
from gsplat_edu.scene.camera import Camera, CameraLike, as_camera, jacobian_bound
from gsplat_edu.scene.gaussians import check_tensor

INTRINSICS = ("fx", "fy", "cx", "cy")
"""The entries of `CameraTensors.intrinsics`, px."""

GRADIENT_NUMBERS = 16
"""Numbers of a camera's gradient, as kernels return them: R row by row, the eye, fx, fy, cx, cy."""


@dataclass(frozen=True, eq=False)
class CameraTensors:
    """A pinhole camera as float64 tensors on the CPU.

    The gradient in R has nine entries, those of the formulas with any 3 x 3 matrix. Optimise a `twist` instead, since R
    has to stay a rotation: `CameraTensors.moved`.

    Args:
        R: (3, 3) world-to-camera rotation, rows (right, down, forward).
        eye: (3,) camera centre, world units.
        intrinsics: (4,) fx, fy, cx, cy, px.
        H: Image height, px.
        W: Image width, px.

    Raises:
        ShapeError: a tensor has another shape.
        ArgumentError: a tensor is not float64 on the CPU, or the values are not those of a `Camera`.
    """

    R: Float[Tensor, "3 3"]
    eye: Float[Tensor, "3"]
    intrinsics: Float[Tensor, "4"]
    H: int
    W: int

    def __post_init__(self) -> None:
        """Check the tensors and their values."""
        for name, shape in (("R", (3, 3)), ("eye", (3,)), ("intrinsics", (4,))):
            _check(name, getattr(self, name), shape)
        for name in ("H", "W"):
            object.__setattr__(self, name, whole_number(name, getattr(self, name), 1))
        self.value()

    @classmethod
    def of(cls, camera: CameraLike) -> CameraTensors:
        """Return a camera's numbers as tensors, which do not require a gradient."""
        one = as_camera("camera", camera)
        intrinsics = torch.tensor([getattr(one, name) for name in INTRINSICS], dtype=torch.float64)
        return cls(torch.tensor(one.R), torch.tensor(one.eye), intrinsics, one.H, one.W)

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
        return CameraTensors(
            torch.linalg.matrix_exp(cross) @ self.R, self.eye + twist[3:], self.intrinsics, self.H, self.W
        )

    def with_intrinsics(self, intrinsics: Float[Tensor, "4"]) -> CameraTensors:
        """Return the camera with other intrinsics: (4,) fx, fy, cx, cy, px."""
        return CameraTensors(self.R, self.eye, intrinsics, self.H, self.W)

    def value(self) -> Camera:
        """Return the camera as numbers."""
        R, eye, (fx, fy, cx, cy) = (tensor.numpy(force=True) for tensor in self.tensors())
        return Camera(R, eye, fx, fy, cx, cy, self.H, self.W)

    def tensors(self) -> tuple[Tensor, Tensor, Tensor]:
        """Return R, eye and intrinsics."""
        return self.R, self.eye, self.intrinsics

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


Pose = tuple[Tensor | None, Tensor | None, Tensor | None]
"""R, eye and intrinsics, or their gradients."""


def split_camera(camera: Camera | CameraTensors) -> tuple[Camera, Pose]:
    """Return a camera's numbers, and the tensors that its gradient belongs to: none for a `Camera`."""
    if isinstance(camera, CameraTensors):
        return camera.value(), camera.tensors()
    return camera, (None, None, None)


def camera_gradients(numbers: Float[Tensor, "16"] | None) -> Pose:
    """Split the `GRADIENT_NUMBERS` of a kernel into the gradients of R, eye and intrinsics; None if there are none."""
    if numbers is None:
        return None, None, None
    return numbers[:9].view(3, 3), numbers[9:12], numbers[12:]
