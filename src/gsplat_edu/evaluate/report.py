"""A training run's report: one self-contained HTML file."""

from __future__ import annotations

import html
import json
import math
import os
import platform
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np
import torch
from jaxtyping import UInt8

from gsplat_edu.base.content_policy import content_policy, policy_element
from gsplat_edu.base.files import written_aside
from gsplat_edu.base.reading import stored_path
from gsplat_edu.base.styles import sheet
from gsplat_edu.base.text import write_text
from gsplat_edu.evaluate.block_figures import blocks_table, cells_figure
from gsplat_edu.evaluate.figures import run_curve_figures, svg_element
from gsplat_edu.evaluate.images import small_jpeg
from gsplat_edu.evaluate.mesh_report import MeshEntry, mesh_section
from gsplat_edu.evaluate.metrics import ImageScore, best, worst
from gsplat_edu.evaluate.report_parts import (
    Section,
    bullets,
    facts_table,
    folded,
    jpeg_image,
    scrolling,
    section,
    slider_pair,
)
from gsplat_edu.evaluate.verdict import FULL_LENGTH, Verdict, mean_of, skipped_views, verdict

PICTURES = 7
"""Most test views shown in a report below the one that it opens with."""

SCORES = (
    ("psnr", "PSNR (dB)"),
    ("psnr_8bit", "PSNR, 8-bit (dB)"),
    ("ssim", "SSIM"),
    ("l1", "L1"),
    ("psnr_fitted", "PSNR, colours fitted (dB)"),
)

SHOWN = 0.95
"""Brighten the picture of a difference only as far as this quantile stays below white."""

NAMES = {
    "num_gaussians": "Gaussians",
    "seconds": "training time",
    FULL_LENGTH: "iterations without a time limit",
    "psnr_aligned": "test PSNR on half of each photo, pose (and colours, if corrected) fitted on the other (dB)",
}
"""Labels for the keys of metrics.json that are not plain English."""

STYLE = (
    sheet("page", "code", "table", "banner")
    + """
body { max-width: 1080px; margin: 0 auto; padding: var(--space-24) var(--space-16) var(--space-48); }
h1 { margin-bottom: var(--space-16); } h2 { margin: var(--space-32) 0 var(--space-8); }
p, ul { margin: var(--space-8) 0; }
figure { margin: var(--space-24) 0; } figure > div { display: flex; flex-wrap: wrap; gap: var(--space-4); }
.opening { display: grid; gap: var(--space-16) var(--space-24); grid-template-columns: minmax(0, 1fr); }
.opening { align-items: start; }
.opening > figure, .opening .banner { margin: 0; } .opening .banner { font-size: var(--type-20); line-height: 1.4; }
@media (min-width: 900px) { .opening:has(> figure) { grid-template-columns: minmax(0, 3fr) minmax(0, 2fr); } }
figure .pair, figure .difference { flex: 1 1 320px; min-width: 0; }
figure img { display: block; width: 100%; border-radius: var(--radius-8); }
.pair { position: relative; align-self: flex-start; --at: 50%; }
.pair img + img { position: absolute; inset: 0; clip-path: inset(0 0 0 var(--at)); }
.pair::after { content: ""; position: absolute; top: 0; bottom: 0; left: var(--at); width: 2px; margin-left: -1px;
  background: var(--on-glass); box-shadow: 0 0 3px var(--halo); pointer-events: none; }
.pair span { position: absolute; top: var(--space-8); padding: 0 var(--space-8); font-size: var(--type-12);
  color: var(--on-glass); background: var(--glass); border-radius: var(--radius-8); pointer-events: none; }
.pair .left { left: var(--space-8); } .pair .right { right: var(--space-8); }
.pair input { position: absolute; inset: 0; width: 100%; height: 100%; margin: 0; opacity: 0; cursor: ew-resize;
  touch-action: pan-y; }
.pair:focus-within { outline: 3px solid var(--focus); outline-offset: 2px; }
.curves { display: grid; gap: var(--space-8); grid-template-columns: repeat(auto-fill, minmax(min(100%, 400px), 1fr)); }
.curves svg { width: 100%; height: auto; } figcaption { font-size: var(--type-14); margin-top: var(--space-4); }
/* black lines on white become light ones on the ground */
@media (prefers-color-scheme: dark) { svg { filter: invert(.92) hue-rotate(180deg); } }
@media (max-width: 600px) { th, td { padding-right: var(--space-8); } }
"""
)

SCRIPT = """
for (const slider of document.querySelectorAll(".pair input")) {
  const move = () => slider.parentElement.style.setProperty("--at", `${slider.value}%`);
  slider.addEventListener("input", move);
  move();
}
"""
"""Moves the line between photo and render. Without scripts, a page shows half of each."""


def machine_facts() -> dict[str, str]:
    """Return the processor, number of threads, and software versions of this machine."""
    return {
        "processor": _processor(),
        "threads": str(torch.get_num_threads()),
        "system": platform.platform(terse=True),
        "Python": platform.python_version(),
        "torch": torch.__version__,
        "NumPy": np.__version__,
    }


def _processor() -> str:
    info = Path("/proc/cpuinfo")
    if info.is_file():
        for line in info.read_text("utf-8", errors="replace").splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()


@dataclass(frozen=True)
class Picture:
    """A test view as a report shows it: render, photo and their difference, as JPEG.

    Args:
        name: The view's name in the capture.
        panels: Title and bytes of each JPEG.
    """

    name: str
    panels: tuple[tuple[str, bytes], ...]

    @classmethod
    def of(cls, name: str, render: UInt8[np.ndarray, "H W 3"], truth: UInt8[np.ndarray, "H W 3"]) -> Picture:
        """Make the picture of a view, shrunk to 640 px and compressed so that hundreds fit into memory.

        The difference is brightened by the largest factor among 1, 2, 4, 8 and 16 that keeps 95 % of it below white;
        without this, the difference of a good render looks black.

        Args:
            name: The view's name in the capture.
            render: (H, W, 3) rendered.
            truth: (H, W, 3) photo.
        """
        difference = np.abs(render.astype(np.int16) - truth.astype(np.int16))
        high = float(np.quantile(difference, SHOWN)) if difference.size else 0.0
        times = next((k for k in (16, 8, 4, 2) if k * high <= 255.0), 1)
        bright = np.minimum(times * difference, 255).astype(np.uint8)
        title = "difference" if times == 1 else f"difference, {times}x amplified"
        panels = (("render", render), ("photo", truth), (title, bright))
        return cls(name, tuple((title, small_jpeg(panel)) for title, panel in panels))


@dataclass(frozen=True)
class Report:
    """The contents of a report.

    Args:
        title: The heading.
        metrics: The contents of metrics.json: "test" and "train" from `gsplat_edu.evaluate.metrics.summarize`, single
            numbers, and "exports" for files in other formats.
        log: Entries of the log: `iteration`, and any of loss, psnr (of an evaluation), num_gaussians, ms.
        config: The run's configuration.
        scores: Scores of the test views.
        pictures: Pictures of test views. The one with the median PSNR opens the report; at most 7 others
            are shown, the best and the worst among them.
        notes: Notes for the reader, one sentence each.
        meshes: What is known of the meshes of the scene.
        sections: The sections of the training's parts.
        machine: Facts about the machine; by default, this one.
    """

    title: str
    metrics: Mapping[str, Any]
    log: Sequence[Mapping[str, Any]] = ()
    config: Mapping[str, Any] = field(default_factory=dict)
    scores: Sequence[ImageScore] = ()
    pictures: Sequence[Picture] = ()
    notes: Sequence[str] = ()
    meshes: Sequence[MeshEntry] = ()
    sections: Sequence[Section] = ()
    machine: Mapping[str, str] = field(default_factory=machine_facts)


def _cap(config: Mapping[str, Any]) -> int | None:
    """Return the cap on the number of Gaussians that a config.json states; None if it states none."""
    settings = config.get("train")
    cap = settings.get("max_gaussians") if isinstance(settings, Mapping) else None
    return cap if isinstance(cap, int) else None


def write_report(path: Path, report: Report) -> None:
    """Write a report as one HTML file with images, curves and a small script inside; it loads nothing from the network.

    Args:
        path: Output file; parent folders are created.
        report: Its contents.

    Raises:
        OSError: the file cannot be written. An existing file stays unchanged.
    """
    figures = run_curve_figures(_with_last(report.log, report.metrics), _cap(report.config))
    curves = "".join(svg_element(figure, str(number)) for number, figure in enumerate(figures))
    cells = _cells(report)
    config = {key: value for key, value in report.config.items() if key != "machine"}
    typical = _typical(report.pictures, report.scores)
    others = [picture for picture in report.pictures if picture is not typical]
    sections = [
        _opening(verdict(report.metrics, report.config), typical, report.scores),
        _how_to_score(path, report.metrics),
        _page_link(path, report.metrics.get("exports")),
        _headline(report.metrics),
        section("Curves", f'<div class="curves">{curves}</div>\n' if curves else ""),
        section("Blocks", cells),
        _views(report.scores, others, skipped_views(report.metrics)),
        *(section(part.heading, f"{bullets(part.sentences)}{part.figures}") for part in report.sections),
        mesh_section(report.meshes),
        _exports(report.metrics.get("exports")),
        section("Notes", bullets(report.notes)),
        section("Configuration", folded("all settings of this run", facts_table(_flat(config)))),
        *_machines(report),
    ]
    title = html.escape(report.title)
    policy = policy_element(content_policy(scripts=[SCRIPT], styles=[STYLE], markup=curves + cells))
    page = (
        f'<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n{policy}\n<title>{title}</title>\n'
        f'<meta name="viewport" content="width=device-width">\n<style>{STYLE}</style>\n</head>\n<body>\n'
        f"<h1>{title}</h1>\n{''.join(sections)}<script>{SCRIPT}</script>\n</body>\n</html>\n"
    )
    with written_aside(path) as aside:
        write_text(aside, page)


def _typical(pictures: Sequence[Picture], scores: Sequence[ImageScore]) -> Picture | None:
    """Return the picture with the median PSNR; None if there are none."""
    psnr = {score.name: score.psnr for score in scores}
    ranked = sorted(pictures, key=lambda picture: psnr.get(picture.name, 0.0))
    return ranked[len(ranked) // 2] if ranked else None


def _opening(found: Verdict, picture: Picture | None, scores: Sequence[ImageScore]) -> str:
    """Show a typical view, photo against render, and say how good the scene is; the figures are folded."""
    said = f'<p class="verdict {found.grade.lower()} banner">{html.escape(str(found))}</p>\n'
    details = f"<p>{html.escape(found.details)}</p>\n" if found.details else ""
    shown = ""
    if picture is not None:
        (render, below), (photo, above), (difference, apart) = picture.panels
        shown = f"<figure><div>{slider_pair(picture.name, (photo, above), (render, below))}</div></figure>\n"
        caption = f'{_scored(picture, scores)} <span class="quiet">(above: {difference})</span>'
        details += f"<figure>{jpeg_image(difference, apart)}<figcaption>{caption}</figcaption></figure>\n"
    return f'<div class="opening">\n{shown}<div>\n{said}{folded("Details", details)}</div>\n</div>\n'


def _cells(report: Report) -> str:
    """Draw the blocks of a merged run, and list their scores."""
    blocks = report.metrics.get("blocks")
    if not isinstance(blocks, Mapping):
        return ""
    drawing = svg_element(cells_figure(blocks, report.scores), "cells")
    return f"<div>{drawing}</div>\n{blocks_table(blocks, report.metrics.get('seams'), report.scores)}"


def _how_to_score(report: Path, metrics: Mapping[str, Any]) -> str:
    """Show the command that scores a run which was not scored."""
    if not skipped_views(metrics):
        return ""
    command = shlex.join(["gsplat-edu", "eval", str(report.parent.absolute())])
    return f"<p>To score the photos: <code>{html.escape(command)}</code></p>\n"


def _with_last(log: Sequence[Mapping[str, Any]], metrics: Mapping[str, Any]) -> list[Mapping[str, Any]]:
    """Append the final evaluation, which only the metrics contain, to the log."""
    test, steps = mean_of(metrics, "test", "psnr"), metrics.get("iterations")
    lines = [line for line in log if "psnr" not in line or line.get("iteration") != steps]
    final = [] if test is None or not isinstance(steps, int) else [{"iteration": steps, "psnr": test}]
    return [*lines, *final]


def _page_link(report: Path, exports: object) -> str:
    """Link to the page that shows the scene, or show the command that makes one."""
    folder = report.parent.absolute()
    entries = exports if isinstance(exports, list) else []
    named = [stored_path(entry.get("path")) for entry in entries if isinstance(entry, Mapping)]
    pages = [path for path in named if path is not None and path.suffix == ".html"] + [folder / "page.html"]
    for page in pages:
        if page.is_file() and page.absolute() != report.absolute():
            place = quote(Path(os.path.relpath(page.absolute(), folder)).as_posix())
            return f'<p><a href="{html.escape(place)}">View the scene in the browser</a></p>\n'
    command = shlex.join(["gsplat-edu", "convert", str(folder), str(folder / "page.html")])
    return f"<p>To view the scene in the browser, make a page: <code>{html.escape(command)}</code></p>\n"


def _machines(report: Report) -> list[str]:
    """Show the machine; if training and evaluation ran on different machines, show both."""
    trained = report.config.get("machine")
    trained = {key: _plain(value) for key, value in trained.items()} if isinstance(trained, Mapping) else {}
    if not trained or trained == dict(report.machine):
        return [section("Machine", facts_table(report.machine))]
    return [
        section("Training machine", facts_table(trained)),
        section("Evaluation machine", facts_table(report.machine)),
    ]


def _headline(metrics: Mapping[str, Any]) -> str:
    splits = [(name, metrics[name]) for name in ("test", "train") if isinstance(metrics.get(name), Mapping)]
    head = "".join(f'<th class="n">{label}</th>' for label in ("images", *(label for _, label in SCORES)))
    rows = []
    for name, means in splits:
        cells = [
            html.escape(str(means.get("num_images"))),
            *(_score(key, means.get(key)) for key, _ in SCORES),
        ]
        rows.append(f"<tr><th>{name}</th>{_numbers(cells)}</tr>")
    table = scrolling(f"<table><thead><tr><th></th>{head}</tr></thead><tbody>{''.join(rows)}</tbody></table>")
    singles = {
        NAMES.get(key, key.replace("_", " ")): _single(key, value)
        for key, value in metrics.items()
        if not isinstance(value, Mapping | list)
    }
    how = (
        "Each value is the mean over the images. PSNR compares the render, clamped to 0..1, with the photo's bytes; "
        "8-bit PSNR rounds the render to bytes first. SSIM uses a Gaussian window of 11 taps, sigma 1.5. "
        "A held-out photo may be brighter or darker than the scene: the last column covers its right half, after one "
        "gain per colour channel was fitted on its left half."
    )
    return section("Result", f'{table if rows else ""}<p class="quiet">{how}</p>\n{facts_table(singles)}')


def _exports(exports: object) -> str:
    """List the files in other formats: size, and PSNR of their renders against those of the scene."""
    if not isinstance(exports, list) or not all(isinstance(entry, Mapping) for entry in exports):
        return ""
    rows = []
    for entry in exports:
        cells = [_score("psnr", entry.get("psnr")), _score("psnr", entry.get("worst_psnr"))]
        cells += [html.escape(_plain(entry.get(key))) for key in ("worst_view", "num_views", "num_bytes")]
        rows.append(f"<tr><th>{html.escape(str(entry.get('path')))}</th>{_numbers(cells)}</tr>")
    titles = ("PSNR (dB)", "lowest (dB)", "worst view", "views", "bytes")
    head = "".join(f'<th class="n">{title}</th>' for title in titles)
    how = "Each file was read back and its renders were compared with the trained scene's. Equal renders have 100 dB."
    table = scrolling(f"<table><thead><tr><th></th>{head}</tr></thead><tbody>{''.join(rows)}</tbody></table>")
    return section("Exports", f'{table}<p class="quiet">{how}</p>\n' if rows else "")


def _numbers(cells: Sequence[str]) -> str:
    return "".join(f'<td class="n">{cell}</td>' for cell in cells)


def _views(scores: Sequence[ImageScore], pictures: Sequence[Picture], skipped: str) -> str:
    if not scores:
        why = f"Not scored: {skipped}." if skipped else "No view was held out for testing."
        return section("Test views", f'<p class="quiet">{why}</p>\n')
    high, low = best(scores), worst(scores)
    said = (
        f"<p>Best: {html.escape(high.name)} ({_score('psnr', high.psnr)} dB). "
        f"Worst: {html.escape(low.name)} ({_score('psnr', low.psnr)} dB).</p>\n"
    )
    figures = [_figure(picture, scores) for picture in _chosen(pictures, keep=(high.name, low.name))]
    head = "".join(f'<th class="n">{label}</th>' for _, label in SCORES)
    rows = "".join(
        f"<tr><td>{html.escape(score.name)}</td>"
        + _numbers([_score(key, getattr(score, key)) for key, _ in SCORES])
        + "</tr>"
        for score in scores
    )
    table = f"<table><thead><tr><th>view</th>{head}</tr></thead><tbody>{rows}</tbody></table>"
    return section("Test views", f"{said}{''.join(figures)}{folded('all views', scrolling(table))}")


def _chosen(pictures: Sequence[Picture], keep: Sequence[str]) -> list[Picture]:
    """Choose the pictures to show: the best, the worst, and others at even intervals."""
    kept = {next((i for i, p in enumerate(pictures) if p.name == name), None) for name in keep} - {None}
    rest = [i for i in range(len(pictures)) if i not in kept]
    places = np.linspace(0, len(rest) - 1, max(0, min(PICTURES - len(kept), len(rest))))
    chosen = kept | {rest[round(place)] for place in places}
    return [picture for i, picture in enumerate(pictures) if i in chosen]


def _figure(picture: Picture, scores: Sequence[ImageScore]) -> str:
    """Lay the photo over the render with a slider between them; put the difference beside them."""
    (render, below), (photo, above), (difference, apart) = picture.panels
    pair = slider_pair(picture.name, (photo, above), (render, below))
    beside = f'<div class="difference">{jpeg_image(difference, apart)}</div>'
    how = f"(drag or use the arrow keys; right or below: {difference})"
    caption = f'{_scored(picture, scores)} <span class="quiet">{how}</span>'
    return f"<figure><div>{pair}{beside}</div><figcaption>{caption}</figcaption></figure>\n"


def _scored(picture: Picture, scores: Sequence[ImageScore]) -> str:
    """Return the name of a view and its scores."""
    score = next((score for score in scores if score.name == picture.name), None)
    numbers = f": PSNR {_score('psnr', score.psnr)} dB, SSIM {_score('ssim', score.ssim)}" if score else ""
    return html.escape(picture.name) + numbers


def _flat(config: Mapping[str, Any], prefix: str = "") -> dict[str, str]:
    """Flatten nested sections into "section.key" and the value as text."""
    rows: dict[str, str] = {}
    for key, value in config.items():
        if isinstance(value, Mapping):
            rows |= _flat(value, f"{prefix}{key}.")
        else:
            rows[f"{prefix}{key}"] = _plain(value)
    return rows


def _plain(value: object) -> str:
    if isinstance(value, float):
        return f"{value:.6g}"
    return value if isinstance(value, str) else json.dumps(value, default=str, ensure_ascii=False)


def _single(key: str, value: object) -> str:
    """Format a number of metrics.json: thousands separators; a duration in hours, minutes and seconds."""
    if key == "seconds" and isinstance(value, int | float) and math.isfinite(value):
        minutes, seconds = divmod(value, 60)
        hours, minutes = divmod(int(minutes), 60)
        parts = [f"{hours} h"] * (hours > 0) + [f"{minutes} min"] * (hours + minutes > 0)
        return " ".join([*parts, f"{seconds:.0f} s" if parts else f"{seconds:.1f} s"])
    return f"{value:,}" if isinstance(value, int) and not isinstance(value, bool) else _plain(value)


def _score(key: str, value: object) -> str:
    """Format decibels with two decimals and other scores with four; an en dash if the score is missing."""
    if isinstance(value, int | float):
        return f"{value:.2f}" if key.startswith("psnr") else f"{value:.4f}"
    return "&ndash;"
