"""The page of a folder with levels of detail, and the files that its server gives it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from msgspec.structs import asdict

from gsplat_edu.io.lod import codec
from gsplat_edu.io.lod.meta import LodMeta
from gsplat_edu.io.sog.codec import read_meta
from gsplat_edu.viewer import page


def folder_page(path: Path, title: str, budget: int | None = None) -> tuple[bytes, dict[str, Path]]:
    """Make the page of a streamed SOG. It holds the tree, but no splats.

    Args:
        path: The lod-meta.json.
        title: Heading of the page.
        budget: Largest number of splats that the page draws at once; None lets it choose for its machine.

    Returns:
        The page, and the files to serve with it, by their address on the server.

    Raises:
        SceneFormatError: the folder is damaged.
        OSError: a file cannot be read.
    """
    index = codec.read_index(path)
    files = codec.named_files(path)
    coarsest = codec.read_level(path, index, index.levels - 1)
    html = page.levels_html(coarsest, described(path, index, budget), title)
    return html, {f"/{name}": file for name, file in files.items()}


def described(path: Path, index: LodMeta, budget: int | None) -> dict[str, Any]:
    """Return the description of the regions for the page.

    Args:
        path: The lod-meta.json.
        index: Its contents.
        budget: As for `folder_page`.
    """
    regions = [
        {
            "low": region.low,
            "high": region.high,
            "errors": region.errors,
            "runs": {level: asdict(run) for level, run in region.runs.items() if run.count},
        }
        for region in index.regions
    ]
    filenames = list(index.filenames)
    finest = index.counts()[0]
    if index.environment is not None:
        count = read_meta(codec.file_of(path, index.environment)).count
        everywhere = {"low": [-1e30] * 3, "high": [1e30] * 3, "errors": ()}
        run = {"file": len(filenames), "offset": 0, "count": count}
        regions.append({**everywhere, "runs": {0: run} if count else {}})
        filenames.append(index.environment)
        finest += count
    return {"regions": regions, "filenames": filenames, "finest": finest, "budget": budget}
