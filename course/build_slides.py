"""Build slides of each chapter from its headings, first sentences, equations, predictions and figures.

    python course/build_slides.py [--out out/slides]

A chapter's slides are one HTML file that needs nothing else: arrow keys turn the pages, and printing makes a PDF.
"""

from __future__ import annotations

import argparse
import html
import json
import re
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from latex2mathml.converter import convert

from gsplat_edu.base.styles import tokens

ROOT = Path(__file__).resolve().parent.parent

PAGE = """<!doctype html>
<html lang="en">
<meta charset="utf-8">
<meta name="viewport" content="width=device-width">
<title>{title}</title>
<style>{style}</style>
{slides}
<script>{script}</script>
</html>
"""

STYLE = """
html { scroll-snap-type: y mandatory; background: var(--background); color: var(--text); }
body { margin: 0; font: 2.3vmin/1.4 var(--font); }
section { box-sizing: border-box; height: 100vh; padding: 6vmin 9vmin; }
section { scroll-snap-align: start; break-after: page; }
section { display: flex; flex-direction: column; justify-content: center; gap: 3vmin; }
h1 { font-size: 3.2em; margin: 0; } h2 { font-size: 2em; margin: 0; }
p { font-size: 1.6em; margin: 0; max-width: 50em; }
blockquote { margin: 0; padding-left: 1em; border-left: .3em solid var(--accent); }
img { max-width: 100%; max-height: 68vh; object-fit: contain; align-self: center; background: white; }
code { font-size: .9em; }
@page { size: A4 landscape; margin: 0; }
"""

SCRIPT = """
const slides = [...document.querySelectorAll("section")];
addEventListener("keydown", (event) => {
  const step = { ArrowRight: 1, ArrowDown: 1, PageDown: 1, " ": 1, ArrowLeft: -1, ArrowUp: -1, PageUp: -1 }[event.key];
  if (!step) return;
  event.preventDefault();
  const now = slides.findIndex((slide) => slide.getBoundingClientRect().bottom > 1);
  slides[Math.min(Math.max(now + step, 0), slides.length - 1)].scrollIntoView();
});
"""

SENTENCES = 2
"""Of a section's first paragraph that its slide shows."""


EQUATIONS = 2
"""Of a section that its slide shows."""


def shown(markdown: str) -> str:
    """Return a paragraph of Markdown as HTML: formulas, code, stress; links become their words."""
    pieces = re.split(r"(\$[^$]+\$|`[^`]+`)", re.sub(r"\[([^\]]+)\]\([^)]+\)", r"\1", markdown))
    made = []
    for piece in pieces:
        if piece.startswith("$"):
            made.append(convert(piece.strip("$")))
        elif piece.startswith("`"):
            made.append(f"<code>{html.escape(piece.strip('`'))}</code>")
        else:
            made.append(re.sub(r"\*{1,2}([^*]+)\*{1,2}", r"<em>\1</em>", html.escape(piece)))
    return "".join(made)


def opening(text: str) -> str:
    """Return the first sentences of the first paragraph; nothing if there is none."""
    paragraphs = [" ".join(part.split()) for part in text.split("\n\n") if part.strip()]
    plain = [part for part in paragraphs if not part.startswith(("$$", "|", "-", ">", "#", "<", "1."))]
    return " ".join(re.split(r"(?<=[a-z)$`][.?!:]) (?=[A-Z$`])", plain[0])[:SENTENCES]) if plain else ""


def equations(text: str) -> str:
    """Return the first displayed equations as MathML."""
    found = re.findall(r"\$\$(.+?)\$\$", text, flags=re.S)[:EQUATIONS]
    return "".join(f"\n<p>{convert(one.strip(), display='block')}</p>" for one in found)


def slides(notebook: dict[str, Any]) -> Iterator[str]:
    """Yield the contents of each slide of a chapter: a heading with its opening, a prediction, or a figure."""
    heading = ""
    for cell in notebook["cells"]:
        if cell["id"].startswith("exercise-"):
            return
        if cell["cell_type"] == "code":
            for output in cell["outputs"]:
                for kind in ("image/png", "image/jpeg"):
                    if data := output.get("data", {}).get(kind):
                        source = f"data:{kind};base64,{''.join(data).strip()}"
                        yield f'<h2>{shown(heading)}</h2>\n<img alt="" src="{source}">'
            continue
        text = "".join(cell["source"])
        for part in re.split(r"^(?=#{1,2} )", text, flags=re.M):
            title, _, rest = part.partition("\n") if part.startswith("#") else ("", "", part)
            if title:
                level = title.index(" ")
                heading = title[level:].strip()
                yield f"<h{level}>{shown(heading)}</h{level}>\n<p>{shown(opening(rest))}</p>{equations(rest)}"
            for asked in re.findall(r"^> \*\*Predict\.\*\* ((?:.|\n> )*)", rest, re.M):
                words = " ".join(asked.replace("\n> ", " ").split())
                yield f"<h2>{shown(heading)}</h2>\n<blockquote><p><em>Predict.</em> {shown(words)}</p></blockquote>"


def page(notebook: dict[str, Any]) -> str:
    """Return the HTML of a chapter's slides."""
    title = "".join(notebook["cells"][0]["source"]).splitlines()[0].removeprefix("# ")
    sections = "\n".join(f"<section>\n{slide}\n</section>" for slide in slides(notebook))
    return PAGE.format(title=html.escape(title), style=tokens() + STYLE, slides=sections, script=SCRIPT)


def main(words: Sequence[str] | None = None) -> int:
    """Build the slides of every chapter.

    Args:
        words: The command's arguments; None takes those of this process.
    """
    parser = argparse.ArgumentParser(description="Build slides of the chapters.")
    parser.add_argument(
        "--out", type=Path, default=ROOT / "out" / "slides", help="folder (default: out/slides)"
    )
    out = parser.parse_args(words).out
    out.mkdir(parents=True, exist_ok=True)
    for path in sorted((ROOT / "notebooks").glob("*.ipynb")):
        aside = out / f".{path.stem}.html"
        aside.write_text(page(json.loads(path.read_text(encoding="utf-8"))), encoding="utf-8")
        aside.replace(out / f"{path.stem}.html")
    print(f"slides: {out}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
