"""The masks of things that move in the run's folder, and their pictures for the report."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool
from PIL import Image

from gsplat_edu.base.files import written_aside
from gsplat_edu.base.text import as_file_name, image_file_names
from gsplat_edu.data.capture import is_outside
from gsplat_edu.data.dataset import Dataset
from gsplat_edu.data.images import PhotoFile
from gsplat_edu.evaluate.masked import MaskedPicture
from gsplat_edu.evaluate.metrics import to_bytes
from gsplat_edu.parts.run_values import Reported
from gsplat_edu.parts.transients.masks import LARGEST_SHARE
from gsplat_edu.parts.transients.search import Transients
from gsplat_edu.photos.decoding import decode_mask
from gsplat_edu.scene.photo import resized_mask
from gsplat_edu.scene.views import View

FOLDER = "transients"
"""Name of the folder of masks in the run's."""

PICTURES = 6
"""Most masked photos shown in a report."""


def write_masks(run: Path, dataset: Dataset, found: Transients) -> tuple[str, dict[str, Any]]:
    """Write RUN/transients/NAME.png, zero for pixels that do not count, for every photo with a masked part.

    Pixels that the capture's own masks exclude are zero too. A mask has the size of its photo's file, as masks of
    captures have; where a photo is undistorted or cut from a panorama, it has the size and shape of the result. Masks
    from an earlier completion of the run are removed.

    Args:
        run: The run's folder.
        dataset: The capture.
        found: The masks of its training views.

    Returns:
        A sentence for the user, and "transients" for metrics.json.

    Raises:
        DatasetError: a photo cannot be read.
        OSError: a file cannot be written.
    """
    sources, shares, written = dict(dataset.files), dict[str, float](), set[Path]()
    for view, mask in zip(dataset.train, found.masks, strict=True):
        if mask is not None:
            shares[view.name] = float(mask.mean())
            path = mask_path(run, view.name)
            _write(path, _counting(view, mask), sources.get(view.name))
            written.add(path)
    for path in (run / FOLDER).rglob("*.png"):
        if path not in written:
            path.unlink()
    largest_first = sorted(shares, key=lambda name: (-shares[name], name))
    alone = [view.name for view, large in zip(dataset.train, found.too_large, strict=True) if large]
    facts = {
        "photos": [{"name": name, "share": round(shares[name], 4)} for name in largest_first],
        "left_alone": alone,
    }
    return _sentence(run, facts, len(dataset.train)), facts


def mask_path(run: Path, name: str) -> Path:
    """Return the file of a view's mask."""
    safe = image_file_names([name])[0] if is_outside(run / FOLDER, name) else f"{name}.png"
    return run / FOLDER / as_file_name(safe)


def masked_pictures(run: Reported) -> list[MaskedPicture]:
    """Make the pictures of the photos with the largest masked parts.

    Raises:
        DatasetError: a photo or a mask cannot be read.
    """
    by_name = {view.name: view for view in run.views}
    pictures = []
    for name in masked_names(run.metrics)[:PICTURES]:
        view, path = by_name.get(name), mask_path(run.path, name)
        if view is None or not path.is_file():
            continue
        counts = resized_mask(decode_mask(path), view.camera.H, view.camera.W)
        with torch.no_grad():
            image = run.renderer(run.gaussians, view.camera).image
        photo = np.asarray(to_bytes(view.read().over(run.background)))
        pictures.append(MaskedPicture.of(name, photo, ~counts, to_bytes(image)))
    return pictures


def masked_names(metrics: Mapping[str, Any]) -> list[str]:
    """Return the names of the masked photos in a metrics.json, largest masked part first."""
    section = metrics.get("transients")
    photos = section.get("photos") if isinstance(section, Mapping) else None
    entries = photos if isinstance(photos, list) else []
    return [str(entry.get("name")) for entry in entries if isinstance(entry, Mapping)]


def _sentence(run: Path, facts: Mapping[str, Any], total: int) -> str:
    photos, alone = facts["photos"], facts["left_alone"]
    if photos:
        most = f"most of {photos[0]['name']} ({100 * photos[0]['share']:.1f} %)"
        said = f"things that moved are masked in {len(photos)} of {total} photos, {most}: {run / FOLDER}"
    else:
        said = f"nothing moved: none of {total} photos shows what the others do not"
    if alone:
        share = f"more than {100 * LARGEST_SHARE:.0f} %"
        said += (
            f"; not masked, because {share} of each differs: {len(alone)} of {total} photos, first {alone[0]}"
        )
    return said


def _counting(view: View, mask: Bool[np.ndarray, "h w"]) -> Bool[np.ndarray, "H W"]:
    """Return which pixels of a view count, at its size."""
    counts = ~resized_mask(mask, view.camera.H, view.camera.W)
    given = view.read().mask
    return counts if given is None else counts & given


def _write(path: Path, counts: Bool[np.ndarray, "H W"], source: PhotoFile | None) -> None:
    if source is not None and not source.resampled:
        counts = resized_mask(counts, source.lens.H, source.lens.W)
    with written_aside(path) as aside:
        Image.fromarray(np.where(counts, 255, 0).astype(np.uint8)).save(aside, format="PNG")
