"""Figures of the blocks of a merged run for its report: cells on the ground, and a table with their scores."""

from __future__ import annotations

import html
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from gsplat_edu.evaluate.metrics import ImageScore

INCHES = 6.0
"""Longer side of the figure."""

HEAD = (
    "block",
    "training views",
    "held-out views",
    "PSNR (dB)",
    "SSIM",
    "Gaussians",
    "before merging",
    "training (s)",
)


def cells_figure(blocks: Mapping[str, Any], scores: Sequence[ImageScore]) -> Figure:
    """Draw the cells from above, coloured by the mean PSNR of the held-out views that look at them, and the cameras.

    Args:
        blocks: The entry "blocks" of metrics.json.
        scores: Scores of the held-out views.
    """
    low, high = (np.array(blocks[name], dtype=np.float64) for name in ("low", "high"))
    sides = np.maximum(high - low, 1e-9)
    shape = INCHES * sides / sides.max()
    figure = Figure(figsize=(max(shape[0], 2.5) + 1.2, max(shape[1], 2.0) + 0.9), layout="constrained")
    axes = figure.add_subplot(title="The cells from above, and the cameras", aspect="equal")
    means = [_mean(cell, scores, "psnr") for cell in blocks["cells"]]
    known = [mean for mean in means if mean is not None]
    least, most = (min(known), max(known)) if known else (0.0, 1.0)
    for number, (cell, mean) in enumerate(zip(blocks["cells"], means, strict=True)):
        corner = [max(a, b) if a is not None else b for a, b in zip(cell["low"], low.tolist(), strict=True)]
        end = [min(a, b) if a is not None else b for a, b in zip(cell["high"], high.tolist(), strict=True)]
        place = 0.5 if mean is None or most == least else (mean - least) / (most - least)
        color = "#dddddd" if mean is None else (0.95 - 0.55 * place, 0.75 + 0.1 * place, 0.6 + 0.1 * place)
        size = [b - a for a, b in zip(corner, end, strict=True)]
        axes.add_patch(
            Rectangle((corner[0], corner[1]), *size, facecolor=color, edgecolor="black", linewidth=1.2)
        )
        said = f"{number}" if mean is None else f"{number}\n{mean:.2f} dB"
        axes.text(
            corner[0] + size[0] / 2, corner[1] + size[1] / 2, said, ha="center", va="center", fontsize=9
        )
    places = np.array(blocks.get("cameras") or np.zeros((0, 2)), dtype=np.float64).reshape(-1, 2)
    axes.plot(places[:, 0], places[:, 1], ".", color="#224488", markersize=2)
    axes.set(xlabel="a (world units)", ylabel="b (world units)")
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]))
    return figure


def blocks_table(blocks: Mapping[str, Any], seams: object, scores: Sequence[ImageScore]) -> str:
    """Return a table of the blocks, and a sentence on the cuts between them, as HTML.

    Args:
        blocks: The entry "blocks" of metrics.json.
        seams: The entry "seams"; None if there is no cut or no held-out view.
        scores: Scores of the held-out views.
    """
    head = "".join(f'<th class="n">{title}</th>' for title in HEAD)
    rows = []
    for number, cell in enumerate(blocks["cells"]):
        values = [
            str(number),
            f"{cell['train_views']:,}",
            f"{len(cell['test_views']):,}",
            _text(_mean(cell, scores, "psnr"), 2),
            _text(_mean(cell, scores, "ssim"), 4),
            f"{cell['gaussians']:,}",
            f"{cell['trained']:,}",
            f"{cell['seconds']:,.0f}",
        ]
        rows.append("".join(f'<td class="n">{html.escape(value)}</td>' for value in values))
    body = "".join(f"<tr>{row}</tr>" for row in rows)
    text = (
        "Each held-out view counts for the block that covers most of its image; the scores are those of the merged"
        " scene."
    )
    if isinstance(seams, Mapping) and isinstance(seams.get("psnr"), int | float):
        rest = seams.get("psnr_elsewhere")
        text += (
            f" Along the cuts, in strips {seams['width']:.3g} units wide, the held-out views reach"
            f" {seams['psnr']:.2f} dB; elsewhere {_text(rest, 2)} dB (PSNR of all pixels together)."
        )
    return (
        f'<div class="table"><table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table></div>\n'
        f'<p class="quiet">{html.escape(text)}</p>\n'
    )


def _mean(cell: Mapping[str, Any], scores: Sequence[ImageScore], key: str) -> float | None:
    names = frozenset(cell["test_views"])
    values = [getattr(score, key) for score in scores if score.name in names]
    return float(np.mean(values)) if values else None


def _text(value: object, digits: int) -> str:
    return f"{value:.{digits}f}" if isinstance(value, int | float) else "none"
