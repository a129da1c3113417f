"""Render settings: choices independent of scene and camera."""

from __future__ import annotations

from dataclasses import dataclass

from gsplat_edu.base.constants import ALPHA_MAX, ALPHA_MIN, DILATION, DILATION_MAX, SH_MAX_DEGREE, Z_NEAR
from gsplat_edu.base.errors import BackendUnavailableError
from gsplat_edu.base.validation import flag, float64_array, in_range, one_of, quoted, whole_number

BACKENDS = ("cuda", "webgpu", "cpu", "torch")
"""All backends: Triton kernels on a GPU; WGSL kernels on any GPU; native SIMD kernels; the dense reference, which
evaluates every splat at every pixel."""

MAPS = ("alpha", "depth", "expected-depth", "median-depth", "planar-depth", "normal", "distortion")
"""The maps of `gsplat_edu.render.maps`, by name. The command line lists them without importing torch."""


def check_backend(name: str) -> None:
    """Check that a backend's name is known; `gsplat_edu.render.backends` tells whether it is available here.

    Args:
        name: "auto", or a backend by name.

    Raises:
        BackendUnavailableError: the backend does not exist.
    """
    known: tuple[object, ...] = ("auto", *BACKENDS)
    if type(name) not in map(type, known) or name not in known:
        raise BackendUnavailableError(
            f"backend {quoted(name)}: not in this version of gsplat_edu; use auto or one of: {', '.join(BACKENDS)}"
        )


@dataclass(frozen=True)
class RenderSettings:
    """Settings of a render.

    Args:
        background: RGB colour behind everything.
        sh_degree: Highest SH degree to use; lower if the Gaussians store fewer coefficients.
        antialiased: Lower each opacity to compensate for the dilation (Mip-Splatting), see
            `gsplat_edu.scene.gaussian_math.opacity_compensation`.
        depth: Also render expected depth. Training without a depth loss is faster without it.
        median_depth: Also render median depth.
        dilation: Added to both diagonal entries of every screen-space covariance, px², 0 to 1e6. Below 2e-6, Gaussians
            thinner than 1/1000 px on the screen are not drawn (`gsplat_edu.base.constants.THINNEST`).
        jacobian_limit: Clamp x/z and y/z inside the projection's Jacobian to this multiple of half the field of view
            (`Camera.jacobian_bounds`); 1.3 for captures, as in Kerbl et al.'s code; None disables clamping.
        alpha_max: Clamp of a splat's alpha in a pixel, 1/255 to 0.9999; gsplat uses 0.999.
        stop: When compositing ends before the last Gaussian. "tile": for the pixels of a 16x16 tile together, once all
            of their transmittances are below 1e-4. "pixel": for each pixel, before the first Gaussian that would take
            its transmittance to 1e-4 or below, as in Kerbl et al.'s code and gsplat; cpu and webgpu offer it.
        z_near: Gaussians whose means are at this camera depth or nearer are not drawn, world units.

    Raises:
        ShapeError: the background is not of shape (3,).
        ArgumentError: a value is out of range.
    """

    background: tuple[float, float, float] = (0.0, 0.0, 0.0)
    sh_degree: int = SH_MAX_DEGREE
    antialiased: bool = False
    depth: bool = True
    median_depth: bool = False
    dilation: float = DILATION
    jacobian_limit: float | None = None
    alpha_max: float = ALPHA_MAX
    stop: str = "tile"
    z_near: float = Z_NEAR

    def __post_init__(self) -> None:
        """Check the ranges, and convert NumPy scalars and arrays to plain Python values for the kernels."""
        limit = self.jacobian_limit
        one_of("stop", self.stop, ("tile", "pixel"))
        plain = {
            "background": tuple(float64_array("background", self.background, (3,)).tolist()),
            "sh_degree": whole_number("sh_degree", self.sh_degree, 0, SH_MAX_DEGREE),
            "antialiased": flag("antialiased", self.antialiased),
            "depth": flag("depth", self.depth),
            "median_depth": flag("median_depth", self.median_depth),
            "dilation": in_range("dilation", self.dilation, 0.0, DILATION_MAX),
            "jacobian_limit": None if limit is None else in_range("jacobian_limit", limit, 1.0),
            "alpha_max": in_range("alpha_max", self.alpha_max, ALPHA_MIN, 0.9999),
            "z_near": in_range("z_near", self.z_near, 0.0),
        }
        for name, value in plain.items():
            object.__setattr__(self, name, value)
