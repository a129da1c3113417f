"""The arguments of `rasterization`, and the checks of their values."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import Enum
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gsplat_edu.base.constants import DILATION_MAX, SPLAT_LIMIT
from gsplat_edu.base.errors import ArgumentError, ShapeError
from gsplat_edu.base.validation import flag, in_range, one_of, quoted, whole_number
from gsplat_edu.ops.kernels import SUFFIXES
from gsplat_edu.scene.gaussians import check_tensor


class RollingShutterType(Enum):
    """gsplat's names of shutters."""

    ROLLING_TOP_TO_BOTTOM = 0
    ROLLING_LEFT_TO_RIGHT = 1
    ROLLING_BOTTOM_TO_TOP = 2
    ROLLING_RIGHT_TO_LEFT = 3
    GLOBAL = 4


MOST_PIXELS = 2**31 - 1
"""Largest width and height, px: the kernels count in 32 bits."""

RENDER_MODES = ("RGB", "D", "ED", "RGB+D", "RGB+ED")
"""Values of `render_mode`."""

CAMERA_MODELS = ("pinhole", "ortho", "fisheye")
"""Values of `camera_model`."""

RADIAL = {"pinhole": 6, "fisheye": 4}
"""Number of radial coefficients of those that may be distorted."""

ONLY_VALUES = {
    "sparse_grad": False,
    "distributed": False,
    "with_eval3d": False,
    "return_normals": False,
    "global_z_order": True,
    "rays": None,
    "ftheta_coeffs": None,
    "lidar_coeffs": None,
    "external_distortion_coeffs": None,
    "ut_params": None,
    "renderer_config": None,
}
"""Arguments that `rasterization` has with one value only."""

REMEDIES = {
    "sparse_grad": "gradients are dense",
    "distributed": "render on one machine",
    "return_normals": "gsplat_edu.render.maps.render_maps renders normals",
    "global_z_order": "Gaussians are sorted by camera depth",
    "with_eval3d": "leave it out, because Gaussians are evaluated on the image plane",
    "rays": "give cameras by viewmats, Ks and camera_model",
    "ftheta_coeffs": "fit radial_coeffs of camera_model='fisheye' to the lens, or undistort the photos",
    "lidar_coeffs": "give cameras by viewmats, Ks and camera_model",
    "external_distortion_coeffs": "undistort the photos first",
    "ut_params": "leave it out, because the projection has no unscented transform",
    "renderer_config": "leave it out, because there is one rasteriser",
}
"""What to do instead."""

DEFAULT_RENDERER = "RendererConfig_MixedBatch"
"""Name of the class that gsplat takes for `renderer_config=None`."""

DEGREES = {"colors": "sh_degree", "extra_signals": "extra_signals_sh_degree"}
"""Which argument is the degree of which coefficients."""

MOST_DEGREE = 4
"""Highest degree of harmonics. Our own renderer, and the scene files of the field, end at 3."""

DEPTH_ONLY = ("D", "ED")
"""Values of `render_mode` that return no colours."""


@dataclass(frozen=True, eq=False)
class Arguments:
    """The arguments of `gsplat_edu.compat.gsplat.rasterization`.

    Leading axes `...` (batches of scenes) are the same for all tensors. All are on the CPU, and all of one dtype,
    float32 or float64.

    Args:
        means: (..., N, 3) centres, world units.
        quats: (..., N, 4) quaternions (w, x, y, z) of any length but 0. Ignored with `covars`.
        scales: (..., N, 3) standard deviations, world units. Ignored with `covars`.
        opacities: (..., N) 0 to 1.
        colors: (..., N, D) or (..., C, N, D) numbers to composite; with `sh_degree` (..., N, K, 3) or (..., C, N, K, 3)
            coefficients. None is allowed if `render_mode` is D or ED.
        viewmats: (..., C, 4, 4) world to camera, OpenCV axes.
        Ks: (..., C, 3, 3) intrinsics, px; the centre of the first pixel is at (0.5, 0.5).
        width: Width of the images, px.
        height: Height of the images, px.
        near_plane: Gaussians nearer than this are not drawn, world units.
        far_plane: Nor are Gaussians farther away than this.
        radius_clip: Nor are Gaussians whose box has half sizes of at most this, px.
        eps2d: Added to the diagonal of every screen covariance, px², 0 to 1e6.
        sh_degree: Highest degree of the harmonics to use, 0 to 4; None if `colors` are not coefficients.
        packed: Whether `meta` lists the drawn Gaussians only, (nnz, ...), instead of all, (..., C, N, ...). The images
            and the work are the same.
        tile_size: Only sets tile_width and tile_height in `meta`; the kernels have tiles of 16 px.
        backgrounds: (..., C, D) colours behind everything; None for 0. With `extra_signals` (..., C, D + E), or
            (..., C, E) for D and ED, which ignore `backgrounds` otherwise.
        render_mode: Which channels to return: RGB, D, ED, RGB+D, RGB+ED.
        sparse_grad: False.
        absgrad: Whether the backward pass sets `meta["means2d"].absgrad`.
        rasterize_mode: "classic", or "antialiased": opacities times sqrt(det0 / det).
        channel_chunk: No effect: any number of channels is composited, 32 beside the first three at a time.
        distributed: False.
        camera_model: "pinhole", "ortho" (a focal length is px per world unit) or "fisheye" (the angle to the axis is
            proportional to the radius). z decides what is near, far and in front, of all three.
        segmented: No effect: it selects a sort in gsplat.
        covars: (..., N, 3, 3) covariances, world units²; the upper triangle is read.
        with_ut: No effect: distortion and shutter have exact Jacobians here (`gsplat_edu.compat.lenses`).
        with_eval3d: False.
        return_normals: False.
        global_z_order: True.
        rays: None.
        radial_coeffs: (..., C, 6) k1 to k6 of OpenCV's rational model of a pinhole, (..., C, 4) of a fisheye.
        tangential_coeffs: (..., C, 2) p1 and p2 of a pinhole.
        thin_prism_coeffs: (..., C, 4) s1 to s4 of a pinhole.
        ftheta_coeffs: None.
        lidar_coeffs: None.
        external_distortion_coeffs: None.
        rolling_shutter: A member of `RollingShutterType`, ours or gsplat's. Unless it is GLOBAL, `viewmats` are the
            poses of the row or column that is read first,
        viewmats_rs: (..., C, 4, 4) and these of the one that is read last.
        ut_params: None.
        extra_signals: (..., N, E) or (..., C, N, E) further channels, composited with the weights of the colours into
            `meta["render_extra_signals"]`; with `extra_signals_sh_degree` (N, K, E) coefficients, shared by all scenes.
        extra_signals_sh_degree: Highest degree of their harmonics to use, 0 to 4. 0.5 is added to the sum, as for
            colours, but there is no floor.
        renderer_config: None, or gsplat's default, `RendererConfig_MixedBatch()`.

    Raises:
        ShapeError: a shape differs.
        ArgumentError: a value is not finite, out of range or not supported; the message names the argument.
    """

    means: Tensor
    quats: Tensor | None
    scales: Tensor | None
    opacities: Tensor
    colors: Tensor | None
    viewmats: Tensor
    Ks: Tensor
    width: int
    height: int
    near_plane: float
    far_plane: float
    radius_clip: float
    eps2d: float
    sh_degree: int | None
    packed: bool
    tile_size: int
    backgrounds: Tensor | None
    render_mode: str
    sparse_grad: bool
    absgrad: bool
    rasterize_mode: str
    channel_chunk: int
    distributed: bool
    camera_model: str
    segmented: bool
    covars: Tensor | None
    with_ut: bool
    with_eval3d: bool
    return_normals: bool
    global_z_order: bool
    rays: Any
    radial_coeffs: Any
    tangential_coeffs: Any
    thin_prism_coeffs: Any
    ftheta_coeffs: Any
    lidar_coeffs: Any
    external_distortion_coeffs: Any
    rolling_shutter: Any
    viewmats_rs: Any
    ut_params: Any
    extra_signals: Tensor | None
    extra_signals_sh_degree: int | None
    renderer_config: Any
    batch: tuple[int, ...] = field(init=False)
    N: int = field(init=False)
    C: int = field(init=False)

    def __post_init__(self) -> None:
        """Check every argument."""
        for name, only in ONLY_VALUES.items():
            _check_only(name, getattr(self, name), only)
        one_of("render_mode", self.render_mode, RENDER_MODES)
        one_of("rasterize_mode", self.rasterize_mode, ("classic", "antialiased"))
        for name in ("packed", "absgrad", "segmented", "with_ut"):
            flag(name, getattr(self, name))
        check_size(self.width, self.height)
        for name in ("tile_size", "channel_chunk"):
            whole_number(name, getattr(self, name), 1)
        check_limits(self.near_plane, self.far_plane, self.radius_clip, self.eps2d)
        named = {name: getattr(self, name) for name in ("means", "quats", "scales", "opacities")}
        batch, N = check_scene(named, self.covars is not None)
        if self.covars is not None:
            expect("covars", self.covars, (*batch, N, 3, 3), self.means)
        C = check_cameras(self.viewmats, self.Ks, batch, self.means)
        for name, value in (("batch", batch), ("N", N), ("C", C)):
            object.__setattr__(self, name, value)
        self._check_lens()
        colors = self._check_colors()
        drawn = (0 if self.render_mode in DEPTH_ONLY else colors) + self._check_extra_signals()
        if self.backgrounds is not None:
            check_tensor("backgrounds", self.backgrounds, ("...",), {})
            # Backgrounds that no channel is composited over have no effect; gsplat takes them.
            channels = drawn or colors or (0, *self.backgrounds.shape)[-1]
            expect("backgrounds", self.backgrounds, (*self.batch, self.C, channels), self.means)

    def _check_lens(self) -> None:
        """Check distortion and shutter."""
        check_camera_model(self.camera_model)
        radial = RADIAL.get(self.camera_model, 0)
        counts = {"radial_coeffs": radial, "tangential_coeffs": 2, "thin_prism_coeffs": 4}
        for name, count in counts.items():
            tensor = getattr(self, name)
            if tensor is None:
                continue
            if self.camera_model == "ortho" or (self.camera_model == "fisheye" and name != "radial_coeffs"):
                raise ArgumentError(
                    f"{name}: a camera with camera_model={self.camera_model!r} has none; leave it out"
                )
            expect(name, tensor, (*self.batch, self.C, count), self.means)
        shutter = getattr(self.rolling_shutter, "name", None)
        if not isinstance(shutter, str) or shutter not in RollingShutterType.__members__:
            raise ArgumentError(
                f"rolling_shutter: is {quoted(self.rolling_shutter)}, but has to be a member of RollingShutterType"
            )
        if (shutter == RollingShutterType.GLOBAL.name) != (self.viewmats_rs is None):
            raise ArgumentError(
                "viewmats_rs: is None; a rolling shutter needs the poses of what is read last"
                if self.viewmats_rs is None
                else "viewmats_rs: is given, but rolling_shutter is GLOBAL; name the direction of the readout"
            )
        if self.viewmats_rs is not None:
            expect("viewmats_rs", self.viewmats_rs, (*self.batch, self.C, 4, 4), self.means)

    def _check_colors(self) -> int:
        """Check colours or coefficients; return the number of their channels."""
        if self.colors is None:
            if self.render_mode not in DEPTH_ONLY:
                raise ArgumentError(
                    f"colors: is None, but render_mode {self.render_mode!r} returns colours; give them, or render 'ED'"
                )
            if self.sh_degree is not None:
                raise ArgumentError(
                    "sh_degree: is given, but colors is None; give coefficients, or no degree"
                )
            return 0
        return self._check_channels("colors", self.colors, self.sh_degree, self.colors_per_camera, 3)

    def _check_extra_signals(self) -> int:
        """Check further channels; return their number."""
        signals, degree = self.extra_signals, self.extra_signals_sh_degree
        if signals is None:
            if degree is not None:
                raise ArgumentError(
                    "extra_signals_sh_degree: is given, but extra_signals is None; give coefficients, or no degree"
                )
            return 0
        channels = self._check_channels("extra_signals", signals, degree, self.extra_signals_per_camera, None)
        if channels == 0:
            raise ShapeError(f"extra_signals: has shape {tuple(signals.shape)}, but has to have a channel")
        return channels

    def _check_channels(
        self, name: str, tensor: Tensor, degree: int | None, per_camera: bool, of_harmonics: int | None
    ) -> int:
        """Check channels of Gaussians, or coefficients of them; return the number of channels.

        Args:
            name: The argument to name.
            tensor: Its value.
            degree: Highest degree of the harmonics; None for channels.
            per_camera: Whether it has an axis of cameras.
            of_harmonics: Channels that coefficients have; None for any, and for coefficients without leading axes.
        """
        check_tensor(name, tensor, ("...",), {})
        channels = tensor.shape[-1] if tensor.ndim else 0
        lead = (*self.batch, *([self.C] if per_camera else []))
        tail: tuple[int, ...] = (channels,)
        if degree is not None:
            most = (whole_number(DEGREES[name], degree, 0, MOST_DEGREE) + 1) ** 2
            channels = channels if of_harmonics is None else of_harmonics
            lead, tail = () if of_harmonics is None else lead, (max(most, *tensor.shape[-2:-1]), channels)
        expect(name, tensor, (*lead, self.N, *tail), self.means)
        return channels

    @property
    def colors_per_camera(self) -> bool:
        """Whether `colors` have an axis of cameras."""
        axes = len(self.batch) + (3 if self.sh_degree is None else 4)
        return isinstance(self.colors, Tensor) and self.colors.ndim == axes

    @property
    def extra_signals_per_camera(self) -> bool:
        """Whether `extra_signals` have an axis of cameras; coefficients have none."""
        if self.extra_signals_sh_degree is not None or not isinstance(self.extra_signals, Tensor):
            return False
        return self.extra_signals.ndim == len(self.batch) + 3

    @property
    def batches(self) -> int:
        """Number of scenes."""
        return math.prod(self.batch)


def _check_only(name: str, value: object, only: object) -> None:
    """Check an argument of which one value is supported."""
    if name == "renderer_config" and type(value).__name__ == DEFAULT_RENDERER:
        return
    if type(value) is not type(only) or value != only:
        plain = isinstance(value, bool | int | float | str | Enum)
        shown = repr(value) if plain else f"of type {type(value).__name__}"
        raise ArgumentError(f"{name}: is {shown}, but only {only!r} is supported; {REMEDIES[name]}")


def real_tensor(name: str, tensor: Any) -> Tensor:  # noqa: ANN401
    """Check that a tensor is one of the dtypes and on the device that the kernels take."""
    if not isinstance(tensor, Tensor) or tensor.dtype not in SUFFIXES or tensor.device.type != "cpu":
        raise ArgumentError(f"{name}: has to be a tensor of float32 or float64 on the CPU")
    return tensor


def check_size(width: int, height: int, *names: str) -> None:
    """Check the size of the images; `names` are those of the two arguments, if they are others."""
    for name, size in zip(names or ("width", "height"), (width, height), strict=True):
        whole_number(name, size, 1, MOST_PIXELS)


def check_limits(near_plane: float, far_plane: float, radius_clip: float, eps2d: float) -> None:
    """Check the numbers that decide which Gaussians count."""
    named = {"near_plane": near_plane, "far_plane": far_plane, "radius_clip": radius_clip}
    for name, value in named.items():
        in_range(name, value, 0.0)
    in_range("eps2d", eps2d, 0.0, DILATION_MAX)


def check_projection_options(sparse_grad: bool, camera_model: str) -> None:
    """Check the arguments of `fully_fused_projection` of which not all values are supported."""
    _check_only("sparse_grad", sparse_grad, False)
    check_camera_model(camera_model)


def check_camera_model(value: object) -> None:
    """Check a camera model."""
    if isinstance(value, str) and value in ("ftheta", "lidar"):
        raise ArgumentError(
            f"camera_model: is {value!r}, which is not supported; {REMEDIES[f'{value}_coeffs']}"
        )
    one_of("camera_model", value, CAMERA_MODELS)


def check_scene(named: Mapping[str, Tensor | None], from_covars: bool) -> tuple[tuple[int, ...], int]:
    """Check means, and quats, scales and opacities as far as they are needed; return the leading axes and N."""
    means = real_tensor("means", named["means"])
    batch, N = tuple(means.shape[:-2]), means.shape[-2] if means.ndim >= 2 else 0
    expect("means", means, (*batch, N, 3), means)
    for name, tail in (("quats", (4,)), ("scales", (3,)), ("opacities", ())):
        tensor = named[name]
        if from_covars and name in ("quats", "scales"):
            continue
        if tensor is None:
            if name == "opacities":
                continue
            raise ArgumentError(f"{name}: is None; give quats and scales, or covars")
        expect(name, tensor, (*batch, N, *tail), means)
    return batch, N


def check_cameras(viewmats: Tensor, Ks: Tensor, batch: tuple[int, ...], means: Tensor) -> int:
    """Check the matrices of the cameras; return their number, which is the same in each batch."""
    check_tensor("viewmats", viewmats, ("...",), {})
    C = max(viewmats.shape[-3] if viewmats.ndim >= 3 else 1, 1)
    expect("viewmats", viewmats, (*batch, C, 4, 4), means)
    expect("Ks", Ks, (*batch, C, 3, 3), means)
    return C


def check_spreads(
    name: str, spreads: Tensor, positions: Tensor, sizes: tuple[tuple[int, ...], int, int]
) -> None:
    """Check that no drawn Gaussian is larger on the screen than the kernels can hold; `name` made the covariances.

    Args:
        name: The argument to name.
        spreads: (nnz, 3) xx, xy and yy of the screen covariances of the drawn ones, px².
        positions: (nnz,) their positions in (B, C, N).
        sizes: Leading axes of the argument, C and N.
    """
    batch, C, N = sizes
    wide = spreads.detach()[:, 0] + spreads.detach()[:, 2] > 0.5 * SPLAT_LIMIT**2
    if bool(wide.any()):
        at = int(positions[wide.nonzero()[0, 0]])
        where = (*np.unravel_index(at // (C * N), batch), at % N) if batch else (at % N,)
        raise ArgumentError(
            f"{name}[{', '.join(map(str, where))}]: makes a Gaussian of more than {SPLAT_LIMIT:g} px on the screen, "
            "which the kernels cannot draw; make it smaller or remove it"
        )


def expect(name: str, tensor: Any, shape: tuple[int, ...], like: Tensor, named: str = "means") -> None:  # noqa: ANN401
    """Check a tensor's shape and that it is finite, and that dtype and device are those of another, `named`."""
    if not isinstance(tensor, Tensor) or (tensor.dtype, tensor.device) != (like.dtype, like.device):
        given = f"{tensor.dtype} on {tensor.device}" if isinstance(tensor, Tensor) else type(tensor).__name__
        raise ArgumentError(f"{name}: is {given}, but has to be {like.dtype} on {like.device}, as {named}")
    if tuple(tensor.shape) != shape:
        raise ShapeError(f"{name}: has shape {tuple(tensor.shape)}, but has to be {shape}")
    with torch.no_grad():
        check_tensor(name, tensor, ("...",), {})
