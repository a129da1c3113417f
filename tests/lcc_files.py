"""A writer of XGRIDS' LCC and LCC2 for tests, after the white papers and independent of our reader."""

import json
import struct
from pathlib import Path

import numpy as np

from gsplat_edu.base.constants import C0
from gsplat_edu.io.axes import half_turned
from gsplat_edu.io.formats import write_scene
from gsplat_edu.io.scene import Scene
from gsplat_edu.scene.gaussians import Gaussians
from scene_files import random_scene

LEVELS = 2
BOUNDS = {"scale": 0.5, "shcoef": 1.0, "envscale": 2.0, "envshcoef": 0.5}
"""Largest values of the attributes; the smallest of harmonics are minus these, of scales 0."""

QUALITY, PORTABLE = "Quality", "Portable"


def lcc_scene(count: int, seed: int = 0, most: float = 0.45) -> Gaussians:
    """Return Gaussians of degree 3 whose scales and harmonics lie between the bounds, with unit quaternions."""
    g = random_scene(count, 15, seed).gaussians
    return Gaussians(
        means=g.means,
        quats=g.quats / g.quats.norm(dim=1, keepdim=True),
        log_scales=g.log_scales.clamp(max=float(np.log(most))),
        sh0=g.sh0.clamp(-0.49 / C0, 0.49 / C0),
        sh_rest=g.sh_rest.clamp(-most, most),
        logit_opacities=g.logit_opacities,
    )


def packed_splat(g: Gaussians, row: int, most_scale: float) -> bytes:
    """Return the 32 bytes of a splat, component by component."""
    center = struct.pack("<3f", *g.means[row].tolist())
    color = [round(255 * (0.5 + C0 * c)) for c in g.sh0[row, 0].tolist()]
    opacity = round(255 / (1 + np.exp(-float(g.logit_opacities[row]))))
    scales = [round(65535 * s / most_scale) for s in np.exp(g.log_scales[row].double().numpy())]
    w, x, y, z = g.quats[row].double().tolist()
    xyzw = [x, y, z, w]
    place = max(range(4), key=lambda i: abs(xyzw[i]))
    sign = 1.0 if xyzw[place] > 0 else -1.0
    rotation = place << 30
    for shift, value in zip((0, 10, 20), xyzw[:place] + xyzw[place + 1 :], strict=True):
        rotation |= round(1023 * (sign * value / np.sqrt(2.0) + 0.5)) << shift
    return center + struct.pack("<4B3HI3H", *color, opacity, *scales, rotation, 7, 8, 9)


def packed_harmonics(g: Gaussians, row: int, most: float) -> bytes:
    """Return the 64 bytes of a splat's harmonics."""
    words = []
    for coefficient in g.sh_rest[row].tolist():
        red, green, blue = ((value + most) / (2 * most) for value in coefficient)
        words.append(round(2047 * red) | round(1023 * green) << 11 | round(2047 * blue) << 21)
    return struct.pack("<16I", *words, 0xFFFFFFFF)


def write_lcc(
    path: Path, cells: list[Gaussians], coarse: Gaussians, environment: Gaussians | None, kind: str = QUALITY
) -> Path:
    """Write an LCC whose cells have their own finest level and the same coarse one; return its .lcc.

    Args:
        path: The .lcc.
        cells: The finest level of each cell.
        coarse: The other level of each cell.
        environment: The background, or None.
        kind: Its "fileType".
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    data, harmonics, index = b"", b"", b""
    for number, finest in enumerate(cells):
        index += struct.pack("<HH", number, 3)
        for level in (finest, coarse):
            splats = [packed_splat(level, row, BOUNDS["scale"]) for row in range(len(level))]
            index += struct.pack("<IQI", len(level), len(data), 32 * len(level))
            data += b"".join(splats)
            harmonics += b"".join(packed_harmonics(level, row, BOUNDS["shcoef"]) for row in range(len(level)))
    of_quality = kind == QUALITY
    files = {"index.bin": index, "data.bin": data} | ({"shcoef.bin": harmonics} if of_quality else {})
    if environment is not None:
        files["environment.bin"] = b"".join(
            packed_splat(environment, row, BOUNDS["envscale"])
            + (packed_harmonics(environment, row, BOUNDS["envshcoef"]) if of_quality else b"")
            for row in range(len(environment))
        )
    for name, content in files.items():
        (path.parent / name).write_bytes(content)
    meta = {
        "version": "5.0",
        "totalLevel": LEVELS,
        "splats": [sum(map(len, cells)), len(cells) * len(coarse)],
        "encoding": "COMPRESS",
        "fileType": kind,
        "attributes": [
            {"name": name, "min": [0.0 if "scale" in name else -most] * 3, "max": [most] * 3}
            for name, most in BOUNDS.items()
        ],
    }
    path.write_text(json.dumps(meta))
    return path


def small_lcc(folder: Path) -> Path:
    """Write an LCC of two cells and an environment; return its .lcc."""
    cells, coarse = [lcc_scene(12, 1), lcc_scene(8, 2)], lcc_scene(5, 3)
    return write_lcc(folder / "lcc" / "meta.lcc", cells, coarse, lcc_scene(4, 4))


def write_lcc2(path: Path, finest: Gaussians, coarse: Gaussians, environment: Gaussians, kind: str) -> Path:
    """Write an LCC2 of three leaves in two files, with a coarser level and an environment; return its .lcc2.

    Args:
        path: The .lcc2.
        finest: At least 3 Gaussians.
        coarse: The other level.
        environment: The background.
        kind: Suffix of its files.
    """
    half, folder = len(finest) // 2, "data/3dgs"
    parts = [coarse, finest[:half], finest[half:], environment]
    names = [f"{folder}/{number}{kind}" for number in range(len(parts))]
    for name, part in zip(names, parts, strict=True):
        write_scene(
            path.parent / name, Scene(half_turned(part) if kind == ".spz" else part)
        )  # y is up in an SPZ
    rest = len(finest) - half

    def leaf(file: int, start: int, count: int) -> dict:
        return {"childNum": 0, "data": {"3dgs": {"name": file, "start": start, "count": count}}}

    inner = {
        "childNum": 3,
        "data": {"3dgs": {"name": 0, "start": 0, "count": len(coarse)}},
        "child": {"0": leaf(1, 0, half), "1": leaf(2, 0, rest - 1), "2": leaf(2, rest - 1, 1)},
    }
    root = {"data": {"env": {"name": 3}}, "splatFiles": names, "childNum": 1, "child": {"0": inner}}
    meta = {
        "version": "0.0.3",
        "splatType": kind,
        "totalLevels": 2,
        "totalSplats": len(finest) + len(coarse),
        "lodSplats": [len(finest), len(coarse)],
        "env": None,
        "root": root,
    }
    path.write_text(json.dumps(meta))
    return path


def small_lcc2(folder: Path) -> Path:
    """Write an LCC2 of PLYs; return its .lcc2."""
    return write_lcc2(folder / "lcc2" / "a.lcc2", lcc_scene(20), lcc_scene(5), lcc_scene(4), ".ply")
