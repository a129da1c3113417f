"""Choose how finely photos are searched for features: as coarsely as still finds enough of them.

COLMAP doubles a photo's size before it searches (Lowe 2004, section 3.3), which finds features of about a pixel and
takes four times as long. Photos with much detail have enough features without it; some of them are searched first.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from gsplat_edu.sfm.colmap import forget_features

Groups = Sequence[Mapping[str, Any]]
"""Photos by camera, as for `gsplat_edu.sfm.engine.jobs.features`."""

Find = Callable[[Groups, Mapping[str, float], Path], dict[str, int]]
"""Finds features with settings of COLMAP's detector, writes them to a database, and returns their number by photo.
Photos that have features in the database are skipped."""

FINEST: Mapping[str, float] = {"first_octave": -1}
"""COLMAP's own search, in the photo at twice its size."""


class Search(NamedTuple):
    """A search.

    Args:
        sift: Settings of COLMAP's detector.
        enough: Median number of features of a photo from which on the search is fine enough.
    """

    sift: Mapping[str, float]
    enough: int


COARSE = (
    Search({"first_octave": 0}, 2000),
    Search({"first_octave": 0, "peak_threshold": 0.0033}, 1000),
)
"""Searches in the photo's own size, the coarsest first; the second has half of COLMAP's own threshold.

The first takes 25 photos of fox (1,600 px, 3,141 instead of 7,233 features) from 91 to 34 s of processor time for
features, matches and poses, the second 40 of snowmiku97 (990 px, 1,228 instead of 2,382 features) from 55 to 23 s. All
photos keep a pose, whose median error falls from 0.084 to 0.075 % of the extent, and from 0.21 to 0.14 %; the points
are a quarter fewer. Photos of seneca167 at 800 px would keep 850 of 2,400 features: they are searched as finely as
possible."""

PROBED = 8
"""Number of photos that are searched to choose the search."""

FEWEST_PROBED = 30
"""Fewer photos are searched as finely as possible: their features take a minute at most, and poses need them most."""

POOR = 500
"""Photos in which a coarse search finds fewer features are searched again as finely as possible."""


def find_features(find: Find, groups: Groups, database: Path) -> dict[str, int]:
    """Find features as coarsely as still finds enough of them.

    Args:
        find: Finds features.
        groups: The photos.
        database: COLMAP's database; a file probe.db beside it is written and removed.

    Returns:
        The number of features by photo.
    """
    chosen = _chosen(find, groups, database.with_name("probe.db"))
    found = find(groups, chosen, database)
    poor = [name for name, count in found.items() if count < POOR]
    if not poor or chosen == FINEST:
        return found
    forget_features(database, poor)
    return find(groups, FINEST, database)


def _chosen(find: Find, groups: Groups, probe: Path) -> Mapping[str, float]:
    """Search some photos, and return the settings of the coarsest search that is fine enough."""
    names = sorted(name for group in groups for name in group["names"])
    if len(names) < FEWEST_PROBED:
        return FINEST
    some = {names[i * len(names) // PROBED] for i in range(PROBED)}
    few = [{**group, "names": [name for name in group["names"] if name in some]} for group in groups]
    few = [group for group in few if group["names"]]
    for search in COARSE:
        _remove(probe)  # of a run that was interrupted
        found = find(few, search.sift, probe)
        _remove(probe)
        if np.median(list(found.values())) >= search.enough:
            return search.sift
    return FINEST


def _remove(database: Path) -> None:
    """Remove a database and what SQLite may have left beside it."""
    for ending in ("", "-wal", "-shm"):
        database.with_name(f"{database.name}{ending}").unlink(missing_ok=True)
