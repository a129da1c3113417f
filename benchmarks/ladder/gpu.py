"""The rungs on a GPU: WGSL kernels for splats that are on the screen already, played by the engine's host.

    naive       every pixel reads every splat (naive.wgsl)
    tiles       count.wgsl -> scan -> emit pairs -> sort by tile -> ranges -> composite, and back: composite_backward,
                add_slots.wgsl

All kernels but the three of this folder are the engine's own, in src/gsplat_edu/engine.
"""

from __future__ import annotations

import functools
import os
import tempfile
from pathlib import Path
from typing import NamedTuple

import numpy as np

os.environ.setdefault("XDG_RUNTIME_DIR", tempfile.gettempdir())  # Mesa's drivers complain without it

from gsplat_edu.base.constants import ALPHA_MAX, ALPHA_MIN, DILATION, TILE, Z_NEAR
from gsplat_edu.engine.adapters import adapters, chosen_adapter, why_unavailable
from gsplat_edu.engine.frame import LIVE, PIXEL, RECORD, SLOT, SPARE, rounded_pairs
from gsplat_edu.engine.host import Device, Memory
from gsplat_edu.engine.passes import (
    FOLDER,
    MODULES,
    Buffer,
    Pass,
    Program,
    Size,
    scan,
    scan_scratch,
    sort,
    sort_bits,
    sort_scratch,
)
from gsplat_edu.engine.view import DeviceView
from ladder.splats import Splats

OWN = {
    "naive": ("job", "view", "constants", "naive"),
    "count": ("job", "view", "constants", "flat", "ellipse", "count"),
    "add_slots": ("job", "add_slots"),
}
"""The modules of this folder, and the WGSL files that are joined to each; those of the engine stand before ours."""

SPLATS, PAIRS = 0, 1
"""Places in the buffer `live` of the number of splats and of pairs."""

MARK = 9
"""Floats of a splat of naive.wgsl."""

ALL, PAIR, EDGES, PIXELS = Size("gaussians"), Size("pairs"), Size("edges"), Size("pixels")


def source(module: str) -> str:
    """Return the WGSL of a module, ours or the engine's."""
    if module not in OWN:
        files = [FOLDER / f"{name}.wgsl" for name in MODULES[module]]
    else:
        *shared, own = OWN[module]
        files = [FOLDER / f"{name}.wgsl" for name in shared] + [Path(__file__).parent / f"{own}.wgsl"]
    return "\n".join(file.read_text(encoding="utf-8") for file in files)


def naive_program() -> Program:
    """Return the program of the naive kernel: a workgroup has 64 pixels."""
    buffers = (Buffer("live", Size("live")), Buffer("marks", Size("gaussians", MARK)))
    one = Pass("naive", "naive", ("live", "marks"), ("image",), PIXELS, 64)
    return Program((*buffers, Buffer("image", Size("pixels", 4))), {"naive": (one,)})


def tiles_program(tiles: int) -> Program:
    """Return the program with tiles: the parts `lists`, `composite` and `backward`.

    Args:
        tiles: Number of tiles.
    """
    lists, drawn = ("live", "records", "order", "starts"), ("records", "owner", "slot_of", "tiles")
    bits = sort_bits(tiles.bit_length())
    parts = {
        "lists": (
            Pass("count", "count", ("records",), ("spans", "starts", "order"), ALL, 64),
            *scan("starts", "sums_of_blocks", ALL, PAIRS),
            Pass(
                "intersect", "emit_pairs", lists, ("spans", "tile_keys", "slot_of", "owner"), ALL, 64, SPLATS
            ),
            *sort("tile_keys", "slot_of", "tile_sort", "pairs", PAIRS, bits, SPARE),
            Pass("intersect", "find_ranges", ("live", "tile_keys"), ("tiles",), EDGES, 256, PAIRS),
        ),
        "composite": (Pass("composite", "composite", drawn, ("done", "image"), EDGES, 1),),
        "backward": (
            Pass(
                "composite_backward",
                "composite_backward",
                (*drawn, "done", "image", "grads"),
                ("slots",),
                EDGES,
                1,
            ),
            Pass("add_slots", "add_slots", ("spans", "slots"), ("sums",), ALL, 64),
        ),
    }
    return Program(_buffers(), parts)


def _buffers() -> tuple[Buffer, ...]:
    return (
        *(Buffer("live", Size("live")), Buffer("records", Size("gaussians", RECORD))),
        *(Buffer("spans", Size("gaussians", 2)), Buffer("starts", ALL), Buffer("order", ALL)),
        Buffer("sums_of_blocks", scan_scratch(ALL)),
        *(Buffer(name, PAIR) for name in ("tile_keys", "slot_of", "owner")),
        *sort_scratch("tile_sort", "pairs"),
        *(Buffer("tiles", EDGES), Buffer("done", EDGES)),
        *(Buffer("image", Size("pixels", PIXEL)), Buffer("grads", Size("pixels", 5))),
        *(Buffer("slots", Size("pairs", SLOT)), Buffer("sums", Size("gaussians", SLOT))),
    )


def marks(splats: Splats) -> np.ndarray:
    """Return splats as naive.wgsl reads them: (N, 9) float32, mean, conic, colour, opacity."""
    columns = (splats.means2d, splats.conics, splats.colors, splats.opacities[:, None])
    return np.ascontiguousarray(np.concatenate(columns, axis=1), dtype=np.float32)


def records(splats: Splats) -> np.ndarray:
    """Return splats as the engine's `project` leaves them: (N, 16) float32.

        alpha = 2^(log2 o - s² - t²),   s = sx dx + sy dy,   t = ty dy

    The ellipse of alpha >= 1/255 has half width and height sqrt(2 ln(255 o) Sigma_xx), sqrt(2 ln(255 o) Sigma_yy). A
    splat that is nowhere above the floor has none, and lies beside the image.
    """
    A, B, C = splats.conics.astype(np.float64).T
    unit = np.sqrt(0.5 / np.log(2))
    level = 2 * np.log(splats.opacities.astype(np.float64) / ALPHA_MIN)
    covariances = splats.cov2d()[:, [0, 1], [0, 1]]
    extents = np.sqrt(np.maximum(level, 0)[:, None] * covariances)
    means = np.where(level[:, None] > 0, splats.means2d, -1e6)
    out = np.zeros((splats.count, RECORD))
    out[:, :2], out[:, 12:14], out[:, 14:] = means, means, extents
    out[:, 2], out[:, 3] = unit * np.sqrt(A), unit * B / np.sqrt(A)
    out[:, 4], out[:, 7] = unit * np.sqrt(C - B * B / A), np.log2(splats.opacities.astype(np.float64))
    out[:, 8:11], out[:, 11] = splats.colors, 1
    return out.astype(np.float32)


def view_of(splats: Splats) -> bytes:
    """Return the uniform block of the splats' screen; the background is black."""
    camera = splats.flat()[0]
    return DeviceView(camera, (0.0, 0.0, 0.0), 0, False, DILATION, None, ALPHA_MAX, Z_NEAR).packed(0)


def counts_of(splats: Splats, pairs: int) -> dict[str, int]:
    """Return the counts of a program's buffers, with room for so many pairs."""
    tiles = -(-splats.W // TILE) * -(-splats.H // TILE)
    edges = {"edges": tiles + 2, "pairs": pairs, "live": LIVE}
    return {"gaussians": splats.count, "pixels": splats.pixels} | edges


@functools.cache
def device() -> Device:
    """Return the device that the backend webgpu would take, for these modules.

    Raises:
        BackendUnavailableError: there is none.
    """
    return Device(adapters().index(chosen_adapter()), source=source)


def where() -> str:
    """Return the adapter's name, or the reason why there is none, as one line beginning with "no GPU adapter"."""
    reason = why_unavailable()
    return f"no GPU adapter: {reason}" if reason else device().name.name


def available() -> bool:
    """Return whether there is an adapter, a GPU or a driver that computes on the CPU."""
    return why_unavailable() is None


def naive(splats: Splats) -> tuple[np.ndarray, np.ndarray]:
    """Run naive.wgsl: image (H, W, 3) on black, transmittance (H, W), float32."""
    counts = counts_of(splats, 0) | {
        "gaussians": max(splats.count, 1)
    }  # a buffer has room for one mark at least
    memory = device().allocate(naive_program(), counts)
    memory.write("live", np.array([splats.count], np.uint32))
    memory.write("marks", marks(splats))
    words = memory.play("naive", view_of(splats), read=("image",))["image"]
    image = words.view(np.float32)[: 4 * splats.pixels].reshape(splats.H, splats.W, 4)
    return image[..., :3], image[..., 3]


class Lists(NamedTuple):
    """The lists of all tiles, as the device made them."""

    begin: np.ndarray  # (tiles + 1,), where each tile's list begins, and where the last one ends
    splat: np.ndarray  # (pairs,), the splat of each entry, near to far within a tile
    slot: np.ndarray  # (pairs,), the slot of each entry


class Tiled:
    """Splats on the device, with lists and image.

    Args:
        splats: The splats; H and W are the screen.

    Attributes:
        image: (H, W, 3) float32, on black.
        transmittance: (H, W).
        lists: The tiles' lists.
    """

    def __init__(self, splats: Splats) -> None:
        self.splats, room = splats, rounded_pairs(4 * splats.count)
        memory = self._listed(room)
        pairs = int(memory.read("live")[PAIRS])
        if pairs > room:
            memory = self._listed(rounded_pairs(pairs))
        found = memory.play("composite", read=("image", "tiles", "owner", "slot_of"))
        image = found["image"].view(np.float32)[: PIXEL * splats.pixels]
        image = image.reshape(splats.H, splats.W, PIXEL)
        self.image, self.transmittance = image[..., :3], image[..., 3]
        slot = found["slot_of"][:pairs]
        begin = found["tiles"][: memory.counts["edges"] - 1]
        self.lists, self._memory = Lists(begin.astype(int), found["owner"][slot].astype(int), slot), memory

    def _listed(self, room: int) -> Memory:
        counts = counts_of(self.splats, room)
        memory = device().allocate(tiles_program(counts["edges"] - 2), counts)
        memory.write("live", np.array([self.splats.count], np.uint32))
        memory.write("records", records(self.splats))
        memory.play("lists", view_of(self.splats))
        return memory

    def backward(self, grad_image: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the slots (pairs, 10) of a loss with this gradient (H, W, 3), and the sums (N, 10) of each splat's.

        Columns: w g (3), w by depth, h, h dx, h dy, h dx², h dx dy, h dy², summed over pixels.
        """
        grads = np.zeros((self.splats.H, self.splats.W, 5), np.float32)
        grads[..., :3] = grad_image
        self._memory.write("grads", grads)
        found = self._memory.play("backward", read=("slots", "sums"))
        slots, sums = (found[name].view(np.float32) for name in ("slots", "sums"))
        pairs, count = len(self.lists.slot), self.splats.count
        return slots[: SLOT * pairs].reshape(pairs, SLOT), sums[: SLOT * count].reshape(count, SLOT)
