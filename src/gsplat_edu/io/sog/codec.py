"""PlayCanvas' SOG, version 2: the scene as images, a seventh of the PLY's size, or a fifteenth with many splats.

A .sog is a zip of a meta.json and WebP images; the same files may also lie in a folder, identified by its meta.json.
All images but one have a pixel per splat: low and high bytes of positions, rotations, scales, colours with opacities,
labels of harmonics. Scales and colours are bytes that select from codebooks of 256 values; labels select from a palette
of up to 65,536 sets of SH coefficients, which is the remaining image. `gsplat_edu.io.sog.values` handles positions and
rotations, `gsplat_edu.io.sog.palette` the codebooks and the palette.

The writer sorts splats along a Morton curve, so that neighbours in an image are neighbours in the scene and the images
compress well. Opacities are rounded to 1/255. Rotations keep 8 bits per component; the identity is not representable
and comes back rotated by half a degree. If the palette holds all sets of coefficients, as for up to 1024 splats, only
its codebook causes rounding.

Axes are the scene's, as in a PLY: nothing is flipped. The text of the specification says that y is up, but files of
PlayCanvas' own converter hold the values of the source PLY. The up direction is stored in a key of our own, which other
readers ignore.

A scene without splats has images of 4 x 4 unused pixels. Images must be WebP, lossless or lossy; the specification
allows other formats. Version 1 is rejected.

Source: PlayCanvas' specification of SOG; the reader and the writer of its splat-transform, for the axes, the
order of the files and codebooks that start with null.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float32, UInt8

from gsplat_edu.base.errors import ArgumentError, SceneFormatError
from gsplat_edu.base.validation import first_index
from gsplat_edu.io.quantize import byte_to_logit, check_expansion, logit_to_byte
from gsplat_edu.io.scene import Scene
from gsplat_edu.io.sog import files
from gsplat_edu.io.sog.meta import MOST_SPLATS, SHN, Harmonics, Meta, from_json, to_json
from gsplat_edu.io.sog.palette import MOST_ENTRIES, codebook, nearest_in_codebook, palette
from gsplat_edu.io.sog.values import (
    FIRST_TAG,
    pixels_to_quats,
    positions_to_steps,
    quats_to_pixels,
    steps_to_positions,
)
from gsplat_edu.scene.gaussians import Gaussians
from gsplat_edu.scene.morton import morton_codes

PER_ROW = 64
"""Palette entries per row of its image, with one pixel per coefficient."""

WEIGHT_RANGE = 20.0
"""Largest difference between the logarithm of a splat's weight and the median; beyond it, the weight is clamped."""


def read(path: Path) -> Scene:
    """Read a SOG.

    Args:
        path: The .sog, or the meta.json of a SOG folder.

    Returns:
        The scene, float32, in this package's axes.

    Raises:
        SceneFormatError: the file is not a SOG of version 2, or is damaged.
        OSError: the file cannot be read.
    """
    source: files.Files = files.Folder(path) if _in_folder(path) else files.Bundle(path)
    meta = _read_meta(path, source)
    check_expansion(path, meta.scene_bytes(), source.stored((files.META_NAME, *meta.images)))
    stored = {name: source.read(name) for name in meta.splat_images}
    if len({files.check_size(path, name, data, meta.count) for name, data in stored.items()}) > 1:
        raise SceneFormatError(f"{path}: its images differ in size; it is damaged, get it again")
    pixels = {
        name: files.decode(path, name, data).reshape(-1, 4)[: meta.count] for name, data in stored.items()
    }
    low, high = (pixels[name][:, :3].astype(np.uint16) for name in meta.means)
    quats, scales, colors = (pixels[name] for (name,) in (meta.quats, meta.log_scales, meta.colors))
    if (quats[:, 3] < FIRST_TAG).any():
        row = int(np.argmax(quats[:, 3] < FIRST_TAG))
        raise SceneFormatError(
            f"{path}: splat {row}: its rotation has an unknown encoding; the file is damaged, get it again"
        )
    gaussians = Gaussians(
        means=torch.from_numpy(steps_to_positions(low | high << 8, meta.span)),
        quats=torch.from_numpy(pixels_to_quats(quats)),
        log_scales=torch.from_numpy(meta.scales[scales[:, :3]]),
        sh0=torch.from_numpy(meta.sh0[colors[:, None, :3]]),
        sh_rest=torch.from_numpy(_read_harmonics(path, source, meta, pixels)),
        logit_opacities=torch.from_numpy(byte_to_logit(colors[:, 3])),
    )
    return Scene(gaussians, meta.antialiased, *meta.frame)


def read_meta(path: Path) -> Meta:
    """Read only the meta.json of a SOG folder.

    Args:
        path: The meta.json.

    Raises:
        SceneFormatError: as for `read`.
        OSError: the file cannot be read.
    """
    return _read_meta(path, files.Folder(path))


def _read_meta(path: Path, source: files.Files) -> Meta:
    data = source.read(files.META_NAME)
    if len(data) > files.META_LIMIT:
        raise SceneFormatError(
            f"{path}: its metadata has {len(data):,} bytes, too many for a scene; check its name"
        )
    return from_json(path, data)


def _in_folder(path: Path) -> bool:
    return path.name.lower() == files.META_NAME


def _read_harmonics(
    path: Path, source: files.Files, meta: Meta, pixels: dict[str, UInt8[np.ndarray, "N 4"]]
) -> Float32[np.ndarray, "N K 3"]:
    harmonics = meta.harmonics
    if harmonics is None:
        return np.zeros((meta.count, 0, 3), dtype=np.float32)
    name, labelled = harmonics.files
    low, high = pixels[labelled][:, 0].astype(np.int64), pixels[labelled][:, 1].astype(np.int64)
    labels = low | high << 8
    if (labels >= harmonics.entries).any():
        row = int(np.argmax(labels >= harmonics.entries))
        raise SceneFormatError(
            f"{path}: splat {row}: its label {labels[row]} exceeds the palette of {harmonics.entries}; "
            "the file is damaged, get it again"
        )
    data = source.read(name)
    width, height = files.size_of(path, name, data)
    rows = -(-harmonics.entries // PER_ROW)
    if width != PER_ROW * harmonics.coefficients or not rows <= height <= MOST_ENTRIES // PER_ROW:
        raise SceneFormatError(
            f"{path}: {name} has {width}x{height} pixels, but {harmonics.entries} entries of degree "
            f"{harmonics.degree} take {PER_ROW * harmonics.coefficients}x{rows}; it is damaged, get it again"
        )
    entries = files.decode(path, name, data).reshape(height * PER_ROW, harmonics.coefficients, 4)
    sh_rest: Float32[np.ndarray, "N K 3"] = harmonics.codebook[entries[: harmonics.entries, :, :3]][labels]
    return sh_rest


def write(path: Path, scene: Scene) -> None:
    """Write a SOG. The splats are reordered.

    Args:
        path: The .sog, or a meta.json; the images are then written next to it.
        scene: The scene, in this package's axes.

    Raises:
        ArgumentError: a parameter is NaN or infinite in float32, a quaternion has zero length, or there are more than
            67,108,864 splats.
        OSError: the file cannot be written. An existing file stays unchanged.
    """
    (files.write_folder if _in_folder(path) else files.write_bundle)(path, packed(scene))


def bundled(scene: Scene, entries: int | None = None) -> bytes:
    """Return the bytes of a .sog.

    Args:
        scene: The scene, in this package's axes.
        entries: Most entries of the palette, from 1,024 to 65,536; None for the usual number.

    Raises:
        ArgumentError: as for `write`.
    """
    return files.bundled(packed(scene, entries=entries))


def packed(scene: Scene, *, sort: bool = True, entries: int | None = None) -> dict[str, bytes]:
    """Return the files of a SOG by name, meta.json first.

    Args:
        scene: The scene, in this package's axes.
        sort: Whether to sort the splats along a Morton curve; otherwise they keep their order.
        entries: As for `bundled`.

    Raises:
        ArgumentError: as for `write`.
    """
    if len(scene.gaussians) > MOST_SPLATS:
        raise ArgumentError(
            f"gaussians: are {len(scene.gaussians):,}, but a SOG has at most {MOST_SPLATS:,}; write a PLY or split them"
        )
    gaussians = scene.gaussians.map(lambda tensor: tensor.detach().float())
    gaussians.check_finite()
    zero = (gaussians.quats == 0).all(dim=1).numpy(force=True)
    if zero.any():
        raise ArgumentError(
            f"quats{first_index(zero)}: has zero length, so it is not a rotation; remove the splat"
        )
    return _packed(replace(scene, gaussians=gaussians), sort, entries)


def _packed(scene: Scene, sort: bool, entries: int | None) -> dict[str, bytes]:
    values = {name: tensor.numpy(force=True) for name, tensor in scene.gaussians.tensors().items()}
    steps, span = positions_to_steps(values["means"])
    order = np.argsort(morton_codes(steps), kind="stable") if sort else np.arange(len(steps))
    steps = steps[order]
    values = {name: array[order] for name, array in values.items()}
    scales, sh0 = codebook(values["log_scales"]), codebook(values["sh0"])
    harmonics, palette_images = _packed_harmonics(
        values["sh_rest"], scene.gaussians.sh_degree, _weights(values), entries
    )
    meta = Meta(len(order), span, scales, sh0, harmonics, scene.antialiased, scene.frame)
    opacities = logit_to_byte(values["logit_opacities"])[:, None]
    images = {
        meta.means[0]: (steps & 255).astype(np.uint8),
        meta.means[1]: (steps >> 8).astype(np.uint8),
        meta.quats[0]: quats_to_pixels(values["quats"]),
        meta.log_scales[0]: nearest_in_codebook(values["log_scales"], scales),
        meta.colors[0]: np.concatenate([nearest_in_codebook(values["sh0"][:, 0], sh0), opacities], axis=1),
    }
    contents = {files.META_NAME: to_json(meta)}
    contents |= {name: files.encode(pixels) for name, pixels in images.items()}
    return contents | palette_images


def _weights(values: dict[str, Float32[np.ndarray, "..."]]) -> Float32[np.ndarray, " N"]:
    """Weight splats by their visibility: opacity times the geometric mean of their scales, clamped.

    On a trained scene of 15,105 splats this reduces the palette's loss in renders by 2 dB.
    """
    logs = values["log_scales"].mean(axis=1, dtype=np.float64)
    logs -= np.logaddexp(0.0, -values["logit_opacities"].astype(np.float64))
    middle = np.median(logs) if len(logs) else 0.0
    weights: Float32[np.ndarray, " N"] = np.exp(np.clip(logs - middle, -WEIGHT_RANGE, WEIGHT_RANGE)).astype(
        np.float32
    )
    return weights


def _packed_harmonics(
    sh_rest: Float32[np.ndarray, "N K 3"], degree: int, weights: Float32[np.ndarray, " N"], most: int | None
) -> tuple[Harmonics | None, dict[str, bytes]]:
    """Find a palette for the coefficients; without splats it still has one entry, as the format requires."""
    count, coefficients, _ = sh_rest.shape
    if degree == 0:
        return None, {}
    vectors = sh_rest.reshape(count, 3 * coefficients)
    if count:
        entries, labels = palette(vectors, weights, most)
    else:
        entries, labels = np.zeros((1, 3 * coefficients), dtype=np.float32), np.zeros(0, dtype=np.int64)
    numbers = codebook(entries)
    chosen = nearest_in_codebook(entries, numbers).reshape(-1, 3)
    halves = np.stack([labels & 255, labels >> 8, np.zeros_like(labels)], axis=1).astype(np.uint8)
    images = {
        SHN[0]: files.encode(chosen, width=PER_ROW * coefficients),
        SHN[1]: files.encode(halves),
    }
    return Harmonics(len(entries), degree, numbers), images
