"""Write maps to files: float32 TIFF with the values, 16-bit PNG for other programs, and a coloured preview."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path

import cv2
import matplotlib as mpl
import numpy as np
from jaxtyping import Float, UInt8

from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.base.files import written_aside
from gsplat_edu.evaluate.images import save_png

LIST = "maps.json"
"""Name of the file with the scale and offset of each 16-bit PNG."""

FULL = 65535
"""Largest value of a 16-bit PNG."""

Map = Float[np.ndarray, "H W"] | Float[np.ndarray, "H W 3"]


def write_maps(folder: Path, stem: str, maps: Mapping[str, Map]) -> dict[str, dict[str, float]]:
    """Write the maps of one view: STEM.MAP.tiff, STEM.MAP.png and STEM.MAP.preview.png each.

    The TIFF has float32 values. The PNG has 16 bits: alpha is v / 65535, a depth or distortion v times a unit that
    differs from file to file, an axis of a normal 2 v / 65535 - 1.

    Args:
        folder: Output folder; it is created.
        stem: Name of the view in the file names.
        maps: Maps by name, as `gsplat_edu.render.maps.render_maps` gives them, as arrays: (H, W), or (H, W, 3) normals.

    Returns:
        By file name of the PNG: "scale" and "offset", with which a value v of the PNG stands for scale v + offset.

    Raises:
        ArgumentError: a map has a NaN or an infinite value.
        OSError: a file cannot be written. An existing file stays unchanged.
    """
    scales = {}
    for name, found in maps.items():
        values = np.asarray(found, dtype=np.float32)
        if not np.isfinite(values).all():
            raise ArgumentError(f"{name}: has values that are NaN or infinite")
        low, high = (-1.0, 1.0) if values.ndim == 3 else (0.0, 1.0)
        if values.ndim == 2 and name != "alpha":
            high = float(values.max(initial=0.0)) or 1.0
        file = folder / f"{stem}.{name}.png"
        _write(file.with_suffix(".tiff"), values)
        _write(file, np.round((values.clip(low, high) - low) * (FULL / (high - low))).astype(np.uint16))
        save_png(file.with_suffix(".preview.png"), preview(name, values))
        scales[file.name] = {"scale": (high - low) / FULL, "offset": low}
    return scales


def write_list(folder: Path, scales: Mapping[str, Mapping[str, float]]) -> Path:
    """Write `LIST`: scale and offset of every 16-bit PNG in a folder."""
    path = folder / LIST
    with written_aside(path) as aside:
        aside.write_text(json.dumps(scales, indent=1) + "\n", encoding="utf-8")
    return path


def preview(name: str, values: Map) -> UInt8[np.ndarray, "H W 3"]:
    """Return a map as an image to look at.

    Args:
        name: Name of the map.
        values: The map.

    Returns:
        (H, W, 3): alpha in grey, distortion too, white at its 98th percentile; normals as (n + 1) / 2; a depth from
        near (red) to far (blue) between its 2nd and 98th percentile, black where there is none.
    """
    if values.ndim == 3:
        drawn = (values != 0).any(axis=-1, keepdims=True)
        return _bytes(np.where(drawn, (values + 1.0) / 2.0, 0.0))
    if "depth" not in name:
        white = 1.0 if name == "alpha" else float(np.percentile(values, 98)) or 1.0
        return _bytes(np.repeat(values[..., None] / white, 3, axis=2))
    drawn = values > 0
    near, far = np.percentile(values[drawn], (2, 98)) if drawn.any() else (0.0, 1.0)
    share = (values - near) / max(far - near, np.finfo(np.float32).tiny)
    colors = mpl.colormaps["turbo"](1.0 - share.clip(0.0, 1.0))[..., :3]
    return _bytes(np.where(drawn[..., None], colors, 0.0))


def _bytes(colors: np.ndarray) -> UInt8[np.ndarray, "H W 3"]:
    return np.round(255.0 * colors.clip(0.0, 1.0)).astype(np.uint8)


def _write(path: Path, values: np.ndarray) -> None:
    """Encode an image by its suffix, RGB as RGB, and write it."""
    in_order = np.ascontiguousarray(values[..., ::-1]) if values.ndim == 3 else values  # OpenCV takes BGR
    encoded, data = cv2.imencode(path.suffix, in_order)
    if not encoded:
        raise ArgumentError(f"{path}: OpenCV cannot encode {path.suffix[1:].upper()} here")
    with written_aside(path) as aside:
        aside.write_bytes(data.tobytes())
