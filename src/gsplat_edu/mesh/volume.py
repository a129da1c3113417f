"""Depth maps become one surface: a sparse volume of truncated signed distances, and marching cubes.

Source: Curless and Levoy 1996, "A Volumetric Method for Building Complex Models from Range Images"; Lorensen and Cline
1987, "Marching Cubes"; Nießner et al. 2013, "Real-time 3D Reconstruction at Scale using Voxel Hashing".

Chapter: 15_cloud_to_surface.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float32, Shaped
from torch import Tensor

from gsplat_edu.base.errors import ArgumentError, NotEnoughMemoryError
from gsplat_edu.base.headroom import available_memory
from gsplat_edu.base.threads import native_threads
from gsplat_edu.base.validation import ArrayLike, check_shape, first_index, in_range, whole_number
from gsplat_edu.ops.kernels import native
from gsplat_edu.scene.camera import CameraLike, as_camera
from gsplat_edu.scene.mesh import Mesh

TRUNCATION = 3.0
"""Default truncation, voxels. On exact depth of a box, the mean error was 0.04 voxel at 3 and 0.06 at 4."""

MOST_TRUNCATION = 64.0
"""Largest truncation, voxels: each ray touches every block within the truncation."""

LARGEST_IMAGE = 1 << 16
"""Most rows and columns of a depth map."""

UNLIMITED = 2**62


class SparseVolume:
    """Signed distances to a surface, averaged over depth maps, in blocks of 8 × 8 × 8 voxels around that surface.

    D = sum_i w_i clamp(d_i - z, -t, t) / sum_i w_i

    z is the depth of the voxel's centre in view i, d_i the view's depth map where that centre projects, and t the
    truncation. A view says nothing about voxels further behind its surface than t; from t/2 on, its weight falls to 0.
    Between four pixels whose depths differ by less than t, 1/d is interpolated, which is exact on planes. Beside a jump
    the nearest pixel's depth counts with 1/64 of its weight: enough to close a hole that no other view closes.

    The bits depend on the order of the views, but not on the number of threads.

    Args:
        voxel: Edge length of a voxel, world units.
        truncation: t, world units, 1 to 64 voxels; `TRUNCATION` voxels if None. It should be at least three
            times the standard deviation of the depth maps' errors, or surfaces shrink.
        max_bytes: Most memory of the blocks; if None, what is free now.

    Raises:
        ArgumentError: a number is out of range.
        BackendUnavailableError: the native module is missing.
    """

    def __init__(self, voxel: float, truncation: float | None = None, max_bytes: int | None = None) -> None:
        self.voxel = in_range("voxel", voxel, 1e-30, 1e30)
        wanted = TRUNCATION * self.voxel if truncation is None else truncation
        self.truncation = in_range("truncation", wanted, self.voxel, MOST_TRUNCATION * self.voxel)
        if max_bytes is None:
            free = available_memory()
            max_bytes = UNLIMITED if free is None else free
        most = whole_number("max_bytes", max_bytes, 0)
        self._native = native().Volume(voxel=self.voxel, truncation=self.truncation, max_bytes=most)

    @property
    def blocks(self) -> int:
        """Number of blocks."""
        return int(self._native.blocks)

    @property
    def memory(self) -> int:
        """Memory of the blocks: 4,120 bytes each, 12,312 with colours."""
        return int(self._native.bytes)

    def integrate(
        self,
        depth: ArrayLike,
        camera: CameraLike,
        weights: ArrayLike | None = None,
        image: ArrayLike | None = None,
    ) -> None:
        """Add one view. After an error the volume is unchanged.

        Arrays are NumPy's, or tensors on the CPU.

        Args:
            depth: (H, W) depth along the camera's z axis, world units, float32 or float64; 0 where there is no surface.
            camera: The pinhole that saw it, H × W.
            weights: (H, W) weight of each pixel, at least 0, float32 or float64; 0 ignores it. None: 1 for all.
            image: (H, W, 3) sRGB, uint8, or float32 or float64 from 0 to 1. Either every view has one, or none.

        Raises:
            ShapeError: an array differs in size from the camera.
            ArgumentError: an array has another dtype, is on another device, or holds a number that is NaN, infinite or
                out of range; an image is missing or unexpected; the depth reaches beyond 8 million voxels from the
                origin.
            NotEnoughMemoryError: the blocks would take more than `max_bytes`.
        """
        camera = as_camera("camera", camera)
        if max(camera.H, camera.W) > LARGEST_IMAGE:
            raise ArgumentError(
                f"camera: has {camera.H} x {camera.W} pixels, but at most {LARGEST_IMAGE} rows and columns are allowed"
            )
        size = (camera.H, camera.W)
        arrays = {
            "depth": _numbers("depth", depth, size, np.inf),
            "weights": None if weights is None else _numbers("weights", weights, size, np.inf),
            "image": None if image is None else _pixels(image, size),
        }
        try:
            self._native.integrate(
                **arrays,
                R=np.ascontiguousarray(camera.R, dtype=np.float64),
                eye=np.ascontiguousarray(camera.eye, dtype=np.float64),
                fx=camera.fx,
                fy=camera.fy,
                cx=camera.cx,
                cy=camera.cy,
                threads=native_threads(),
            )
        except ValueError as error:
            raise ArgumentError(str(error)) from None
        except MemoryError as error:
            raise NotEnoughMemoryError(_shortage(error)) from None

    def mesh(self, min_weight: float = 0.0) -> Mesh:
        """Extract the surface at distance 0.

        Marching cubes; the two cells at a face separate its inner corners in the same way, so that the mesh is a closed
        manifold except at holes. A cell leaves a hole if one of its eight voxels has too little weight.

        Args:
            min_weight: Voxels have to weigh more than this.

        Returns:
            The mesh, with colours if the views had images; without vertices if there is no surface. Vertices and faces
            are in the same order on any number of threads.

        Raises:
            ArgumentError: `min_weight` is negative or NaN.
            NotEnoughMemoryError: the system has no memory for the mesh.
        """
        bound = in_range("min_weight", min_weight, 0.0)
        try:
            vertices, faces, colors = self._native.extract(min_weight=bound, threads=native_threads())
        except MemoryError as error:
            raise NotEnoughMemoryError(_shortage(error)) from None
        # A mean of numbers up to 1 may round to more than 1.
        return Mesh(vertices, faces, None if colors is None else np.minimum(colors, np.float32(1)))


def _numbers(name: str, value: ArrayLike, shape: tuple[int, ...], high: float) -> Float32[np.ndarray, "..."]:
    """Check finite numbers from 0 to `high`; return them as float32, contiguous."""
    given = _array(name, value)
    if given.dtype not in (np.float32, np.float64):
        raise ArgumentError(f"{name}: is of dtype {given.dtype}, but has to be float32 or float64")
    check_shape(name, given.shape, shape, {})
    with np.errstate(over="ignore"):
        numbers = np.ascontiguousarray(given, dtype=np.float32)
    wrong = ~((numbers >= 0) & (numbers <= high) & (numbers < np.inf))
    if wrong.any():
        bounds = "at least 0" if high == np.inf else f"from 0 to {high:g}"
        raise ArgumentError(
            f"{name}{first_index(wrong)}: is {given[wrong][0]}, but every entry has to be finite and {bounds}"
        )
    return numbers


def _pixels(value: ArrayLike, size: tuple[int, int]) -> Shaped[np.ndarray, "H W 3"]:
    given = _array("image", value)
    if given.dtype == np.uint8:
        check_shape("image", given.shape, (*size, 3), {})
        return np.ascontiguousarray(given)
    if given.dtype not in (np.float32, np.float64):
        raise ArgumentError(f"image: is of dtype {given.dtype}, but has to be uint8, float32 or float64")
    return _numbers("image", given, (*size, 3), 1.0)


def _array(name: str, value: ArrayLike) -> Shaped[np.ndarray, "..."]:
    if isinstance(value, Tensor):
        if value.device.type != "cpu":
            raise ArgumentError(f"{name}: is on {value.device}; move it to the CPU")
        try:
            return np.asarray(value.detach().numpy())
        except (TypeError, RuntimeError):  # bfloat16, sparse
            raise ArgumentError(
                f"{name}: is of dtype {value.dtype} and layout {value.layout}, which NumPy lacks"
            ) from None
    if not isinstance(value, np.ndarray):
        raise ArgumentError(f"{name}: is of type {type(value).__name__}, but has to be an array or a tensor")
    return value


def _shortage(error: MemoryError) -> str:
    said = str(error)
    return (
        said if said.startswith("volume:") else "volume: the system has no memory left; take a larger voxel"
    )
