"""A step of training as a program of the engine: render, loss, gradients, Adam and statistics in one submission.

    render -> gate -> loss_maps -> loss_gradient -> composite_backward -> project_backward -> gaussian_step -> rest_step

The Gaussians, their moments and their statistics stay in the program's buffers. Nothing waits for the host: it reads
`live`, eight words, when a step is done. A step that needs more room for pairs than there is sets `live[HALT]`; neither
it nor those after it change anything until the host clears that word.
"""

from __future__ import annotations

import functools
import struct
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from gsplat_edu.engine.frame import (
    CORE,
    EDGES,
    GAUSSIANS,
    PAIR,
    PAIRS,
    gradient_passes,
    render_buffers,
    render_passes,
    rounded_pairs,
)
from gsplat_edu.engine.passes import Buffer, Pass, Program, Size

HALT, L1, DISSIMILARITY, OPACITY, SCALE, LIVE = 3, 4, 5, 6, 7, 8
"""Places in `live` beyond those of a render: the flag, sums of |image - photo| and of 1 - SSIM over all values, sums of
opacities and scales, as floats; and its length."""

MAPS, STATISTICS, BLOCK = 9, 2, 256
"""Numbers of a pixel's maps and of a Gaussian's statistics, and Gaussians that share a sum of penalties."""

PHOTO_WORDS = 4
"""Words of a pixel of a photo in floats; one in bytes has one."""

GROUPS = ("means", "quats", "log_scales", "sh0", "logit_opacities", "sh_rest")
"""Adam's groups, in the order of `step.wgsl`."""

STATE = ("core", "rest", "core_first", "core_second", "rest_first", "rest_second", "statistics")
"""Buffers that a step changes for good."""

VIEW_BYTES, ROW, SHELL_ROW = 176, 16, 13
"""Bytes of the uniform block before the step's numbers, of a row of those, and the row of the shell."""

PAIRS_AT_FIRST, PAIRS_SPARE = 2.0, 1.25
"""Pairs per Gaussian for which there is room before the first step, and the factor on what a step needed."""

NO_SHELL = (0.0, 0.0, 0.0, -1.0)
"""Stands for a scene without far splats."""


@functools.cache
def step_program(tile_bits: int, optics: str = "pinhole") -> Program:
    """Return the program of a step.

    Its counts are those of a render; "pixels" and "edges" may be those of the largest view.

    Args:
        tile_bits: Bits of the number of tiles, by which pairs are sorted.
        optics: One of `gsplat_edu.engine.view.OPTICS`.
    """
    core, rest = Size("gaussians", CORE), Size("rest")
    buffers = (
        *render_buffers(optics),
        *(Buffer(f"core_{moment}", core) for moment in ("first", "second")),
        *(Buffer(f"rest_{moment}", rest) for moment in ("first", "second")),
        Buffer("statistics", Size("gaussians", STATISTICS)),
        *(Buffer("photo", Size("pixels", PHOTO_WORDS)), Buffer("maps", Size("pixels", MAPS))),
        *(Buffer("loss_sums", Size("edges", 2)), Buffer("penalty_sums", Size("gaussians", 2, BLOCK))),
    )
    drawing, gradients = render_passes(tile_bits, optics), gradient_passes(optics)
    return Program(buffers, {"step": (*drawing, *_loss(), *gradients, *_adam()), "noise": _noise()})


def pairs_room(gaussians: int, pairs_each: float) -> int:
    """Return the pairs for which a training makes room.

    Args:
        gaussians: Their number.
        pairs_each: `PAIRS_SPARE` times the most pairs per Gaussian of a step so far, at least `PAIRS_AT_FIRST`.
    """
    return rounded_pairs(int(pairs_each * gaussians))


def loss_program() -> Program:
    """Return the program of the loss alone; counts "pixels", "edges" and "live"."""
    names = {"image", "photo", "maps", "grads", "loss_sums", "live"}
    buffers = tuple(buffer for buffer in step_program(8).buffers if buffer.name in names)
    return Program(buffers, {"loss": _loss()[1:]})


def adam_program() -> Program:
    """Return the program of the penalties and Adam alone; counts "gaussians", "rest" and "live"."""
    names = {"core_grads", "rest_grads", "records", "penalty_sums", "live", *STATE}
    buffers = tuple(buffer for buffer in step_program(8).buffers if buffer.name in names)
    return Program(buffers, {"adam": _adam(), "noise": _noise()})


def _loss() -> tuple[Pass, ...]:
    return (
        Pass("adam", "gate", (), ("live",), PAIR, 0, live=PAIRS),
        Pass("loss", "loss_maps", ("image", "photo"), ("maps", "loss_sums"), EDGES, 1),
        Pass("loss", "loss_gradient", ("image", "photo", "maps"), ("grads",), EDGES, 1),
        Pass("adam", "total", ("loss_sums",), ("live",), EDGES, 0, live=L1),
    )


def _adam() -> tuple[Pass, ...]:
    moments = ("core", "core_first", "core_second", "statistics")
    return (
        Pass("adam", "penalties", ("core", "records", "live"), ("penalty_sums",), GAUSSIANS, BLOCK),
        Pass("adam", "total", ("penalty_sums",), ("live",), Size("gaussians", 1, BLOCK), 0, live=OPACITY),
        Pass("adam", "gaussian_step", ("core_grads", "records", "live"), moments, GAUSSIANS, 64),
        Pass(
            "adam",
            "rest_step",
            ("rest_grads", "live"),
            ("rest", "rest_first", "rest_second"),
            Size("rest"),
            BLOCK,
        ),
    )


def _noise() -> tuple[Pass, ...]:
    return (Pass("noise", "add_noise", ("live",), ("core",), GAUSSIANS, BLOCK),)


Rates = tuple[float, float, float, float, float, float]
"""Rate, beta1, beta2, eps, 1 - beta1^t and 1 - beta2^t of a group, as `gsplat_edu.ops.moments.AdamNumbers`."""


@dataclass(frozen=True)
class StepNumbers:
    """The numbers of one step besides the camera's.

    Args:
        rates: Adam's numbers by the names of `GROUPS`; a group that is missing does not move.
        ssim_weight: k.
        opacity_weight: Of the mean opacity.
        few_visible: If fewer Gaussians are visible, the mean is over those.
        scale_weight: Of the mean scale.
        shell: Centre and squared distance beyond which a splat is far; see `NO_SHELL`.
        collects: Whether statistics are collected.
    """

    rates: Mapping[str, Rates] = field(default_factory=dict)
    ssim_weight: float = 0.2
    opacity_weight: float = 0.0
    few_visible: int = 0
    scale_weight: float = 0.0
    shell: tuple[float, float, float, float] = NO_SHELL
    collects: bool = False

    def packed(self, pixels: int, gaussians: int, floats: bool) -> bytes:
        """Return what follows the view in the uniform block, for `step.wgsl`.

        Args:
            pixels: Of the view.
            gaussians: Their number.
            floats: Whether the photo has floats.
        """
        numbers: list[float] = []
        for name in GROUPS:
            rate, b1, b2, eps, correction1, correction2 = self.rates.get(name, (0.0, 1.0, 1.0, 1.0, 1.0, 1.0))
            numbers += [rate, b1, 1.0 - b1, b2, 1.0 - b2, eps, correction1, correction2]
        each = 1.0 / max(3 * pixels, 1)
        k = self.ssim_weight
        numbers += [
            (1.0 - k) * each,
            k * each,
            self.opacity_weight,
            self.scale_weight / max(3 * gaussians, 1),
        ]
        numbers += self.shell
        rules = (self.few_visible, int(self.collects), int(floats), gaussians)
        return struct.pack(f"<{len(numbers)}f4I", *numbers, *rules)


@dataclass(frozen=True)
class Noise:
    """The numbers of random steps; they mean what `gsplat_edu.ops.noise.NoiseNumbers` says.

    Args:
        seed: Low and high word.
        amount: Of a fully open gate.
        sharpness: k.
        threshold: t.
        shell: Centre and squared distance beyond which a splat stays; see `NO_SHELL`.
    """

    seed: tuple[int, int]
    amount: float
    sharpness: float
    threshold: float
    shell: tuple[float, float, float, float] = NO_SHELL

    def packed(self) -> bytes:
        """Return the whole uniform block: no other number of the view matters."""
        before = bytes(VIEW_BYTES + ROW * SHELL_ROW)
        gate = (self.amount, self.sharpness, self.threshold, 0.0)
        return before + struct.pack("<4f4x4x4x4x4f2I", *self.shell, *gate, *self.seed)


@dataclass(frozen=True, eq=False)
class PackedPhoto:
    """A photo as the engine takes it.

    Args:
        words: (H W,) uint32: red, green, blue and 255 where the pixel counts, from the lowest byte; or (H W, 4): three
            floats and 1 where it counts, as bits.
    """

    words: np.ndarray

    @property
    def floats(self) -> bool:
        """Whether it has floats."""
        return self.words.ndim == 2

    @staticmethod
    def packed(image: np.ndarray, mask: np.ndarray | None) -> PackedPhoto:
        """Pack a photo, in bytes if that keeps all of its digits.

        Args:
            image: (H, W, 3) uint8, or float32 from 0 to 1.
            mask: (H, W) true for pixels that count; None if all do.
        """
        pixels = image.reshape(-1, 3)
        counts = np.ones(len(pixels), dtype=bool) if mask is None else mask.reshape(-1)
        if pixels.dtype != np.uint8:
            rounded = np.clip(np.rint(255.0 * pixels), 0, 255).astype(np.uint8)
            if not np.array_equal(rounded.astype(np.float32) / np.float32(255.0), pixels):
                words = np.empty((len(pixels), PHOTO_WORDS), dtype=np.uint32)
                words[:, :3] = np.ascontiguousarray(pixels, dtype=np.float32).view(np.uint32)
                words[:, 3] = counts
                return PackedPhoto(words)
            pixels = rounded
        rgba = np.empty((len(pixels), 4), dtype=np.uint8)
        rgba[:, :3], rgba[:, 3] = pixels, np.where(counts, 255, 0)
        return PackedPhoto(rgba.view("<u4")[:, 0].astype(np.uint32, copy=False))


def loss_value(live: np.ndarray, pixels: int, ssim_weight: float) -> float:
    """Return (1 - k) L1 + k (1 - SSIM) from the sums in `live`."""
    l1, dissimilarity = live.view(np.float32)[[L1, DISSIMILARITY]].astype(np.float64) / max(3 * pixels, 1)
    return float((1.0 - ssim_weight) * l1 + ssim_weight * dissimilarity)
