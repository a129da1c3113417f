"""Meshes as Wavefront OBJ: text, with a material file (.mtl) and a PNG beside it if there is a texture.

Numbers are written with as many digits as it takes to read the same number back. Colours of vertices follow their
coordinates, as sRGB from 0 to 1; the format never defined that, but most programs read it. Coordinates are those of the
scene: nothing is flipped, since the format says nothing about axes. Unit and place on earth are comments that
only this package reads.

Of files of any program, geometry is read: faces with any number of corners, negative indices, continued lines. A
texture is read if one image covers all faces and lies beside the file; a mesh whose images are several, elsewhere or
absent is read without.

Source: Wavefront, "Advanced Visualizer", appendix B1, Object Files, and its MTL format.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import numpy as np
from jaxtyping import Float32, Float64, Int64
from PIL import Image

from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.base.files import written_aside
from gsplat_edu.base.ply_table import refuse_lfs_pointer
from gsplat_edu.base.reading import read_bytes
from gsplat_edu.io.mesh_image import decoded
from gsplat_edu.io.mesh_parts import (
    Polygons,
    StoredMesh,
    check_vertices,
    distinct_rows,
    numbers_in,
    refuse,
    triangles_in,
)
from gsplat_edu.io.ply_comments import OURS
from gsplat_edu.scene.earth import Earth
from gsplat_edu.scene.frame import UNITS
from gsplat_edu.scene.mesh import Mesh, Texture

MATERIAL = "textured"
"""Name of the only material that is written."""

LARGEST_PLACE = 1e6
"""Texture coordinates beyond this are damage; images that repeat need a few hundred."""

ROWS = 1 << 16
"""Lines that are formatted at a time."""

ODD = re.compile(r"[\s#]+")
"""Characters of a file's name that would end it inside an OBJ."""


def write(path: Path, mesh: Mesh, unit: str | None, earth: Earth | None) -> None:
    """Write a mesh, its material and its image; see `gsplat_edu.io.mesh_files.write_mesh`."""
    with ExitStack() as stack:  # renamed in reverse order: image and material are there once the mesh is
        aside = stack.enter_context(written_aside(path))
        material, image = beside(path)
        if mesh.texture is not None:
            stack.enter_context(written_aside(material)).write_text(
                f"newmtl {MATERIAL}\nKd 1 1 1\nmap_Kd {image.name}\n", "utf-8"
            )
            Image.fromarray(mesh.texture.image).save(stack.enter_context(written_aside(image)), "PNG")
        with aside.open("w", encoding="utf-8", newline="\n") as file:
            file.write("# made by gsplat-edu\n")
            if unit is not None:
                file.write(f"# {OURS} unit {unit}\n")
            if earth is not None:
                file.write(f"# {OURS} earth {earth}\n")
            if mesh.texture is not None:
                file.write(f"mtllib {material.name}\n")
            for lines in _lines(mesh):
                file.write(lines)


def beside(path: Path) -> tuple[Path, Path]:
    """Return the material file and the image of an OBJ; their names have no spaces, which would end them."""
    stem = ODD.sub("_", path.stem)
    return path.with_name(f"{stem}.mtl"), path.with_name(f"{stem}.png")


def _lines(mesh: Mesh) -> Iterator[str]:
    """Yield the lines of vertices, texture coordinates and faces, many at a time."""
    vertices = mesh.vertices
    for start in range(0, len(vertices), ROWS):
        rows = vertices[start : start + ROWS].tolist()
        if mesh.colors is None:
            yield "".join(f"v {x!r} {y!r} {z!r}\n" for x, y, z in rows)
        else:
            shades = (" ".join(map(str, color)) for color in mesh.colors[start : start + ROWS])
            yield "".join(f"v {x!r} {y!r} {z!r} {c}\n" for (x, y, z), c in zip(rows, shades, strict=True))
    faces, corners = mesh.faces + 1, None
    if mesh.texture is not None:
        uvs = mesh.texture.uvs.reshape(-1, 2)
        first, group = distinct_rows(uvs[:, 0], uvs[:, 1])
        places, corners = uvs[first], group.reshape(-1, 3) + 1
        yield "".join(f"vt {u!r} {v!r}\n" for u, v in _flipped(places.astype(np.float64)).tolist())
        yield f"usemtl {MATERIAL}\n"
    for start in range(0, len(faces), ROWS):
        rows = faces[start : start + ROWS].tolist()
        if corners is None:
            yield "".join(f"f {a} {b} {c}\n" for a, b, c in rows)
        else:
            others = corners[start : start + ROWS].tolist()
            yield "".join(
                f"f {a}/{s} {b}/{t} {c}/{u}\n" for (a, b, c), (s, t, u) in zip(rows, others, strict=True)
            )


def read(path: Path) -> StoredMesh:
    """Read a mesh; see `gsplat_edu.io.mesh_files.read_mesh`."""
    data = read_bytes(path)
    refuse_lfs_pointer(path, data)
    found = _Lines(path)
    for place, words in _statements(data.decode("utf-8", "replace")):
        found.add(place, words)
    if not found.points:
        refuse(path, "has no vertices; it is no OBJ")
    points = np.array(found.points, np.float64)
    check_vertices(path, points, lambda row: f"line {found.point_lines[row]}: the vertex")
    polygons = Polygons(
        np.array(found.sizes, np.int64),
        np.array(found.corners, np.int64),
        lambda row: f"line {found.face_lines[row]}: the face",
    )
    triangles = triangles_in(path, points, polygons)
    texture = _texture(path, found, triangles)
    return StoredMesh(
        Mesh(points, polygons.corners[triangles], _colors(found), texture), found.unit, found.earth
    )


def _statements(text: str) -> Iterator[tuple[int, list[str]]]:
    """Yield the line number and the words of each statement; a backslash at a line's end continues it."""
    held: list[str] = []
    for place, line in enumerate(text.splitlines(), 1):
        words = line.split()
        if words and words[0] == "#" and words[1:3] in ([OURS, "unit"], [OURS, "earth"]):
            yield place, words
            continue
        words = line.split("#", 1)[0].split()
        if words and words[-1].endswith("\\"):
            held += [*words[:-1], words[-1][:-1]]
            continue
        words = [word for word in held + words if word]
        held = []
        if words:
            yield place, words
    if held:
        yield place, held


class _Lines:
    """Collects the statements of an OBJ.

    Args:
        path: The file, for messages.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self.points: list[list[float]] = []
        self.shades: list[list[float] | None] = []
        self.point_lines: list[int] = []
        self.places: list[list[float]] = []  # texture coordinates
        self.sizes: list[int] = []
        self.corners: list[int] = []
        self.place_corners: list[int] = []  # -1 for none
        self.face_lines: list[int] = []
        self.material: str | None = None
        self.materials: set[str | None] = set()  # of the faces
        self.libraries: list[str] = []
        self.unit: str | None = None
        self.earth: Earth | None = None

    def add(self, place: int, words: list[str]) -> None:
        """Add a statement; those that say nothing about surfaces are skipped."""
        match words:
            case ["v", *numbers]:
                self._vertex(place, numbers_in(self._path, numbers, place))
            case ["vt", *numbers]:
                self.places.append([*numbers_in(self._path, numbers, place), 0.0, 0.0][:2])
            case ["f", *corners]:
                self._face(place, corners)
            case ["usemtl", name, *_]:
                self.material = name
            case ["mtllib", *names]:
                self.libraries += names
            case ["#", _, "unit", unit] if unit in UNITS:
                self.unit = unit
            case ["#", _, "earth", *described]:
                try:
                    self.earth = Earth.parsed(" ".join(described))
                except ArgumentError:
                    refuse(self._path, f"line {place}: is no place on earth")

    def _vertex(self, place: int, numbers: list[float]) -> None:
        if len(numbers) not in (3, 4, 6, 7):  # x y z, a weight, a colour
            refuse(self._path, f"line {place}: a vertex of {len(numbers)} numbers, where 3 should be")
        self.points.append(numbers[:3])
        self.shades.append(numbers[-3:] if len(numbers) > 4 else None)
        self.point_lines.append(place)

    def _face(self, place: int, corners: list[str]) -> None:
        for corner in corners:
            parts = corner.split("/")
            try:
                vertex, texture = int(parts[0]), int(parts[1]) if len(parts) > 1 and parts[1] else 0
            except ValueError:
                refuse(self._path, f"line {place}: {corner[:40]!r} is not a corner of a face")
            self.corners.append(self._index(vertex, len(self.points), place))
            self.place_corners.append(self._index(texture, len(self.places), place) if texture else -1)
        self.sizes.append(len(corners))
        self.face_lines.append(place)
        self.materials.add(self.material)

    def _index(self, index: int, count: int, place: int) -> int:
        """Return an index counted from 0; a negative one counts back from the last vertex so far."""
        if index == 0 or -index > count or index > 2**53:
            refuse(self._path, f"line {place}: names number {index}, but there are {count} so far")
        return index - 1 if index > 0 else count + index


def _colors(found: _Lines) -> Float32[np.ndarray, "V 3"] | None:
    """Return the colours; None unless every vertex has one, from 0 to 1 (some programs write normals there)."""
    if any(shade is None for shade in found.shades):
        return None
    colors = np.array(found.shades, np.float64)
    return colors.astype(np.float32) if ((colors >= 0.0) & (colors <= 1.0)).all() else None


def _texture(path: Path, found: _Lines, triangles: Int64[np.ndarray, "F 3"]) -> Texture | None:
    """Return the texture if one image covers all faces and lies beside the file."""
    corners = np.array(found.place_corners, np.int64)[triangles]
    if corners.min() < 0 or len(found.materials) != 1:
        return None
    if corners.max() >= len(found.places):
        refuse(path, f"names texture coordinate {corners.max() + 1}, but there are {len(found.places)}")
    image = _image(path, found)
    if image is None:
        return None
    places = np.array(found.places, np.float64)
    if not (np.abs(places) < LARGEST_PLACE).all():
        refuse(path, "has texture coordinates that are NaN or far outside 0 to 1")
    return Texture(decoded(image, read_bytes(image)), _flipped(places)[corners].astype(np.float32))


def _flipped(places: Float64[np.ndarray, "N 2"]) -> Float64[np.ndarray, "N 2"]:
    """Return texture coordinates whose v points the other way; float64, so that it can be undone."""
    return places * [1.0, -1.0] + [0.0, 1.0]


def _image(path: Path, found: _Lines) -> Path | None:
    """Return the image of the only material, a file beside the OBJ."""
    (wanted,) = found.materials
    for library in found.libraries:
        file = _neighbour(path, library)
        if file is None:
            continue
        material = None
        for _, words in _statements(read_bytes(file).decode("utf-8", "replace")):
            if words[0] == "newmtl" and len(words) == 2:
                material = words[1]
            elif words[0] == "map_Kd" and len(words) == 2 and material == wanted:
                return _neighbour(path, words[1])
    return None


def _neighbour(path: Path, name: str) -> Path | None:
    """Return a file in the folder of another; None for names that lead elsewhere, or to no file."""
    if name in ("", ".", "..") or "/" in name or "\\" in name or ":" in name or "\0" in name:
        return None
    file = path.with_name(name)
    try:
        return file if file.is_file() else None
    except (OSError, ValueError):  # too long
        return None
