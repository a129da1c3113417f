"""The section "Mesh" of a report: what is known of a mesh's accuracy, and pictures of it.

The section lies between two comments, so that `gsplat-edu mesh` can replace it in a report that an evaluation wrote.
"""

from __future__ import annotations

import html
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from gsplat_edu.base.files import written_aside
from gsplat_edu.base.reading import read_text
from gsplat_edu.base.text import short_number, spelled_bytes, write_text
from gsplat_edu.evaluate.report_parts import bullets, facts_table, folded, jpeg_image, section, slider_pair

BEGIN, END = "<!-- mesh -->\n", "<!-- end of mesh -->\n"
"""Around the section. Texts of a report are escaped, so that none of them can contain these."""

PANELS = ("photo", "mesh", "views", "agreement")
"""Pictures of a mesh from one camera: what the camera saw, the mesh, and the mesh coloured by two kinds of evidence."""

MANY_VIEWS = 12
"""In the picture "views", the brightest colour stands for so many views or more."""

TITLES = {
    "photo": "photo",
    "mesh": "mesh",
    "views": "number of views",
    "agreement": "agreement of depths",
}

LEGEND = (
    f"Number of views: from dark violet, seen by none, to yellow, seen by {MANY_VIEWS} or more. Agreement of depths: "
    "yellow where the depth maps that show a place agree with it, dark violet where they differ by a voxel or more on "
    "average, or where too few show it."
)


@dataclass(frozen=True)
class MeshFigure:
    """Pictures of a mesh from one training camera.

    Args:
        name: The view's name in the capture.
        panels: A JPEG for each of `PANELS`, of one size.
        rendered: Whether "photo" is a render of the splats, because the photo could not be read.
    """

    name: str
    panels: Mapping[str, bytes]
    rendered: bool = False


@dataclass(frozen=True)
class MeshEntry:
    """A mesh as a report shows it.

    Args:
        title: "Mesh" or "Collider".
        record: What is known of it, as `gsplat_edu.runs.meshes.record_of` collects it; entries may be missing.
        figures: Pictures of it.
    """

    title: str
    record: Mapping[str, Any]
    figures: Sequence[MeshFigure] = ()


def mesh_section(entries: Sequence[MeshEntry]) -> str:
    """Return the section as HTML, between its two comments; nothing is between them without a mesh.

    Args:
        entries: The meshes.
    """
    return BEGIN + "".join(section(entry.title, _body(entry)) for entry in entries) + END


def replace_mesh_section(path: Path, entries: Sequence[MeshEntry]) -> bool:
    """Replace the section of a report, and leave the rest of it as it is.

    Args:
        path: The report.
        entries: The meshes.

    Returns:
        Whether the file is a report: it has the comments.

    Raises:
        OSError: the file cannot be read or written. It is unchanged then.
    """
    page = read_text(path)
    start, stop = page.find(BEGIN), page.find(END)
    if not 0 <= start < stop:
        return False
    with written_aside(path) as aside:
        write_text(aside, page[:start] + mesh_section(entries) + page[stop + len(END) :])
    return True


def _body(entry: MeshEntry) -> str:
    facts = _facts(entry.record)
    notes = entry.record.get("notes")
    texts = [str(note) for note in notes] if isinstance(notes, list) else []
    legend = f'<p class="quiet">{LEGEND}</p>\n' if entry.figures else ""
    figures = "".join(_figure(figure) for figure in entry.figures)
    return f"{facts_table(facts)}{folded('what was left out', bullets(texts))}{figures}{legend}"


def _figure(figure: MeshFigure) -> str:
    below = "render of the splats" if figure.rendered else "photo"
    photo, mesh, *others = ((TITLES[key], figure.panels[key]) for key in PANELS)
    pair = slider_pair(figure.name, (below, photo[1]), mesh)
    beside = "".join(f'<div class="difference">{jpeg_image(*panel)}</div>' for panel in others)
    what = f"right or below: {TITLES['views']}, then {TITLES['agreement']}"
    caption = f'{html.escape(figure.name)} <span class="quiet">(drag or use the arrow keys; {what})</span>'
    return f"<figure><div>{pair}{beside}</div><figcaption>{caption}</figcaption></figure>\n"


def _facts(record: Mapping[str, Any]) -> dict[str, str]:
    """Name the entries of a record that are there."""
    unit = f" {_text(record.get('unit')) or 'world units'}"
    few = _count(record.get("few_views")) or "several"
    facts = {
        "file": _text(record.get("file")),
        "scene": _joined("after ", _count(record.get("iterations")), " iterations"),
        "triangles": _count(record.get("triangles")),
        "vertices": _count(record.get("vertices")),
        "convex parts": _count(record.get("convex_parts")),
        "empty space in the parts": _joined("", _percent(record.get("filled")), " of their volume"),
        "volume that the parts leave out": _joined("", _percent(record.get("uncovered")), " of the mesh's"),
        "farthest vertex outside of the parts": _joined("", _number(record.get("outside")), unit),
        "size": _joined("", _size(record.get("size")), unit),
        "area": _joined("", _number(record.get("area")), f"{unit}, squared"),
        "voxel": _joined("", _number(record.get("voxel")), unit),
        "memory of the volume": _memory(record.get("volume_bytes")),
        f"area seen by {few} views or more": _percent(record.get("certain")),
        "distance of its depth maps": _joined("", _number(record.get("spread")), f"{unit} on average"),
        "splats' depths from held-out views within a voxel": _held_out(record.get("held_out")),
        "points where held-out photos agree": _photos(record.get("photos")),
        "connected parts": _count(record.get("parts")),
        "holes": _holes(record),
        "triangles that pass through others": _intersecting(record.get("intersections")),
        **_truth(record.get("truth"), unit),
    }
    return {name: said for name, said in facts.items() if said}


def _held_out(found: object) -> str:
    if not isinstance(found, Mapping):
        return ""
    return _joined("", _percent(found.get("within")), f", of {_count(found.get('views'))} views; not photos")


def _photos(found: object) -> str:
    if not isinstance(found, Mapping):
        return ""
    points, textured, views = (_count(found.get(name)) for name in ("points", "textured", "views"))
    if not points or not textured or not views:
        return ""
    of = f"{textured} of {points} points in {views} photos have enough texture to judge"
    agreeing, share = found.get("agreeing"), found.get("share")
    if share is None or not _is_number(agreeing):
        return f"too little texture: {of}"
    return f"{_percent(share)}; {of}. Elsewhere the surface is wrong, shiny or hidden"


def _holes(record: Mapping[str, Any]) -> str:
    edges, loops = record.get("boundary_edges"), _count(record.get("holes"))
    if edges == 0:
        return "none: it is closed"
    return _joined(f"{loops}, open along " if loops else "open along ", _count(edges), " edges")


def _intersecting(found: object) -> str:
    if not isinstance(found, Mapping):
        return ""
    tested, faces = found.get("tested"), found.get("faces")
    return _joined(
        "", _count(found.get("found")), "" if tested == faces else f", of {_count(tested)} that were tested"
    )


def _truth(found: object, unit: str) -> dict[str, str]:
    if not isinstance(found, Mapping):
        return {}
    within = _joined(" within ", _number(found.get("tau")), unit)
    return {
        "truth that the cameras see": _joined("", _percent(found.get("counted")), ""),
        "accuracy (distance to the truth)": _joined("", _number(found.get("accuracy")), unit),
        "completeness (distance from the truth that they see)": _joined(
            "", _number(found.get("completeness")), unit
        ),
        "precision": _joined("", _number(found.get("precision")), within),
        "recall (of the truth that they see)": _joined("", _number(found.get("recall")), within),
        "F1": _joined("", _number(found.get("f1")), within),
        "angle of normals to the truth's": _joined("", _number(found.get("normal_degrees")), " degrees"),
    }


def _joined(before: str, value: str, after: str) -> str:
    """Put words around a value; nothing if there is no value."""
    return f"{before}{value}{after}" if value else ""


def _text(value: object) -> str:
    return value if isinstance(value, str) else ""


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _count(value: object) -> str:
    return f"{value:,}" if isinstance(value, int) and not isinstance(value, bool) else ""


def _number(value: Any) -> str:  # noqa: ANN401
    return short_number(float(value), 3) if _is_number(value) else ""


def _percent(value: Any) -> str:  # noqa: ANN401
    return f"{short_number(100.0 * float(value), 3)} %" if _is_number(value) else ""


def _memory(value: Any) -> str:  # noqa: ANN401
    return spelled_bytes(float(value)) if _is_number(value) else ""


def _size(value: object) -> str:
    if not isinstance(value, list) or len(value) != 3 or not all(map(_is_number, value)):
        return ""
    return " x ".join(map(_number, value))
