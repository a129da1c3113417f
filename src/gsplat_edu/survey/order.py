"""The order in which checks and findings are told, and which finding explains which others."""

from __future__ import annotations

from gsplat_edu.evaluate.verdict import RANKED

CHECKS = (
    *(
        "enough photos",
        "files",
        "parallax",
        "intrinsics",
        "sizes",
        "agreement",
        "places",
        "viewing directions",
        "sharpness",
    ),
    *("length", "training views", "outliers", "things that moved", "test views"),
    *("exposure", "coverage", "duplicates", "cloud", "sky", "masks", "resolution"),
    *("poses", "missing photos", "depth"),
    *("floaters", "cut-outs", "splats"),
)
"""Names of the checks of a capture and of a run, the most harmful faults first; those of plug-ins come last."""

CAUSES = (
    *("usable", "no parallax", "unusable", "missing", "misread poses", "foreign poses"),
    *("wrong poses", "intrinsics", "sizes"),
    *("doubtful poses", "facing away", "splats", "same photo", "duplicates", "same pose", "white balance"),
    *RANKED,
    *("far points", "unseen points", "few points", "depth", "unexplained"),
    *("moved", "outside cut-outs", "floaters", "huge splats", "one side", "one height", "sky", "masks"),
    *("resolution", "faint splats", "overlap", "brightness"),
)
"""Names of the findings, causes before what they cause; the verdict ranks those of a run. Of two pieces of advice that
contradict each other, that of the more serious finding counts, and of equally serious ones that of the earlier in this
order; those of plug-ins come last."""

EXPLAINS = {
    "misread poses": ("no parallax", "wrong poses", "facing away", "hole", "poor fit"),
    "wrong poses": ("facing away", "hole", "poor fit"),
    "unfinished": ("short training", "poor fit", "unexplained", "overfitted", "floaters"),
    "moving subject": ("unexplained", "overfitted", "moved", "floaters"),
    "overfitted": ("short training",),
    "few photos": ("short training",),
}
"""Findings that another one explains, so that their own advice is left out: what to do about the cause comes first."""
