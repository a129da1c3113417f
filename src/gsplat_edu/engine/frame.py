"""A render and its gradients as programs of the engine, from NumPy arrays to NumPy arrays.

    project -> scan, list -> sort by depth -> scan, emit pairs -> sort by tile -> ranges -> composite
    composite_backward -> project_backward

The device counts the visible Gaussians and the pairs. The host guesses how many pairs there are, and if there are more,
renders again with more room; all it waits for is the result.
"""

from __future__ import annotations

import functools
import weakref
from collections import deque
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from gsplat_edu.engine.host import Device, Memory
from gsplat_edu.engine.passes import (
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
from gsplat_edu.engine.statistics import Asked, collect
from gsplat_edu.engine.view import DeviceView

CORE, OUT, RECORD, SLOT, PIXEL, GRADS = 14, 16, 16, 10, 6, 5
"""Numbers of a Gaussian without its higher harmonics, of their gradient, a record, a slot, a pixel, its gradient."""

CAMERA_NUMBERS = {"pinhole": 16, "lens": 37, "panorama": 37}
"""Numbers of a camera's gradient, by `gsplat_edu.engine.view.OPTICS`."""

SEAM, LENS = {"panorama": "_seam"}, {"lens": "_lens", "panorama": "_lens"}
"""Ends of the names of modules that differ for panoramas, and of those that differ for any lens, by the same."""

VISIBLE, PAIRS, SPARE, LIVE = 0, 1, 2, 4
"""Places in `live`, and its length."""

STEEP = 2
"""Statistics, the first ones, that features add to."""

GROUP = 4
"""Features per pass: composite has room for three colours and a depth."""

FEWEST_PAIRS = 1 << 12
"""Room for pairs in the smallest buffers."""

KEPT_FRAMES = 2
"""Sets of buffers that wait for another frame at most."""

MOST_SIZES = 64
"""Sizes of frames whose numbers of pairs are remembered."""

GAUSSIANS, PAIR, EDGES = Size("gaussians"), Size("pairs"), Size("edges")


@functools.cache
def program(tile_bits: int, with_features: bool, optics: str = "pinhole") -> Program:
    """Return the program of a render.

    Args:
        tile_bits: Bits of the number of tiles, by which pairs are sorted.
        with_features: Whether it also composites features, four at a time.
        optics: One of `gsplat_edu.engine.view.OPTICS`.
    """
    buffers = render_buffers(optics)
    parts = {
        "render": render_passes(tile_bits, optics),
        "composite_backward": (_composite_backward("records", "image", "slots", optics),),
        "project_backward": _project_backward(optics),
    }
    if with_features:
        buffers += (
            *(
                Buffer("features", Size("gaussians", GROUP)),
                Buffer("feature_grads", Size("gaussians", GROUP)),
            ),
            *(Buffer("painted", Size("gaussians", RECORD)), Buffer("feature_slots", Size("pairs", SLOT))),
            Buffer("feature_image", Size("pixels", PIXEL)),
        )
        parts |= _feature_parts(optics)
    return Program(buffers, parts)


def render_buffers(optics: str = "pinhole") -> tuple[Buffer, ...]:
    """Return the buffers of a render and its gradients, without those of features."""
    return (
        *(Buffer("core", Size("gaussians", CORE)), Buffer("rest", Size("rest"))),
        *(Buffer("records", Size("gaussians", RECORD)), Buffer("seen", GAUSSIANS)),
        *(Buffer("spans", Size("gaussians", 2)), Buffer("radii", Size("gaussians", 2))),
        *(Buffer(name, GAUSSIANS) for name in ("depth_keys", "order", "starts")),
        *sort_scratch("depth_sort", "gaussians"),
        Buffer("gaussian_sums", scan_scratch(GAUSSIANS)),
        *(Buffer(name, PAIR) for name in ("tile_keys", "slot_of", "owner")),
        *sort_scratch("tile_sort", "pairs"),
        *(Buffer("tiles", EDGES), Buffer("done", EDGES)),
        *(Buffer("image", Size("pixels", PIXEL)), Buffer("grads", Size("pixels", GRADS))),
        Buffer("slots", Size("pairs", SLOT)),
        *(Buffer("core_grads", Size("gaussians", OUT)), Buffer("rest_grads", Size("rest"))),
        Buffer("camera_sums", Size("gaussians", CAMERA_NUMBERS[optics], 64)),
        Buffer("live", Size("live")),
    )


def render_counts(
    gaussians: int, harmonics: int, pixels: int, tiles: int, pairs: int, live: int = LIVE
) -> dict[str, int]:
    """Return the counts of the buffers of a render, or of a step.

    Args:
        gaussians: Their number.
        harmonics: K, per Gaussian besides the first.
        pixels: Pixels of the view.
        tiles: Tiles of the view.
        pairs: Pairs of Gaussian and tile for which there is room.
        live: Words of the buffer of that name.
    """
    rest, edges = 3 * gaussians * harmonics, tiles + 2
    return {
        "gaussians": gaussians,
        "rest": rest,
        "pixels": pixels,
        "edges": edges,
        "pairs": pairs,
        "live": live,
    }


def render_passes(tile_bits: int, optics: str = "pinhole") -> tuple[Pass, ...]:
    """Return the passes of a render whose pairs are sorted by so many bits, by `gsplat_edu.engine.view.OPTICS`."""
    sources, lists = ("live", "order", "spans", "records"), ("live", "records", "order", "starts")
    project = f"project{(LENS | SEAM).get(optics, '')}"
    return (
        Pass(project, "project", ("core", "rest"), ("records", "seen", "spans"), GAUSSIANS, 64),
        *scan("seen", "gaussian_sums", GAUSSIANS, VISIBLE),
        Pass("order", "list_seen", ("records", "seen"), ("depth_keys", "order"), GAUSSIANS, 256),
        *sort("depth_keys", "order", "depth_sort", "gaussians", VISIBLE, 32, SPARE),
        Pass("order", "gather_spans", sources, ("starts", "radii"), GAUSSIANS, 256, VISIBLE),
        *scan("starts", "gaussian_sums", GAUSSIANS, PAIRS),
        Pass(
            f"intersect{SEAM.get(optics, '')}",
            "emit_pairs",
            lists,
            ("spans", "tile_keys", "slot_of", "owner"),
            GAUSSIANS,
            64,
            VISIBLE,
        ),
        *sort("tile_keys", "slot_of", "tile_sort", "pairs", PAIRS, tile_bits, SPARE),
        Pass("intersect", "find_ranges", ("live", "tile_keys"), ("tiles",), EDGES, 256, PAIRS),
        _composite("records", "image", 0, optics),
    )


def _composite(records: str, image: str, without_background: int, optics: str) -> Pass:
    reads, module = (records, "owner", "slot_of", "tiles"), f"composite{SEAM.get(optics, '')}"
    return Pass(module, "composite", reads, ("done", image), EDGES, 1, shift=without_background)


def _composite_backward(records: str, image: str, slots: str, optics: str) -> Pass:
    reads = (records, "owner", "slot_of", "tiles", "done", image, "grads")
    return Pass(f"composite_backward{SEAM.get(optics, '')}", "composite_backward", reads, (slots,), EDGES, 1)


def gradient_passes(optics: str = "pinhole") -> tuple[Pass, ...]:
    """Return the passes from the gradient of the image to those of the Gaussians."""
    return (_composite_backward("records", "image", "slots", optics), *_project_backward(optics))


def _project_backward(optics: str) -> tuple[Pass, ...]:
    reads, writes = ("core", "rest", "spans", "slots"), ("core_grads", "rest_grads", "camera_sums")
    return (
        Pass(f"project_backward{LENS.get(optics, '')}", "project_backward", reads, writes, GAUSSIANS, 64),
    )


def _feature_parts(optics: str) -> dict[str, tuple[Pass, ...]]:
    sums = ("spans", "feature_slots")
    return {
        "features": (
            Pass("features", "paint", ("records", "features"), ("painted",), GAUSSIANS, 256),
            _composite("painted", "feature_image", 1, optics),
        ),
        "features_backward": (
            _composite_backward("painted", "feature_image", "feature_slots", optics),
            Pass("features", "add_moments", ("live", "feature_slots"), ("slots",), PAIR, 256, PAIRS),
            Pass("features", "sum_features", sums, ("feature_grads",), GAUSSIANS, 64),
        ),
    }


@dataclass(frozen=True, eq=False)
class Scene:
    """Raw parameters of N Gaussians.

    Args:
        core: (N, 14) float32: mean, quaternion (w, x, y, z), log scales, first harmonic, logit of the opacity.
        rest: (N, K, 3) float32, the other harmonics.
        features: (N, C) float32, composited over zero like colours; None for none.
    """

    core: np.ndarray
    rest: np.ndarray
    features: np.ndarray | None = None

    def groups(self) -> Iterator[np.ndarray]:
        """Yield the features four at a time, missing ones as 0."""
        if self.features is not None:
            channels = self.features.shape[1]
            padded = np.zeros((len(self.core), -(-channels // GROUP) * GROUP), dtype=np.float32)
            padded[:, :channels] = self.features
            for first in range(0, channels, GROUP):
                yield np.ascontiguousarray(padded[:, first : first + GROUP])


@dataclass(frozen=True, eq=False)
class DeviceFrame:
    """A rendered view, whose buffers stay on the device for its gradients.

    Args:
        image: (H, W, 3) float32.
        transmittance: (H, W).
        depth: (H, W), expected depth, not normalised.
        median_depth: (H, W).
        visible: (M,) int64, the Gaussians that take part, near to far.
        radii: (M, 2), half width and height of alpha >= 1/255, px.
        num_pairs: Pairs of Gaussian and tile.
        features: (H, W, C), or None.
        memory: The buffers.
    """

    image: np.ndarray
    transmittance: np.ndarray
    depth: np.ndarray
    median_depth: np.ndarray
    visible: np.ndarray
    radii: np.ndarray
    num_pairs: int
    features: np.ndarray | None
    memory: Memory


@dataclass(frozen=True, eq=False)
class FrameGradients:
    """Gradients of a loss of one frame.

    Args:
        core: (N, 14) float32, as `Scene.core`.
        rest: (N, K, 3).
        norms: (N,), |(gu W/2, gv H/2)| with the gradient (gu, gv) of the position in the image.
        camera: (16,) float64: R row by row, the eye, fx, fy, cx, cy; (37,) of any camera but a
            pinhole at rest: the same, then the coefficients of the distortion, turn and shift of the shutter.
        features: (N, C), or None.
        statistics: (N, 6) as `gsplat_edu.engine.statistics.collect` returns them, or None. Absolute gradients are sums
            over the colours and each group of `GROUP` features.
    """

    core: np.ndarray
    rest: np.ndarray
    norms: np.ndarray
    camera: np.ndarray
    features: np.ndarray | None
    statistics: np.ndarray | None


class Pool:
    """Buffers of frames that nothing refers to any more, to be used again.

    Args:
        device: Where they are.
        most: Sets that wait at most; the oldest is given back to the device.
    """

    def __init__(self, device: Device, most: int = KEPT_FRAMES) -> None:
        self.device = device
        self._waiting: deque[Memory] = deque(maxlen=most)
        self._pairs: dict[tuple[int, int], int] = {}

    def take(self, wanted: Program, counts: Mapping[str, int]) -> Memory:
        """Return buffers for these counts, with the results of earlier frames in them."""
        for _ in range(len(self._waiting)):
            try:
                memory = self._waiting.popleft()
            except IndexError:  # another thread took it
                break
            if memory.program is wanted and memory.counts == counts:
                return memory
            self._waiting.append(memory)
        return self.device.allocate(wanted, counts)

    def keep(self, memory: Memory) -> None:
        """Take back the buffers of a frame. Finalizers call it from any thread, so it takes no lock."""
        if memory.device is self.device:
            self._waiting.append(memory)

    def renew(self, lost: Device) -> None:
        """Go on with a new device in place of one that is lost, unless that has happened already.

        Raises:
            BackendUnavailableError: its adapter is gone, or does not start.
        """
        with lost.lock:
            if self.device is lost:
                self.device = lost.renewed()
                self._waiting.clear()

    def room(self, gaussians: int, tiles: int) -> int:
        """Return the number of pairs to make room for: what frames of this size needed, or two per Gaussian."""
        return self._pairs.get((gaussians, tiles), rounded_pairs(2 * gaussians))

    def note(self, gaussians: int, tiles: int, pairs: int) -> int:
        """Remember how many pairs a frame has, and return the room for as many."""
        if len(self._pairs) > MOST_SIZES:
            self._pairs.clear()
        room = max(self._pairs.get((gaussians, tiles), 0), rounded_pairs(pairs))
        self._pairs[(gaussians, tiles)] = room
        return room


def rounded_pairs(pairs: int) -> int:
    """Round up by a quarter at most, so that frames of similar size share buffers."""
    step = 1 << max(pairs.bit_length() - 3, 0)
    return max(-(-pairs // step) * step, FEWEST_PAIRS)


def draw_frame(pool: Pool, scene: Scene, view: DeviceView) -> DeviceFrame:
    """Render a scene.

    Args:
        pool: Buffers of the device.
        scene: The Gaussians.
        view: Camera and settings.

    Raises:
        BackendUnavailableError: the device fails, or has no buffers that large.
    """
    n, H, W = len(scene.core), view.camera.H, view.camera.W
    wanted, room = (
        program(sort_bits(view.tiles.bit_length()), scene.features is not None, view.optics),
        pool.room(n, view.tiles),
    )
    while True:
        memory = pool.take(wanted, render_counts(n, scene.rest.shape[1], H * W, view.tiles, room))
        memory.write("core", scene.core)
        memory.write("rest", scene.rest)
        found = memory.play(
            "render", view.packed(scene.rest.shape[1]), read=("live", "image", "order", "radii")
        )
        visible, pairs = int(found["live"][VISIBLE]), int(found["live"][PAIRS])
        needed = pool.note(n, view.tiles, pairs)
        if pairs <= room:
            break
        room = needed
    image = _pixels(found["image"], H, W)
    frame = DeviceFrame(
        *(image[..., :3], image[..., 3], image[..., 4], image[..., 5]),
        visible=found["order"][:visible].astype(np.int64),
        radii=found["radii"].view(np.float32)[: 2 * visible].reshape(visible, 2).copy(),
        num_pairs=pairs,
        features=_drawn_features(memory, scene, H, W),
        memory=memory,
    )
    weakref.finalize(frame, pool.keep, memory).atexit = False
    return frame


def _pixels(words: np.ndarray, H: int, W: int) -> np.ndarray:
    return words.view(np.float32)[: H * W * PIXEL].reshape(H, W, PIXEL)


def _drawn_features(memory: Memory, scene: Scene, H: int, W: int) -> np.ndarray | None:
    if scene.features is None:
        return None
    groups = []
    for group in scene.groups():
        memory.write("features", group)
        image = _pixels(memory.play("features", read=("feature_image",))["feature_image"], H, W)
        groups.append(image[..., [0, 1, 2, 4]])
    return np.concatenate(groups, axis=2)[..., : scene.features.shape[1]]


def differentiate_frame(
    frame: DeviceFrame,
    scene: Scene,
    grads: np.ndarray,
    of_features: np.ndarray | None,
    asked: Asked | None = None,
) -> FrameGradients:
    """Propagate gradients of a frame's images to the Gaussians and the camera.

    Args:
        frame: The frame.
        scene: The Gaussians of the frame.
        grads: (H, W, 5) float32, of image, transmittance and depth.
        of_features: (H, W, C) float32, of the image of the features; None for zero.
        asked: Asks for statistics; None for none.

    Raises:
        BackendUnavailableError: the device fails.
    """
    memory, n = frame.memory, len(scene.core)
    memory.write("grads", grads)
    memory.play("composite_backward")
    statistics = None if asked is None else collect(memory, asked)
    to_features = None
    if of_features is not None:
        to_features, steep = _features_backward(memory, scene, of_features, asked)
        if statistics is not None:
            statistics[:, :STEEP] += steep
    found = memory.play("project_backward", read=("core_grads", "rest_grads", "camera_sums"))
    core = found["core_grads"].view(np.float32)[: n * OUT].reshape(n, OUT)
    width = next(one.size.words for one in memory.program.buffers if one.name == "camera_sums")
    sums = found["camera_sums"].view(np.float32)[: -(-n // 64) * width].reshape(-1, width)
    return FrameGradients(
        core[:, :CORE],
        found["rest_grads"].view(np.float32)[: scene.rest.size].reshape(scene.rest.shape),
        core[:, CORE].copy(),
        sums.sum(axis=0, dtype=np.float64),
        to_features,
        statistics,
    )


def _features_backward(
    memory: Memory, scene: Scene, gradient: np.ndarray, asked: Asked | None
) -> tuple[np.ndarray, np.ndarray]:
    """Return the gradient of the features and their absolute gradients; add their share to the slots of all pairs."""
    H, W, channels = gradient.shape
    n, found = len(scene.core), []
    steep = np.zeros((n, STEEP), dtype=np.float32)
    for place, group in enumerate(scene.groups()):
        own = gradient[..., GROUP * place : GROUP * (place + 1)]
        grads = np.zeros((H, W, GRADS), dtype=np.float32)
        grads[..., [0, 1, 2, 4][: own.shape[2]]] = own
        memory.write("features", group)
        memory.play("features")
        memory.write("grads", grads)
        words = memory.play("features_backward", read=("feature_grads",))["feature_grads"]
        found.append(words.view(np.float32)[: n * GROUP].reshape(n, GROUP))
        if asked is not None:
            steep += collect(memory, asked, of_features=True)[:, :STEEP]
    return np.concatenate(found, axis=1)[:, :channels], steep
