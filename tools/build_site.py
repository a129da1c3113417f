"""Build the site: chapters, documents and the reference of every module, as pages that open from disk.

    python tools/build_site.py [--out out/site]

The pages are gathered in the layout of the repository, so that their links hold; a link to a module leads to its page
of the reference. A warning of the generator stops the build with exit code 1. Notebooks are shown as they were built.
"""

from __future__ import annotations

import argparse
import json
import re
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
PACKAGE = ROOT / "src" / "gsplat_edu"
DOCUMENTS = (
    "README.md",
    "ARCHITECTURE.md",
    "CHANGELOG.md",
    "docs/DECISIONS.md",
    "docs/RECIPE.md",
    "docs/PRECISION.md",
    "benchmarks/RESULTS.md",
)
LINK = re.compile(r"(\]\()([^)\s#]+)(#[^)\s]*)?(\))")


def modules() -> list[str]:
    """Name every module of the package, packages before what is in them."""
    names = []
    for path in sorted(PACKAGE.rglob("*.py")):
        parts = path.relative_to(PACKAGE.parent).with_suffix("").parts
        names.append(".".join(parts[:-1] if parts[-1] == "__init__" else parts))
    return sorted(names)


def relinked(text: str, page: Path, stage: Path) -> str:
    """Point a page's links to modules at the reference, and bring along other files that it links.

    Args:
        text: Markdown.
        page: The page, relative to the repository.
        stage: Folder of the gathered pages.
    """

    def replaced(match: re.Match[str]) -> str:
        link, anchor = match[2], match[3] or ""
        if "://" in link or link.startswith("data:"):
            return match[0]
        target = (ROOT / page.parent / link).resolve()
        if not target.exists() or not target.is_relative_to(ROOT):
            raise SystemExit(f"build_site.py: {page}: {link} leads nowhere")
        up = "../" * (len(page.parts) - 1)
        if target.is_relative_to(PACKAGE) and target.suffix == ".py":
            name = ".".join(target.relative_to(PACKAGE.parent).with_suffix("").parts).removesuffix(
                ".__init__"
            )
            return f"{match[1]}{up}reference/{name}.md{match[4]}"
        copy = stage / target.relative_to(ROOT)
        if target.is_file() and not copy.exists() and target.suffix not in (".md", ".ipynb"):
            copy.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(target, copy)
        return f"{match[1]}{link}{anchor}{match[4]}"

    return LINK.sub(replaced, text)


def gather(stage: Path) -> None:
    """Lay out all pages in a folder.

    Args:
        stage: The folder, empty.
    """
    decisions = sorted(path.relative_to(ROOT) for path in (ROOT / "docs" / "decisions").glob("*.md"))
    documents = [*map(Path, DOCUMENTS), *decisions]
    chapters = sorted(path.relative_to(ROOT) for path in (ROOT / "notebooks").glob("*.ipynb"))
    for page in documents:
        _write(stage / page, relinked((ROOT / page).read_text(encoding="utf-8"), page, stage))
    for page in chapters:
        notebook = json.loads((ROOT / page).read_text(encoding="utf-8"))
        for cell in notebook["cells"]:
            if cell["cell_type"] == "markdown":
                cell["source"] = relinked("".join(cell["source"]), page, stage)
        _write(stage / page, json.dumps(notebook))
    names = modules()
    for name in names:
        _write(stage / "reference" / f"{name}.md", _reference(name))
    _write(stage / "index.md", _index(documents, chapters, names))
    shutil.copytree(ROOT / "docs" / "site", stage, dirs_exist_ok=True)


def _reference(name: str) -> str:
    # The package's own names stand where they are defined; there they are linked.
    again = "   :no-index:\n" if "." not in name else ""
    return f"# {name}\n\n```{{eval-rst}}\n.. automodule:: {name}\n   :members:\n{again}```\n"


def _index(documents: list[Path], chapters: list[Path], names: list[str]) -> str:
    parts = ["# gsplat_edu\n\n3D Gaussian Splatting: the course, the documents and the reference.\n"]
    sections = {
        "The course": [str(page.with_suffix("")) for page in chapters],
        "Documents": [str(page.with_suffix("")) for page in documents],
        "Reference": [f"reference/{name}" for name in names],
    }
    for title, pages in sections.items():
        parts.append(f"```{{toctree}}\n:caption: {title}\n:maxdepth: 1\n\n" + "\n".join(pages) + "\n```\n")
    return "\n".join(parts)


def _write(path: Path, text: str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text, encoding="utf-8")


def main() -> int:
    """Build the site; return 1 where the generator warned."""
    parser = argparse.ArgumentParser(description="Build the site of chapters, documents and reference.")
    parser.add_argument("--out", type=Path, default=ROOT / "out" / "site", help="folder (default: out/site)")
    out = parser.parse_args().out.resolve()
    if out.exists() and not (out / "objects.inv").is_file() and not (out.is_dir() and not any(out.iterdir())):
        print(f"build_site.py: --out: {out} is there and is no site; choose another folder", file=sys.stderr)
        return 2
    with tempfile.TemporaryDirectory() as scratch:
        stage, made = Path(scratch) / "source", Path(scratch) / "site"
        gather(stage)
        command = [
            sys.executable,
            "-m",
            "sphinx",
            "-b",
            "html",
            "-q",
            "-W",
            "--keep-going",
            "-d",
            f"{scratch}/trees",
        ]
        done = subprocess.run([*command, str(stage), str(made)], check=False)
        if done.returncode:
            print("build_site.py: the lines above say what is wrong; nothing was written", file=sys.stderr)
            return 1
        if out.exists():
            shutil.rmtree(out)
        out.parent.mkdir(parents=True, exist_ok=True)
        shutil.move(made, out)
    print(f"site: {out / 'index.html'}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
