"""The scores by which short trainings chose what a run refines: kept in config.json, told by the report."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any

LARGEST_SCORE = 1e6
"""Scores below this are plausible, dB; NaN and infinities are not."""

KEY = "refine_trials"
"""Key of config.json."""

CONTROL = " (control)"
"""End of the name of a training that learns neither lens nor motion, and renders pinholes as other lenses."""


@dataclass(frozen=True)
class RefineTrials:
    """Scores of short trainings with different values of the setting `refine`.

    Args:
        posed: Mean PSNR of the held-out photos with aligned poses, dB, by the value of `refine`.
        moving: The same with aligned motions during the readout, of those trainings that were scored so.
        asked: The value of `refine` that the user gave; "" if the trainings chose it.
    """

    posed: Mapping[str, float] = field(default_factory=dict)
    moving: Mapping[str, float] = field(default_factory=dict)
    asked: str = ""

    @property
    def record(self) -> dict[str, Any]:
        """The scores for config.json by their key there, rounded to 0.0001 dB."""
        scores = {
            name: {k: round(v, 4) for k, v in getattr(self, name).items()} for name in ("posed", "moving")
        }
        return {KEY: asdict(self) | scores}

    @classmethod
    def of(cls, config: Mapping[str, Any]) -> RefineTrials | None:
        """Return the scores in a run's config.json; None if it has none that can be read."""
        entry = config.get(KEY)
        if not isinstance(entry, Mapping) or not isinstance(entry.get("asked"), str):
            return None
        posed, moving = (_scores(entry.get(name)) for name in ("posed", "moving"))
        return None if posed is None or moving is None else cls(posed, moving, entry["asked"])

    @property
    def gain(self) -> float | None:
        """What the value that the user gave gains over no refinement, dB; None if the user gave none."""
        scores = self.moving if self.asked in self.moving else self.posed
        without = next((name for name in (f"none{CONTROL}", "none") if name in scores), None)
        return None if without is None or self.asked not in scores else scores[self.asked] - scores[without]

    def note(self, refine: str) -> str:
        """Return a sentence for the report of a run that refines this."""
        return f"refine {refine}: {self}"

    def __str__(self) -> str:
        """Return the scores as a clause."""
        parts = [
            f"{aligned} aligned, at "
            + ", ".join(f"{score:.2f} dB with {name}" for name, score in scores.items())
            for aligned, scores in (("poses", self.posed), ("poses and motions", self.moving))
            if scores
        ]
        clause = f"short trainings score the held-out photos, {'; '.join(parts)}"
        if (gain := self.gain) is None:
            return clause
        return (
            f"{clause}: {self.asked} {'improves' if gain > 0 else 'does not improve'} them ({gain:+.2f} dB)"
        )


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and abs(value) < LARGEST_SCORE


def _scores(entry: object) -> Mapping[str, float] | None:
    """Return the scores of an entry; None if they are not numbers by name."""
    if not isinstance(entry, Mapping) or not all(map(_is_number, entry.values())):
        return None
    return {str(name): float(value) for name, value in entry.items()}
