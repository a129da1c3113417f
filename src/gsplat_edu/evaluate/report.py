"""A run on one page: an HTML file that needs nothing but itself."""

from __future__ import annotations

import base64
import html
import io
import json
import platform
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import UInt8
from PIL import Image

from gsplat_edu.evaluate.figures import run_curves_figure, svg_element
from gsplat_edu.evaluate.metrics import ImageScore, best, worst
from gsplat_edu.files import written_aside
from gsplat_edu.text import write_text

PICTURES = 8
"""Test views that a report shows."""

PICTURE_SIDE = 640
"""px: pictures are shrunk until their longer side is this."""

JPEG_QUALITY = 88

SCORES = (("psnr", "PSNR (dB)"), ("psnr_8bit", "PSNR of 8 bits (dB)"), ("ssim", "SSIM"), ("l1", "L1"))

STYLE = """
:root { color-scheme: light; }
body { font: 15px/1.5 system-ui, sans-serif; color: #222; background: #fff; max-width: 1080px; margin: 2rem auto;
  padding: 0 1rem; }
h1 { font-size: 1.6rem; margin-bottom: 0; } h2 { font-size: 1.15rem; margin: 2rem 0 .5rem; }
table { border-collapse: collapse; } th, td { text-align: left; padding: .2rem 1rem .2rem 0; vertical-align: top; }
th { font-weight: 600; } thead th { border-bottom: 1px solid #bbb; } td.n, th.n { text-align: right; }
td { border-bottom: 1px solid #eee; overflow-wrap: anywhere; font-variant-numeric: tabular-nums; }
figure { margin: 1rem 0; } figure div { display: flex; gap: 4px; } figure img { flex: 1; min-width: 0; width: 33%; }
figcaption { font-size: .9rem; } svg { max-width: 100%; height: auto; } .quiet { color: #666; }
"""


def machine_facts() -> dict[str, str]:
    """Say what computed: the processor, the threads and the versions."""
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
        name: What the capture calls the view.
        panels: Title and bytes of each JPEG.
    """

    name: str
    panels: tuple[tuple[str, bytes], ...]

    @classmethod
    def of(cls, name: str, render: UInt8[np.ndarray, "H W 3"], truth: UInt8[np.ndarray, "H W 3"]) -> Picture:
        """Make the picture of a view; it is shrunk to 640 px and compressed, so that hundreds fit into memory.

        Args:
            name: What the capture calls the view.
            render: (H, W, 3) rendered.
            truth: (H, W, 3) photo.
        """
        difference = np.abs(render.astype(np.int16) - truth.astype(np.int16)).astype(np.uint8)
        panels = (("render", render), ("photo", truth), ("absolute difference", difference))
        return cls(name, tuple((title, _jpeg(panel)) for title, panel in panels))


@dataclass(frozen=True)
class Report:
    """What a report says.

    Args:
        title: Its heading.
        metrics: As metrics.json has them: "test" and "train" by `gsplat_edu.evaluate.metrics.summarize`, and
            single numbers beside them, and "exports", files in other formats.
        log: Lines of the log: `iteration`, and any of loss, psnr (of an evaluation), num_gaussians, ms.
        config: What decided the run.
        scores: Scores of the test views.
        pictures: Pictures of test views, of which at most 8 are shown; best and worst among them.
        notes: Sentences a reader should know.
        machine: Facts of the machine; those of this one by default.
    """

    title: str
    metrics: Mapping[str, Any]
    log: Sequence[Mapping[str, Any]] = ()
    config: Mapping[str, Any] = field(default_factory=dict)
    scores: Sequence[ImageScore] = ()
    pictures: Sequence[Picture] = ()
    notes: Sequence[str] = ()
    machine: Mapping[str, str] = field(default_factory=machine_facts)


def write_report(path: Path, report: Report) -> None:
    """Write a report as one HTML file: images and curves inside, no script, nothing from the network.

    Args:
        path: The file; parent folders are made.
        report: What it says.

    Raises:
        OSError: the file cannot be written. What stood there before is untouched.
    """
    curves = run_curves_figure(report.log)
    sections = [
        _headline(report.metrics),
        _section("Curves", svg_element(curves) if curves else ""),
        _views(report.scores, report.pictures),
        _exports(report.metrics.get("exports")),
        _section("Notes", _list(report.notes)),
        _section("Configuration", _facts(_flat(report.config))),
        _section("Machine", _facts(report.machine)),
    ]
    title = html.escape(report.title)
    page = (
        f'<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n<title>{title}</title>\n'
        f'<meta name="viewport" content="width=device-width">\n<style>{STYLE}</style>\n</head>\n<body>\n'
        f"<h1>{title}</h1>\n{''.join(sections)}</body>\n</html>\n"
    )
    with written_aside(path) as aside:
        write_text(aside, page)


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
    table = f"<table><thead><tr><th></th>{head}</tr></thead><tbody>{''.join(rows)}</tbody></table>\n"
    singles = {
        key.replace("_", " "): _plain(value)
        for key, value in metrics.items()
        if not isinstance(value, Mapping | list)
    }
    how = (
        "Means of the images' values. PSNR compares the render, clamped to 0..1, with the photo's bytes; "
        "SSIM has a Gaussian window of 11 taps, sigma 1.5."
    )
    return _section("Result", f'{table if rows else ""}<p class="quiet">{how}</p>\n{_facts(singles)}')


def _exports(exports: object) -> str:
    """Tell of files in other formats: size, and how their renders compare with those of the scene."""
    if not isinstance(exports, list) or not all(isinstance(entry, Mapping) for entry in exports):
        return ""
    rows = []
    for entry in exports:
        cells = [_score("psnr", entry.get("psnr")), _score("psnr", entry.get("worst_psnr"))]
        cells += [html.escape(_plain(entry.get(key))) for key in ("worst_view", "num_views", "num_bytes")]
        rows.append(f"<tr><th>{html.escape(str(entry.get('path')))}</th>{_numbers(cells)}</tr>")
    titles = ("PSNR (dB)", "lowest (dB)", "view of the lowest", "views", "bytes")
    head = "".join(f'<th class="n">{title}</th>' for title in titles)
    how = "Each file was read again, and its renders compared with those of the trained scene; equal ones have 100 dB."
    table = f"<table><thead><tr><th></th>{head}</tr></thead><tbody>{''.join(rows)}</tbody></table>\n"
    return _section("Exports", f'{table}<p class="quiet">{how}</p>\n' if rows else "")


def _numbers(cells: Sequence[str]) -> str:
    return "".join(f'<td class="n">{cell}</td>' for cell in cells)


def _views(scores: Sequence[ImageScore], pictures: Sequence[Picture]) -> str:
    if not scores:
        return _section("Test views", '<p class="quiet">No view was held out, so nothing was judged.</p>\n')
    high, low = best(scores), worst(scores)
    said = (
        f"<p>Best: {html.escape(high.name)} ({_score('psnr', high.psnr)} dB). "
        f"Worst: {html.escape(low.name)} ({_score('psnr', low.psnr)} dB).</p>\n"
    )
    by_name = {score.name: score for score in scores}
    figures = [
        _figure(picture, by_name.get(picture.name))
        for picture in _chosen(pictures, keep=(high.name, low.name))
    ]
    head = "".join(f'<th class="n">{label}</th>' for _, label in SCORES)
    rows = "".join(
        f"<tr><td>{html.escape(score.name)}</td>"
        + _numbers([_score(key, getattr(score, key)) for key, _ in SCORES])
        + "</tr>"
        for score in scores
    )
    table = f"<details><summary>Every view</summary><table><thead><tr><th>view</th>{head}</tr></thead>"
    return _section("Test views", f"{said}{''.join(figures)}{table}<tbody>{rows}</tbody></table></details>\n")


def _chosen(pictures: Sequence[Picture], keep: Sequence[str]) -> list[Picture]:
    """Choose the pictures that are shown: best and worst, and the rest spread evenly."""
    kept = {next((i for i, p in enumerate(pictures) if p.name == name), None) for name in keep} - {None}
    rest = [i for i in range(len(pictures)) if i not in kept]
    places = np.linspace(0, len(rest) - 1, max(0, min(PICTURES - len(kept), len(rest))))
    chosen = kept | {rest[round(place)] for place in places}
    return [picture for i, picture in enumerate(pictures) if i in chosen]


def _figure(picture: Picture, score: ImageScore | None) -> str:
    images = "".join(
        f'<img alt="{html.escape(title)}" title="{html.escape(title)}"'
        f' src="data:image/jpeg;base64,{base64.b64encode(data).decode("ascii")}">'
        for title, data in picture.panels
    )
    titles = ", ".join(title for title, _ in picture.panels)
    numbers = f": PSNR {_score('psnr', score.psnr)} dB, SSIM {_score('ssim', score.ssim)}" if score else ""
    caption = f'{html.escape(picture.name)}{numbers} <span class="quiet">({html.escape(titles)})</span>'
    return f"<figure><div>{images}</div><figcaption>{caption}</figcaption></figure>\n"


def _jpeg(image: UInt8[np.ndarray, "H W 3"]) -> bytes:
    picture = Image.fromarray(image)
    picture.thumbnail((PICTURE_SIDE, PICTURE_SIDE))
    buffer = io.BytesIO()
    picture.save(buffer, format="JPEG", quality=JPEG_QUALITY)
    return buffer.getvalue()


def _section(title: str, body: str) -> str:
    return f"<h2>{html.escape(title)}</h2>\n{body}" if body else ""


def _list(sentences: Sequence[str]) -> str:
    items = "".join(f"<li>{html.escape(sentence)}</li>" for sentence in sentences)
    return f"<ul>{items}</ul>\n" if items else ""


def _facts(facts: Mapping[str, str]) -> str:
    rows = "".join(f"<tr><th>{html.escape(k)}</th><td>{html.escape(v)}</td></tr>" for k, v in facts.items())
    return f"<table><tbody>{rows}</tbody></table>\n" if rows else ""


def _flat(config: Mapping[str, Any], prefix: str = "") -> dict[str, str]:
    """Turn nested sections into "section.key" and the text of the value."""
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


def _score(key: str, value: object) -> str:
    """Write decibels with two decimals, other scores with four; an en dash where there is none."""
    if isinstance(value, int | float):
        return f"{value:.2f}" if key.startswith("psnr") else f"{value:.4f}"
    return "&ndash;"
