"""Pieces of HTML that the sections of a report share. Their styles are those of `gsplat_edu.evaluate.report`."""

from __future__ import annotations

import base64
import html
from collections.abc import Mapping, Sequence
from dataclasses import dataclass


@dataclass(frozen=True)
class Section:
    """A section of a report.

    Args:
        heading: Its heading.
        sentences: Text, as a list.
        figures: HTML of its pictures, made by functions of `gsplat_edu.evaluate`.
    """

    heading: str
    sentences: Sequence[str] = ()
    figures: str = ""


def section(title: str, body: str) -> str:
    """Return a heading and a body; nothing if the body is empty.

    Args:
        title: Text of the heading.
        body: HTML.
    """
    return f"<h2>{html.escape(title)}</h2>\n{body}" if body else ""


def folded(summary: str, body: str) -> str:
    """Return a body that opens on a click; nothing if the body is empty.

    Args:
        summary: Text that stays visible.
        body: HTML.
    """
    return f"<details><summary>{html.escape(summary)}</summary>\n{body}</details>\n" if body else ""


def scrolling(table: str) -> str:
    """Wrap a table, HTML, so that it scrolls on its own where it is wider than the screen."""
    return f'<div class="table">{table}</div>\n'


def bullets(sentences: Sequence[str]) -> str:
    """Return sentences, text, as a list; nothing if there are none."""
    items = "".join(f"<li>{html.escape(sentence)}</li>" for sentence in sentences)
    return f"<ul>{items}</ul>\n" if items else ""


def facts_table(facts: Mapping[str, str]) -> str:
    """Return a table of names and values, both text; nothing if there are none."""
    rows = "".join(f"<tr><th>{html.escape(k)}</th><td>{html.escape(v)}</td></tr>" for k, v in facts.items())
    return scrolling(f"<table><tbody>{rows}</tbody></table>") if rows else ""


def jpeg_image(title: str, data: bytes) -> str:
    """Return a JPEG as an image inside the page.

    Args:
        title: Text that replaces the image where it cannot be seen.
        data: The bytes of the JPEG.
    """
    source = base64.b64encode(data).decode("ascii")
    return f'<img alt="{html.escape(title)}" src="data:image/jpeg;base64,{source}">'


def slider_pair(name: str, left: tuple[str, bytes], right: tuple[str, bytes]) -> str:
    """Lay one JPEG over another of the same size, with a slider that moves the line between them.

    Args:
        name: What both show, text.
        left: Title and bytes of the JPEG that shows to the left of the line.
        right: The same of the one to its right.
    """
    said = f"{name}: {left[0]} on the left, {right[0]} on the right"
    return (
        f'<div class="pair">{jpeg_image(*left)}{jpeg_image(*right)}'
        f'<span class="left">{html.escape(left[0])}</span><span class="right">{html.escape(right[0])}</span>'
        f'<input type="range" min="0" max="100" value="50" aria-label="{html.escape(said)}"></div>'
    )
