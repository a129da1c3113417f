"""How to render: the choices that are not the scene's and not the camera's."""

from __future__ import annotations

from dataclasses import dataclass

from gsplat_edu.constants import SH_MAX_DEGREE
from gsplat_edu.validation import float64_array, in_range, whole_number


@dataclass(frozen=True)
class RenderSettings:
    """Choices of one render.

    Args:
        background: Colour behind everything, RGB.
        sh_degree: Highest degree of spherical harmonics to use; less where the Gaussians store less.
        antialiased: Lower each opacity by the light that the dilation adds (Mip-Splatting), see
            `gsplat_edu.gaussian_math.opacity_compensation`.
        depth: Render expected depth too. Training that does not look at depth is faster without.
        jacobian_limit: x/z and y/z inside the projection's Jacobian are clamped to this many half fields of view
            (`Camera.jacobian_bounds`); 1.3 for captures, as in Kerbl et al.'s code; None clamps nothing.
        dense_chunk: Splats that the dense torch backend evaluates at once. It decides speed, not the image
            (beyond rounding); 16 keeps a chunk in a core's cache at 128 px (benchmarks/RESULTS.md).

    Raises:
        ShapeError: the background is not of shape (3,).
        ArgumentError: a value is outside its range.
    """

    background: tuple[float, float, float] = (0.0, 0.0, 0.0)
    sh_degree: int = SH_MAX_DEGREE
    antialiased: bool = False
    depth: bool = True
    jacobian_limit: float | None = None
    dense_chunk: int = 16

    def __post_init__(self) -> None:
        """Check the ranges, and turn NumPy scalars and arrays into plain Python values, which the kernels take."""
        limit = self.jacobian_limit
        plain = {
            "background": tuple(float64_array("background", self.background, (3,)).tolist()),
            "sh_degree": whole_number("sh_degree", self.sh_degree, 0, SH_MAX_DEGREE),
            "antialiased": bool(self.antialiased),
            "depth": bool(self.depth),
            "jacobian_limit": None if limit is None else in_range("jacobian_limit", limit, 1.0),
            "dense_chunk": whole_number("dense_chunk", self.dense_chunk, 1),
        }
        for name, value in plain.items():
            object.__setattr__(self, name, value)
