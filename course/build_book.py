"""Build the course as a book: an EPUB, and a PDF if Chromium is there to print it.

    python course/build_book.py [--out out/book]

The book has the chapters with their figures, the glossary, the bibliography and an index: the words of the glossary
with the chapters that use them. Links that lead out of the book to files of the repository become plain text. A warning
from the generator stops the build with exit code 1.
"""

from __future__ import annotations

import argparse
import json
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

from build_site import LINK, ROOT, write

NAME = "gsplat_edu"
TITLE = "Gaussian splatting, from a point to a scene of your photos"
FRONT = ("notebooks/README.md",)
BACK = ("docs/GLOSSARY.md", "docs/BIBLIOGRAPHY.md")
CHAPTERS = tuple(f"notebooks/{path.name}" for path in sorted((ROOT / "notebooks").glob("*.ipynb")))
PAGES = (*FRONT, *CHAPTERS, *BACK)

SETTINGS = f"""
html_static_path, html_css_files, html_title = [], [], {TITLE!r}
html_theme = "basic"
html_sidebars = {{}}
epub_basename, epub_title, epub_author = {NAME!r}, {TITLE!r}, copyright
epub_show_urls, epub_identifier, epub_scheme, version = "no", {NAME!r}, "ID", "1"
epub_css_files = html_css_files = ["book.css"]
html_static_path = ["style"]
suppress_warnings = ["epub.unknown_project_files"]
"""
"""Of Sphinx, added to those of the site."""

STYLE = """
body { font-family: serif; max-width: 46em; margin: auto; line-height: 1.45; }
img { max-width: 100%; }
pre { white-space: pre-wrap; font-size: 80%; border-left: 2px solid #999; padding-left: .6em; }
table { border-collapse: collapse; } td, th { border: 1px solid #bbb; padding: .15em .5em; }
.headerlink, .related, .footer, .sphinxsidebar { display: none; }
span[id^="document-"] + section, section > span[id^="document-"] ~ section { break-before: page; }
@page { size: A4; margin: 18mm; }
"""


def within(text: str, page: str) -> str:
    """Keep a page's links to pages of the book and to the web; make others plain text.

    Args:
        text: Markdown.
        page: The page, relative to the repository.
    """

    def kept(match: re.Match[str]) -> str:
        whole, words, target = match[0], match[1], match[2]
        if "://" in target or target.startswith(("data:", "#")):
            return whole
        found = (ROOT / page).parent / target.partition("#")[0]
        return whole if str(found.resolve().relative_to(ROOT)) in PAGES else words

    return re.sub(r"(?<!!)\[([^\]]+)\]\(([^)\s]+)\)", kept, text)


def index() -> str:
    """Return the index as Markdown: each word of the glossary, and the chapters that link to it."""
    used: dict[str, list[str]] = {}
    for page in CHAPTERS:
        cells = json.loads((ROOT / page).read_text(encoding="utf-8"))["cells"]
        prose = "".join("".join(cell["source"]) for cell in cells if cell["cell_type"] == "markdown")
        for link in {f"{match[2]}{match[3]}" for match in LINK.finditer(prose) if match[3]}:
            if link.startswith("../docs/GLOSSARY.md#"):
                used.setdefault(link.partition("#")[2], []).append(page)
    rows = []
    for word in re.findall(r"^## (.+)$", (ROOT / "docs" / "GLOSSARY.md").read_text(encoding="utf-8"), re.M):
        anchor = re.sub(r"[^\w -]", "", word.lower()).replace(" ", "-")
        chapters = ", ".join(f"[{Path(page).name[:2]}]({page})" for page in used.get(anchor, []))
        rows.append(f"- [{word}](docs/GLOSSARY.md#{anchor})" + (f": {chapters}" if chapters else ""))
    return "# Index\n\n" + "\n".join(rows) + "\n"


def gather(stage: Path) -> None:
    """Write all pages and the settings to an empty folder."""
    for page in PAGES:
        text = (ROOT / page).read_text(encoding="utf-8")
        if page.endswith(".ipynb"):
            notebook = json.loads(text)
            for cell in notebook["cells"]:
                if cell["cell_type"] == "markdown":
                    cell["source"] = within("".join(cell["source"]), page)
            text = json.dumps(notebook)
        else:
            text = within(text, page).replace("<details>", '<details open="open">')  # paper has no clicks
        write(stage / page, text)
    write(stage / "terms.md", index())
    contents = "\n".join([*(page.rpartition(".")[0] for page in PAGES), "terms"])
    write(stage / "index.md", f"# {TITLE}\n\n```{{toctree}}\n:maxdepth: 1\n\n{contents}\n```\n")
    settings = (ROOT / "docs" / "site" / "conf.py").read_text(encoding="utf-8")
    write(stage / "conf.py", settings + SETTINGS)
    write(stage / "style" / "book.css", STYLE)


def generated(builder: str, scratch: Path) -> Path | None:
    """Run Sphinx on the gathered pages; return the folder that it made, None if it warned."""
    made = scratch / builder
    options = ["-b", builder, "-q", "-W", "--keep-going", "-d", str(scratch / "trees")]
    command = [sys.executable, "-m", "sphinx", *options, str(scratch / "source"), str(made)]
    return None if subprocess.run(command, check=False).returncode else made


def printed(page: Path, out: Path) -> bool:
    """Print a page as PDF by Chromium; return whether it did."""
    chromium = shutil.which("chromium")
    if chromium is None:
        print("build_book.py: no PDF, because chromium is not installed")
        return False
    flags = [
        "--headless",
        "--no-sandbox",
        "--disable-gpu",
        "--no-pdf-header-footer",
        "--virtual-time-budget=60000",
    ]
    command = [chromium, *flags, f"--print-to-pdf={out}", page.as_uri()]
    return subprocess.run(command, check=False, capture_output=True).returncode == 0 and out.exists()


def main(words: Sequence[str] | None = None) -> int:
    """Build the book; return 1 if the generator warned or Chromium failed.

    Args:
        words: The command's arguments; None takes those of this process.
    """
    parser = argparse.ArgumentParser(description="Build the course as EPUB and PDF.")
    parser.add_argument("--out", type=Path, default=ROOT / "out" / "book", help="folder (default: out/book)")
    out = parser.parse_args(words).out.resolve()
    with tempfile.TemporaryDirectory() as folder:
        scratch = Path(folder)
        gather(scratch / "source")
        made = [generated(builder, scratch) for builder in ("epub", "singlehtml")]
        if None in made:
            print(
                "build_book.py: the book was not written; the lines above name the problems", file=sys.stderr
            )
            return 1
        epub, page = made
        out.mkdir(parents=True, exist_ok=True)
        pdf = scratch / f"{NAME}.pdf"
        if shutil.which("chromium") and not printed(page / "index.html", pdf):
            print("build_book.py: chromium did not print the PDF", file=sys.stderr)
            return 1
        for path in (epub / f"{NAME}.epub", pdf):
            if path.exists():
                aside = out / f".{path.name}"
                shutil.copyfile(path, aside)
                aside.replace(out / path.name)
                print(f"book: {out / path.name}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
