"""Find photos of a run that show objects which other photos do not, as the masks of a training do."""

from __future__ import annotations

from collections.abc import Sequence

from gsplat_edu.base.text import Told
from gsplat_edu.evaluate.verdict import MOVING, NOTABLE
from gsplat_edu.parts.run_values import Ended
from gsplat_edu.parts.transients.masks import Compared, FeatureRenderer, find_masks
from gsplat_edu.parts.transients.search import FEWEST, reduced
from gsplat_edu.render.settings import RenderSettings
from gsplat_edu.scene.gaussians import Gaussians
from gsplat_edu.scene.views import View
from gsplat_edu.survey.finding import Finding, Remedy, Severity, command, counted

ENOUGH = 12
"""`--transients auto` looks for moving objects from this number of training photos on. In smaller captures, fewer than
four photos show most places, which are too few to compare."""


def transients_for(count: int) -> Remedy:
    """Choose `--transients` from the number of training photos. Only the training can find out what moved."""
    if count < ENOUGH:
        return Remedy(
            "none",
            f"{count} training photos are too few to tell what moved; from {ENOUGH} on, they are compared",
        )
    return Remedy(
        "mask",
        f"{count} training photos are enough to tell what moved; a photo where nothing did keeps every pixel",
    )


def moved_parts(
    gaussians: Gaussians, views: Sequence[View], render: FeatureRenderer, settings: RenderSettings
) -> list[tuple[str, float]]:
    """Return the names of training photos that show objects which others do not, and the fraction they cover.

    Args:
        gaussians: The trained scene, in the cameras' world coordinates.
        views: The training views.
        render: Renders features.
        settings: The run's render settings.

    Returns:
        The largest share first; empty if there are too few views to compare.

    Raises:
        DatasetError: a photo cannot be read.
    """
    if len(views) < FEWEST:
        return []
    small = [reduced(view) for view in views]
    found = find_masks(gaussians, small, Compared(render, settings, lambda index, camera: camera))
    shares = [
        (view.name, float(one.mask.mean()))
        for view, one in zip(views, found, strict=True)
        if one.mask.mean() >= NOTABLE
    ]
    return sorted(shares, key=lambda entry: (-entry[1], entry[0]))


def check_moved(moved: Sequence[tuple[str, float]], photos: int) -> list[Finding]:
    """Report objects that moved, and whether they are the subject of the photos.

    Args:
        moved: The training photos that show them, as `moved_parts` returns them.
        photos: Number of training photos.
    """
    if not moved:
        return []
    names = tuple(name for name, _ in moved)
    shares = tuple(f"{100 * share:.1f} %" for _, share in moved)
    if len(names) >= max(MOVING * photos, 2):
        what = (
            f"a subject moves through the scene: {len(names)} of {photos} training photos show it where others"
            " do not, in per cent of their pixels"
        )
        still = "to have it in the scene, photograph it while it stands still"
        advice = Told(
            f"train with --transients mask, which leaves the moving subject out; {still}",
            f"mask the moving subject in a training; {still}",
        )
        options = (("transients", "mask"),)
        return [Finding("moving subject", Severity.WARNING, what, advice, names, shares, options)]
    shown = counted(len(names), "photo")
    what = f"things or shadows that the other photos do not show in {shown}, in per cent of their pixels"
    first = f"compare {names[0]} with its render first"
    advice = Told(
        f"train with --transients mask, which masks what moved; {first}",
        f"mask what moved in a training; {first}",
    )
    return [Finding("moved", Severity.WARNING, what, advice, names, shares, (("transients", "mask"),))]


def moved_line(run: Ended) -> str:
    """Return a line about objects that moved: the photos that show them, or the command to find them.

    The comparison takes about 20 ms per photo on the CPU if photos are in memory. Otherwise reading them again would
    take longer, and the line only names the command.

    Args:
        run: The run.
    """
    doctor, images = command("doctor", run.path), run.dataset.images
    if run.render is None or images.needed > images.budget:
        return Told(f"to find photos that do not fit the scene: {doctor}", "")
    moved = moved_parts(run.gaussians, run.dataset.train, run.render, run.settings)
    if not moved:
        return ""
    (name, share), photos = moved[0], counted(len(moved), "photo")
    what = f"things or shadows that the other photos do not show in {photos}, most of all {name} ({100 * share:.1f} %)"
    return Told(
        f"{what}: see {doctor}; --transients mask leaves them out", f"{what}: examine the run under Judge"
    )
