"""Operations on scenes: filter, crop, transform, merge."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float64
from scipy.spatial.transform import Rotation
from torch import Tensor

from gsplat_edu.base.constants import SH_MAX_DEGREE
from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.base.threads import one_thread
from gsplat_edu.base.validation import ArrayLike, float64_array, in_range, whole_number
from gsplat_edu.io.scene import Scene
from gsplat_edu.scene.camera import Camera, as_camera
from gsplat_edu.scene.frame import ORIGIN, Vector, as_origin, origin_of
from gsplat_edu.scene.gaussians import Gaussians
from gsplat_edu.scene.sh import num_coefficients, sh_rotation
from gsplat_edu.scene.shutter import RollingShutter

SHEAR = 1e-5
"""Largest entry of A A' / s² - I accepted for a similarity, to allow matrices typed with six digits."""


@dataclass(frozen=True, eq=False)
class Similarity:
    """Rotation, uniform scaling and translation: x' = s R x + t.

    Args:
        R: (3, 3) rotation.
        s: Scale, above 0.
        t: (3,) translation, world units of the result.
    """

    R: Float64[np.ndarray, "3 3"]
    s: float
    t: Float64[np.ndarray, "3"]

    @classmethod
    def of_matrix(cls, matrix: ArrayLike) -> Similarity:
        """Decompose a matrix (3, 4) or (4, 4) into (s R | t).

        Raises:
            ShapeError: the shape differs.
            ArgumentError: the matrix mirrors, shears or scales non-uniformly, or its last row is not 0 0 0 1.
        """
        given = np.asarray(matrix, dtype=np.float64)
        M = float64_array("matrix", given, (4, 4) if given.shape == (4, 4) else (3, 4))
        if len(M) == 4 and not np.array_equal(M[3], (0.0, 0.0, 0.0, 1.0)):
            raise ArgumentError("matrix: its last row is not 0 0 0 1; give it row by row")
        A = M[:3, :3]
        determinant = float(np.linalg.det(A))
        if determinant <= 0.0:
            what = "mirrors" if determinant < 0.0 else "is singular"
            raise ArgumentError(
                f"matrix: {what}; only rotation, uniform scaling and translation are possible"
            )
        s = determinant ** (1.0 / 3.0)
        if np.abs(A @ A.T / s**2 - np.eye(3)).max() > SHEAR:
            raise ArgumentError(
                "matrix: shears or scales non-uniformly; only rotation, uniform scaling and translation"
                " are possible"
            )
        return cls(A / s, s, M[:3, 3])

    @property
    def _inverse(self) -> Float64[np.ndarray, "4 4"]:
        matrix = np.eye(4)
        matrix[:3, :3] = self.R.T / self.s
        matrix[:3, 3] = -matrix[:3, :3] @ self.t
        return matrix

    def after(self, first: Similarity) -> Similarity:
        """Return the composition that applies `first` and then this one."""
        return Similarity(self.R @ first.R, self.s * first.s, self.s * self.R @ first.t + self.t)

    def camera(self, camera: Camera) -> Camera:
        """Return the camera that has the same view of the transformed scene as `camera` has of the original."""
        eye, own, shutter = self.s * self.R @ camera.eye + self.t, as_camera("camera", camera), None
        if own.shutter is not None:
            shift = self.s * self.R @ own.shutter.shift
            shutter = RollingShutter(own.shutter.turn, shift, own.shutter.readout, own.shutter.exposure)
        return Camera.posed(camera.R @ self.R.T, eye, own.intrinsics, shutter)

    def local(self, before: Vector, after: Vector) -> Similarity:
        """Return the same transform for coordinates that are relative to an origin: x' + o' = s R (x + o) + t.

        Args:
            before: The origin o of the coordinates x.
            after: The origin o' of the results x'.
        """
        return Similarity(self.R, self.s, self.s * self.R @ np.array(before) + self.t - np.array(after))

    def gaussians(self, gaussians: Gaussians) -> Gaussians:
        """Transform Gaussians: means, rotations, scales and SH coefficients, in float64, rounded to their dtype."""
        dtype, degree = gaussians.means.dtype, gaussians.sh_degree

        def tensor(values: np.ndarray) -> Tensor:
            return torch.from_numpy(np.ascontiguousarray(values)).to(gaussians.means.device)

        turn = Rotation.from_matrix(self.R).as_quat(scalar_first=True)
        with one_thread():  # the bits of a product may depend on the number of threads
            means = self.s * gaussians.means.double() @ tensor(self.R.T) + tensor(self.t)
            rest = torch.einsum(
                "jk,nkc->njc", tensor(sh_rotation(degree, self.R)), gaussians.sh_rest.double()
            )
            quats = gaussians.quats.double() @ tensor(_left_product(turn)).mT
        return Gaussians(
            means=means.to(dtype),
            quats=quats.to(dtype),
            log_scales=(gaussians.log_scales.double() + float(np.log(self.s))).to(dtype),
            sh0=gaussians.sh0,
            sh_rest=rest.to(dtype),
            logit_opacities=gaussians.logit_opacities,
        )

    def scene(self, scene: Scene) -> Scene:
        """Transform a scene: its Gaussians, origin, up direction and place on earth; scaling drops its unit.

        The new origin is that of the old zero if float32 needs one there (`gsplat_edu.scene.frame.origin_of`), else
        zero. It is applied in double, before the means are rounded.
        """
        shift = self.local(scene.origin, ORIGIN).t
        places = self.s * scene.gaussians.means.double().numpy(force=True) @ self.R.T + shift
        origin = as_origin("origin", shift) if origin_of(places).any() else ORIGIN
        up = None
        if scene.up is not None:
            x, y, z = self.R @ np.array(scene.up)
            up = (float(x), float(y), float(z))
        return replace(
            scene,
            gaussians=self.local(scene.origin, origin).gaussians(scene.gaussians),
            up=up,
            unit=scene.unit if self.s == 1.0 else None,
            origin=origin,
            earth=None if scene.earth is None else scene.earth.after(self._inverse),
        )


IDENTITY = Similarity(np.eye(3), 1.0, np.zeros(3))


@dataclass(frozen=True)
class Filter:
    """Criteria for the Gaussians to keep.

    Args:
        min_opacity: Smallest opacity to keep, 0 to 1.
        box: Corners (x0, y0, z0, x1, y1, z1) that must enclose a Gaussian's position, origin included, world units;
            None for no limit.
        sh_degree: Highest SH degree to keep.

    Raises:
        ArgumentError: a value is out of range, or a corner is not below the other.
    """

    min_opacity: float = 0.0
    box: tuple[float, ...] | None = None
    sh_degree: int = SH_MAX_DEGREE

    def __post_init__(self) -> None:
        """Check the ranges."""
        in_range("min_opacity", self.min_opacity, 0.0, 1.0)
        whole_number("sh_degree", self.sh_degree, 0, SH_MAX_DEGREE)
        if self.box is not None:
            low, high = np.split(float64_array("box", self.box, (6,)), 2)
            if not np.all(low < high):
                raise ArgumentError("box: x0, y0, z0 must be below x1, y1, z1")

    def apply(self, scene: Scene) -> Scene:
        """Return the scene with the Gaussians to keep, in their order."""
        gaussians = scene.gaussians
        stays = gaussians.opacities >= self.min_opacity
        if self.box is not None:
            low, high = torch.tensor(self.box, dtype=torch.float64).to(gaussians.means.device).chunk(2)
            means = gaussians.means.double() + torch.tensor(scene.origin, dtype=torch.float64).to(low.device)
            stays &= ((means >= low) & (means <= high)).all(dim=1)
        kept = gaussians if bool(stays.all()) else gaussians.map(lambda tensor: tensor[stays])
        most = num_coefficients(self.sh_degree) - 1
        return replace(scene, gaussians=replace(kept, sh_rest=kept.sh_rest[:, :most].contiguous()))


def joined(scenes: Sequence[Scene]) -> Scene:
    """Join scenes in the given order; scenes of a lower SH degree are padded with zeros.

    Args:
        scenes: At least one.

    Returns:
        One scene, relative to the origin of the first; metadata on which the scenes disagree is unknown.

    Raises:
        ArgumentError: only some scenes were trained for antialiased rendering, so no renderer suits all of them.
    """
    said = {scene.antialiased for scene in scenes} - {None}
    if len(said) > 1:
        raise ArgumentError(
            "scenes: some were trained with antialiasing and some without, so no render suits both; train them alike"
        )
    most = max(scene.gaussians.sh_rest.shape[1] for scene in scenes)
    parts = []
    for scene in scenes:
        missing = most - scene.gaussians.sh_rest.shape[1]
        rest = torch.nn.functional.pad(scene.gaussians.sh_rest, (0, 0, 0, missing))
        parts.append(replace(scene.relative_to(scenes[0].origin), sh_rest=rest))
    ups = {scene.up for scene in scenes}
    units = {scene.unit for scene in scenes}
    earths = {scene.earth for scene in scenes}
    return Scene(
        Gaussians.concatenated(parts),
        said.pop() if said else None,
        ups.pop() if len(ups) == 1 else None,
        units.pop() if len(units) == 1 else None,
        scenes[0].origin,
        earths.pop() if len(earths) == 1 else None,
    )


def _left_product(q: Float64[np.ndarray, "4"]) -> Float64[np.ndarray, "4 4"]:
    """Return the matrix L with L p = q p, the quaternion product for (w, x, y, z)."""
    w, x, y, z = q
    return np.array([[w, -x, -y, -z], [x, w, -z, y], [y, z, w, -x], [z, -y, x, w]])
