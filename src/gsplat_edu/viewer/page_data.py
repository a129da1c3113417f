"""Binary layout of a page's splats: one little-endian array after another, each with all splats.

    means            3 float32   world units
    log_scales       3 float32
    quats            4 int16     the unit quaternion (w, x, y, z) times 32767; zeros where it has zero length
    sh               3 (d + 1)² float16   coefficient by coefficient, RGB
    logit_opacities  1 float16

Means and scales keep their full precision because every error of a needle is visible close up. A quaternion component
is off by at most 1/65534, which rotates the splat by less than 1e-4 rad; float16 keeps 11 bits.

`viewer/web/scene.js` reads the same list.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Float16, Float32, Int16

from gsplat_edu.base.errors import SceneFormatError
from gsplat_edu.scene.gaussians import Gaussians

QUAT_STEPS = 32767
"""Integer steps from 0 to 1 in a quaternion component."""


def packed(gaussians: Gaussians) -> bytes:
    """Pack Gaussians.

    Args:
        gaussians: N Gaussians, all finite. SH coefficients and logits beyond the range of float16 are clamped to it.

    Returns:
        `size(N, degree)` bytes.
    """
    tensors = {name: tensor.numpy(force=True) for name, tensor in gaussians.tensors().items()}
    sh = np.empty((len(gaussians), 1 + gaussians.sh_rest.shape[1], 3), dtype="<f2")
    sh[:, :1], sh[:, 1:] = _half(tensors["sh0"]), _half(tensors["sh_rest"])
    arrays = (
        _single(tensors["means"]),
        _single(tensors["log_scales"]),
        _whole(tensors["quats"]),
        sh,
        _half(tensors["logit_opacities"]),
    )
    return b"".join(array.data.cast("B") if array.size else b"" for array in arrays)


def size(count: int, sh_degree: int) -> int:
    """Return the packed size of Gaussians in bytes."""
    return count * (12 + 12 + 8 + 6 * (sh_degree + 1) ** 2 + 2)


def unpacked(path: Path, data: bytes, count: int, sh_degree: int) -> Gaussians:
    """Unpack Gaussians.

    Args:
        path: The file's name for messages.
        data: `size(count, sh_degree)` bytes.
        count: Number of Gaussians.
        sh_degree: Their SH degree.

    Returns:
        N Gaussians, float32.

    Raises:
        SceneFormatError: a value is NaN or infinite.
    """
    begin = 0

    def take(dtype: str, *shape: int) -> torch.Tensor:
        nonlocal begin
        values = np.frombuffer(data, dtype, count * int(np.prod(shape)), begin)
        begin += values.nbytes
        return torch.from_numpy(values.astype(np.float32).reshape(count, *shape))

    means, log_scales, quats = take("<f4", 3), take("<f4", 3), take("<i2", 4) / QUAT_STEPS
    sh, logits = take("<f2", (sh_degree + 1) ** 2, 3), take("<f2", 1)
    gaussians = Gaussians(
        means=means,
        quats=quats,
        log_scales=log_scales,
        sh0=sh[:, :1].contiguous(),
        sh_rest=sh[:, 1:].contiguous(),
        logit_opacities=logits[:, 0].contiguous(),
    )
    finite = gaussians.finite_rows()
    if not bool(finite.all()):
        bad = int((~finite).sum())
        raise SceneFormatError(f"{path}: {bad} splats have NaN or infinite values; export the page again")
    return gaussians


def _single(values: Float[np.ndarray, "*shape"]) -> Float32[np.ndarray, "*shape"]:
    return _rounded(values, np.dtype("<f4"))


def _half(values: Float[np.ndarray, "*shape"]) -> Float16[np.ndarray, "*shape"]:
    return _rounded(values, np.dtype("<f2"))


def _rounded(
    values: Float[np.ndarray, "*shape"], dtype: np.dtype[np.floating]
) -> Float[np.ndarray, "*shape"]:
    if values.dtype == dtype:
        return np.ascontiguousarray(values)
    most = np.finfo(dtype).max
    clipped: Float[np.ndarray, "*shape"] = np.clip(values, -most, most).astype(dtype)
    return clipped


def _whole(quats: Float[np.ndarray, "N 4"]) -> Int16[np.ndarray, "N 4"]:
    # Dividing by the largest entry first keeps the norm from overflowing or underflowing.
    largest = np.abs(quats).max(axis=1, keepdims=True, initial=0.0)
    scaled = quats / np.where(largest > 0, largest, 1.0)
    norms = np.linalg.norm(scaled, axis=1, keepdims=True)
    whole: Int16[np.ndarray, "N 4"] = np.rint(QUAT_STEPS * scaled / np.where(norms > 0, norms, 1.0)).astype(
        "<i2"
    )
    return whole
