"""Read the splats of a binary glTF of any program; `gsplat_edu.io.glb` says what is read and what is not."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float32, Float64

from gsplat_edu.base.constants import SH_MAX_DEGREE
from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.base.reading import read_bytes
from gsplat_edu.io import spz
from gsplat_edu.io.axes import POSITION_SIGNS, half_turned
from gsplat_edu.io.edit import Similarity, joined
from gsplat_edu.io.glb_container import (
    EXTENSION,
    GENERATOR,
    MISREAD,
    NUMBERS,
    SPZ_ALONE,
    SPZ_DRAFTS,
    WIDTHS,
    GlbFile,
    container,
    node_matrices,
    refuse,
)
from gsplat_edu.io.node_splats import Activated, is_same, moved, root_matrix
from gsplat_edu.io.scene import Scene, SceneFrame, read_extras
from gsplat_edu.scene.frame import as_origin
from gsplat_edu.scene.gaussians import Gaussians

ABOUT_Z = ("splat-transform",)
"""Beginnings of `asset.generator` of programs that turn scenes into glTF's axes by half a turn about z, not x."""

PRIMITIVE = 256
"""Bytes that a primitive counts as at least: a file may repeat empty ones, too."""

SUPPORTED = frozenset((EXTENSION, *SPZ_DRAFTS, SPZ_ALONE, "KHR_mesh_quantization"))
"""Extensions that a file may require."""

COMPONENTS = {
    "POSITION": ("f4", "i1", "u1", "i2", "u2"),
    f"{EXTENSION}:ROTATION": ("f4", "i1n", "i2n"),
    f"{EXTENSION}:SCALE": ("f4", "u1", "u1n", "u2", "u2n"),
    f"{EXTENSION}:OPACITY": ("f4", "u1n", "u2n"),
}
"""Component types of the attributes, n for normalised; positions in integers, either way, are those of
KHR_mesh_quantization. Harmonics are float32."""

KNOWN = {"kernel": "ellipse", "colorSpace": "srgb_rec709_display", "projection": "perspective"}
"""Properties of the extension with the only values that are drawn here; one that is missing has this value."""

"""Up, unit and origin of a scene."""

HALF_TURN_ABOUT_Y = Similarity(np.diag([-1.0, 1.0, -1.0]), 1.0, np.zeros(3))
"""A half turn about x, then this one, is a half turn about z."""


class Placed(NamedTuple):
    """A primitive of splats at a node."""

    primitive: Mapping[str, Any]
    matrix: Float64[np.ndarray, "4 4"]  # from the primitive's coordinates to glTF's world


def read(path: Path) -> Scene:
    """Read a binary glTF; see `gsplat_edu.io.formats.read_scene`."""
    data = read_bytes(path)
    document, body = container(path, data)
    try:
        return _File(path, document, body).scene()
    except MISREAD:
        refuse(path, "its JSON does not describe splats as glTF does")


class _File(GlbFile):
    """A file of splats."""

    def scene(self) -> Scene:
        """Return the splats of all nodes, and the metadata."""
        needed = self._document.get("extensionsRequired", [])
        if unknown := sorted({str(name) for name in needed} - SUPPORTED):
            self._refuse(f"needs the extension {', '.join(unknown)[:80]}, which is not supported")
        antialiased, frame = self._facts()
        placed = list(self._placed())
        frame = frame if self._is_ours(frame, placed) else SceneFrame()
        root = root_matrix(frame.up, frame.origin)
        meshes = self._document.get("meshes", [])
        if not placed and (self._body or meshes):
            elsewhere = any(map(_is_splats, (p for mesh in meshes for p in mesh["primitives"])))
            where = "no node of its scene shows its splats" if elsewhere else f"no primitive with {EXTENSION}"
            self._refuse(f"has no splats: {where}")
        parts = [self._moved(part, root) for part in placed]
        try:
            whole = joined(parts) if parts else Scene(_gaussians(self._path, {}))
        except ArgumentError as error:
            self._refuse(str(error).removeprefix("scenes: ").partition(";")[0])
        said = antialiased if antialiased is not None else whole.antialiased
        if not any(frame.origin):
            frame = frame._replace(origin=as_origin("origin", np.array(POSITION_SIGNS) * whole.origin + 0.0))
        found = Scene(half_turned(whole.gaussians), said, *frame)
        by = self._document["asset"].get("generator")
        return HALF_TURN_ABOUT_Y.scene(found) if str(by).startswith(ABOUT_Z) else found

    def _facts(self) -> tuple[bool | None, SceneFrame]:
        """Return the metadata of our own files: whether to render antialiased, and the frame."""
        extras = self._document["asset"].get("extras", {})
        antialiased = extras.get("antialiased")
        if antialiased not in (None, True, False):
            self._refuse(f"says antialiased is {antialiased!r}"[:80])
        return antialiased, read_extras(extras)

    def _is_ours(self, frame: SceneFrame, placed: Sequence[Placed]) -> bool:
        """Return whether the nodes still have the transform that we wrote for a frame."""
        root = root_matrix(frame.up, frame.origin)
        ours = self._document["asset"].get("generator") == GENERATOR
        return ours and all(is_same(part.matrix, root) for part in placed)

    def _placed(self) -> Iterator[Placed]:
        """Yield the primitives of splats with their transforms; other primitives are ignored."""
        splats: dict[int, list[Mapping[str, Any]]] = {}
        for index, matrix in node_matrices(self._path, self._document).items():
            mesh = self._document["nodes"][index].get("mesh")
            if mesh is None:
                continue
            if mesh not in splats:
                splats[mesh] = list(filter(_is_splats, self._item("meshes", mesh)["primitives"]))
            for primitive in splats[mesh]:
                self._take(PRIMITIVE, "splats")
                yield Placed(primitive, matrix)

    def _moved(self, part: Placed, root: Float64[np.ndarray, "4 4"]) -> Scene:
        """Return the splats of a primitive in glTF's world, or in the root's coordinates if it has its transform."""
        extensions = part.primitive["extensions"]
        kind = extensions.get(EXTENSION, {})
        for name, only in KNOWN.items():
            if (value := kind.get(name, only)) != only:
                self._refuse(f"has splats of {name} {str(value)[:40]}, but only {only} is supported")
        within = {**extensions, **kind.get("extensions", {})}
        packed = next((within[name] for name in (*SPZ_DRAFTS, SPZ_ALONE) if name in within), None)
        own = self._plain(part.primitive) if packed is None else self._packed(packed)
        return moved(self._path, own, part.matrix, root)

    def _packed(self, extension: Mapping[str, Any]) -> Scene:
        """Return splats that are an SPZ, in glTF's axes: as CesiumJS does, its coordinates are taken as they are."""
        data = self._embedded(extension["bufferView"], "splats")
        self._take(len(data), "splats")
        return spz.in_own_axes(self._path, data)

    def _plain(self, primitive: Mapping[str, Any]) -> Scene:
        """Return splats that are attributes."""
        arrays = {
            name: self._array(name, index)
            for name, index in primitive["attributes"].items()
            if index is not None and (name == "POSITION" or name.startswith(f"{EXTENSION}:"))
        }
        return Scene(_gaussians(self._path, arrays))

    def _array(self, name: str, index: Any) -> Float32[np.ndarray, "N C"]:  # noqa: ANN401
        """Return the values of an attribute."""
        accessor, label = self._item("accessors", index), f"{name} (accessor {index})"
        number = NUMBERS.get(accessor["componentType"], "?")
        normalized = accessor.get("normalized", False) is True
        allowed = COMPONENTS.get(name, ("f4",))
        fits = number in allowed if name == "POSITION" else number + "n" * normalized in allowed
        if accessor["type"] not in WIDTHS or not fits or "sparse" in accessor or "bufferView" not in accessor:
            self._refuse(f"has values of a type that is not supported in {label}")
        values = self._stored(accessor, label)
        self._take(values.nbytes, "splats")
        if number == "f4":
            found = values.astype(np.float32)
            if not np.isfinite(found).all():
                self._refuse(f"has NaN or infinite values in {label}")
            return found
        if normalized:
            return np.maximum(values / np.float64(np.iinfo(values.dtype).max), -1.0).astype(np.float32)
        return values.astype(np.float32)


def _is_splats(primitive: Mapping[str, Any]) -> bool:
    return not {EXTENSION, SPZ_ALONE}.isdisjoint(primitive.get("extensions", {}))


def _gaussians(path: Path, arrays: Mapping[str, Float32[np.ndarray, "N C"]]) -> Gaussians:
    """Return the Gaussians in the coordinates of their primitive."""
    degree = -1
    while degree < SH_MAX_DEGREE and f"{EXTENSION}:SH_DEGREE_{degree + 1}_COEF_0" in arrays:
        degree += 1
    harmonics = [f"{EXTENSION}:SH_DEGREE_{d}_COEF_{k}" for d in range(degree + 1) for k in range(2 * d + 1)]
    names = ["POSITION", *(f"{EXTENSION}:{name}" for name in ("ROTATION", "SCALE", "OPACITY")), *harmonics]
    widths = [3, 4, 3, 1, *[3] * len(harmonics)]
    if not arrays:
        arrays = {name: np.empty((0, width), np.float32) for name, width in zip(names, widths, strict=True)}
    elif not harmonics:
        refuse(path, "has splats without colour")
    missing = [name for name in names if name not in arrays]
    if missing:
        refuse(path, f"has splats without {missing[0]}")
    values = [arrays[name] for name in names]
    count = len(values[0])
    if [value.shape for value in values] != [(count, width) for width in widths]:
        refuse(path, "has attributes of different numbers of splats")
    means, quats, scales, opacities = values[:4]
    sh = np.stack(values[4:], axis=1) if harmonics else np.empty((count, 1, 3))
    return Activated(means, quats[:, [3, 0, 1, 2]], scales, opacities[:, 0], sh).gaussians(path)
