"""Run all checks of a capture before training, those of the parts too, and combine them into one diagnosis.

Chapter: 14_photos_to_scene.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence

from gsplat_edu.base.text import Told, short_number
from gsplat_edu.data.notes import Background, MissingPhotos, Note
from gsplat_edu.doctor.appearance import check_blur, check_duplicates
from gsplat_edu.doctor.cameras import (
    check_agreement,
    check_away,
    check_coverage,
    check_intrinsics,
    check_parallax,
    check_resolution,
    check_sizes,
    check_wrong_poses,
)
from gsplat_edu.doctor.cloud import check_cloud
from gsplat_edu.doctor.diagnosis import Advice, Diagnosis, in_order, new_run
from gsplat_edu.doctor.files import check_missing, check_poses, check_readable, check_usable
from gsplat_edu.survey.capture import Survey
from gsplat_edu.survey.finding import Finding, command
from gsplat_edu.survey.proof import Verdict
from gsplat_edu.train.part import parts

Check = Callable[[Survey], list[Finding]]

OF_FILES: tuple[tuple[str, Check], ...] = (
    ("enough photos", check_usable),
    ("files", check_readable),
)
"""Checks that need no usable photo."""

OF_VIEWS: tuple[tuple[str, Check], ...] = (
    ("parallax", check_parallax),
    ("intrinsics", check_intrinsics),
    ("sizes", check_sizes),
    ("places", check_wrong_poses),
    ("viewing directions", check_away),
    ("sharpness", check_blur),
    ("coverage", check_coverage),
    ("duplicates", check_duplicates),
    ("cloud", check_cloud),
    ("resolution", check_resolution),
)
"""Checks that compare views; they need at least two."""

OF_PROOFS: tuple[tuple[str, Check], ...] = (("agreement", check_agreement),)
"""Checks of what the photos say about the poses, if they say anything."""

OF_LISTS: tuple[tuple[str, Check], ...] = (
    ("poses", check_poses),
    ("missing photos", check_missing),
)
"""Checks for missing photos and poses; they rarely matter."""


def examine(survey: Survey, options: Sequence[str] = ()) -> Diagnosis:
    """Run all checks on a capture.

    Args:
        survey: The capture, prepared.
        options: The user's training options, as command-line words; the recommended command repeats them, and adds
            --resolution auto where the photos are much larger than the scene resolves.
    """
    proven = survey.proof is not None and survey.proof.verdict is not Verdict.UNCHECKED
    checks = [
        *OF_FILES,
        *(OF_VIEWS if len(survey.shots) > 1 else ()),
        *(OF_PROOFS if proven else ()),
        *OF_LISTS,
    ]
    by_parts = [found for part in parts().values() if (found := part.examine(survey)) is not None]
    findings, fine = in_order(
        [
            *((name, check(survey)) for name, check in checks),
            *(check for part in by_parts for check in part.checks.items()),
        ]
    )
    if "--resolution" not in options and any(finding.name == "resolution" for finding in findings):
        options = (*options, "--resolution", "auto")
    advice = _otherwise(survey, options)
    facts = (*_facts(survey), *(fact for part in by_parts for fact in part.facts))
    return Diagnosis(facts, findings, fine, advice, _notes(survey))


def _facts(survey: Survey) -> tuple[tuple[str, str], ...]:
    sizes = Counter(f"{shot.size[0]}x{shot.size[1]}" for shot in survey.shots)
    kinds = ", ".join(
        size if n == len(survey.shots) else f"{n} of {size}" for size, n in sizes.most_common(2)
    )
    photos = f"{len(survey.shots)} photos" + (
        f" of {kinds}" if len(sizes) == 1 else f", {kinds}" if sizes else ""
    )
    cloud = f"{len(survey.points):,} points" if len(survey.points) else "no points"
    facts = [("capture", str(survey.path)), ("holds", f"{survey.layout}: {photos}; {cloud}")]
    if len(survey.shots) > 1:
        facts.append(("cameras", _arrangement(survey)))
    if survey.proof is not None and not check_agreement(survey):
        facts.append(("", str(survey.proof)))
    return tuple(facts)


def _notes(survey: Survey) -> tuple[Note, ...]:
    """Return the notes to show; `check_missing` reports the photos that have no file."""
    others = [note for note in survey.notes if not isinstance(note, MissingPhotos)]
    clear = sum(shot.stats.transparent for shot in survey.shots) if survey.layout == "Blender" else 0
    if clear:
        others.insert(0, Background(clear, len(survey.shots), None, True))
    return tuple(others)


def _arrangement(survey: Survey) -> str:
    geometry = survey.geometry
    arrangement = {
        "inward": "point at a common centre",
        "outward": "point outwards",
        "forward": "point one way",
        "free": "point in various directions",
    }[geometry.arrangement]
    return f"{arrangement}; {short_number(geometry.depth, 3)} world units from their subject"


def _otherwise(survey: Survey, options: Sequence[str]) -> tuple[Advice, ...]:
    """Return advice for captures with few problems."""
    place = survey.path.resolve()
    name = place.name if place.is_dir() else place.parent.name  # transforms.json is in its capture's folder
    out, short = new_run(name), new_run(f"{name}_draft")
    cloud = (
        ()
        if len(survey.points)
        else (
            Told(
                "start points help: add points from structure from motion with --points X.ply",
                "start points help: finding the poses of the photos makes them",
            ),
        )
    )
    draft = command("train", survey.path, "--quality", "draft", "--out", short)
    why = "a short run shows in minutes whether the poses are right"
    trial = (Told(f"{why}: {draft}", f"{why}: train with the quality Draft"),)
    given = (
        Told(f"train: {command('train', survey.path, *options, '--out', out)}", ""),
        *cloud,
        *(() if options else trial),
        Told(f"check the run afterwards: {command('doctor', out)}", ""),
    )
    return tuple(map(Advice, given))
