"""Build the site: chapters, documents and the reference of every module, as pages that open from disk.

    python course/build_site.py [--out out/site] [--public]

Pages keep the layout of the repository, so that their relative links stay valid; links to modules point to their
reference pages. A warning from the generator stops the build with exit code 1. Notebooks are shown as built, with their
set-up cells folded and with moving figures (`course/site_figures.py`).
"""

from __future__ import annotations

import argparse
import ast
import base64
import functools
import importlib
import inspect
import json
import re
import shutil
import subprocess
import sys
import tempfile
import tomllib
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from gsplat_edu.base.styles import tokens_by_theme
from gsplat_edu.tab.serving import write_page
from site_figures import with_figures

ROOT = Path(__file__).resolve().parent.parent
PACKAGE = ROOT / "src" / "gsplat_edu"
USE = {
    "README.md": "Install and first run",
    "docs/INSTALL.md": "Wheels and platforms",
    "docs/TOUR.md": "Tour",
    "docs/howto/README.md": "How-tos",
    "docs/EDITS.md": "Edited scenes",
    "docs/SCALE.md": "Larger than one machine",
    "docs/STUDIO.md": "The studio and its HTTP API",
    "docs/CLI.md": "Command line",
    "docs/FORMATS.md": "Scene formats",
    "docs/RECIPE.md": "Training parameters",
    "benchmarks/RESULTS.md": "Measured results",
}
"""Documents for users, with their titles in the sidebar."""

LEARN = {
    "notebooks/README.md": "The course",
    "notebooks/quizzes.md": "Quizzes",
    "docs/GLOSSARY.md": "Glossary",
    "docs/BIBLIOGRAPHY.md": "Bibliography",
}
"""Documents beside the chapters; the quizzes are written here."""

BUILD_ON = {
    "docs/PYTHON.md": "Python examples",
    "docs/PLUGINS.md": "Plug-ins",
    "docs/GSPLAT.md": "From gsplat",
    "reference/index.md": "Reference",
    "ARCHITECTURE.md": "Architecture",
    "docs/DECISIONS.md": "Conventions",
    "docs/decisions/index.md": "Decision records",
    "docs/PRECISION.md": "Precision",
    "docs/KERNELS.md": "Kernels",
    "conformance/README.md": "Conformance kit",
    "conformance/SPECIFICATION.md": "Specification of a renderer",
    "conformance/LENSES.md": "Specification of lenses",
    "CONTRIBUTING.md": "Contributing",
    "SECURITY.md": "Security",
    "docs/LICENCES.md": "Licences",
    "CHANGELOG.md": "Changelog",
}
"""Documents for developers; the two indices are written here."""

PICTURES = (
    "docs/images/sphere.png",
    "docs/images/capture.jpg",
    "docs/images/exposure-before-after.jpg",
    "docs/images/sky-before-after.jpg",
    "docs/images/studio.jpg",
)
TILES = ("notebooks/11_tiles.ipynb", 0)
"""The chapter figure on the landing page: the notebook and the figure's index."""

PUBLIC = {
    "Course (NumPy, from `gsplat_edu`)": "gsplat_edu",
    "Rendering": (
        "gsplat_edu.render.api.render",
        "gsplat_edu.scene.gaussians.Gaussians",
        "gsplat_edu.scene.camera.Camera",
        "gsplat_edu.scene.intrinsics.Intrinsics",
        "gsplat_edu.render.settings.RenderSettings",
        "gsplat_edu.render.output.RenderOutput",
        "gsplat_edu.render.cpu.render.render_covariances",
        "gsplat_edu.render.torch.render.render_t",
    ),
    "gsplat's interface": "gsplat_edu.compat.gsplat",
    "Captures": (
        "gsplat_edu.data.dataset.load_dataset",
        "gsplat_edu.data.dataset.scene_extent",
        "gsplat_edu.scene.views.View",
        "gsplat_edu.scene.photo.Photo",
    ),
    "Training": (
        "gsplat_edu.train.config.recipe",
        "gsplat_edu.train.config.TrainConfig",
        "gsplat_edu.train.initialize.from_points",
        "gsplat_edu.train.initialize.make_strategy",
        "gsplat_edu.train.trainer.Trainer",
        "gsplat_edu.ops.losses.photo_loss",
    ),
    "Scene files": (
        "gsplat_edu.io.formats.read_scene",
        "gsplat_edu.io.formats.write_scene",
        "gsplat_edu.io.scene.Scene",
        "gsplat_edu.io.ply.load_ply",
        "gsplat_edu.io.ply.save_ply",
    ),
}
"""The public API: the names of a module's `__all__`, or full paths of names."""

LINK = re.compile(r"(\]\()([^)\s#]+)(#[^)\s]*)?(\))")


@functools.cache
def modules() -> tuple[str, ...]:
    """List every module of the package, packages before their contents."""
    names = []
    for path in sorted(PACKAGE.rglob("*.py")):
        parts = path.relative_to(PACKAGE.parent).with_suffix("").parts
        names.append(".".join(parts[:-1] if parts[-1] == "__init__" else parts))
    return tuple(sorted(names))


def relinked(text: str, page: Path, stage: Path) -> str:
    """Point a page's links to modules at the reference, and copy the other files that it links to.

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
            raise SystemExit(f"build_site.py: {page}: {link} is a dead link")
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


def gather(stage: Path, public: bool) -> None:
    """Write all pages to an empty folder.

    Args:
        stage: The folder.
        public: Document members of modules that define a name of `PUBLIC`; the other modules have a page with their
            name.
    """
    documented = _public_modules() if public else set(modules())
    records = sorted(path.relative_to(ROOT) for path in (ROOT / "docs" / "decisions").glob("*.md"))
    documents = [Path(name) for name in (*LEARN, *USE, *BUILD_ON) if (ROOT / name).exists()]
    chapters = sorted(path.relative_to(ROOT) for path in (ROOT / "notebooks").glob("*.ipynb"))
    how_tos = sorted(path.relative_to(ROOT) for path in (ROOT / "docs" / "howto").glob("*.md"))
    for page in [*documents, *records, *how_tos]:
        write(stage / page, relinked((ROOT / page).read_text(encoding="utf-8"), page, stage))
    index = stage / "docs" / "howto" / "README.md"
    pages = [page.stem for page in how_tos if page.stem != "README"]
    write(index, index.read_text(encoding="utf-8") + "\n" + _toctree("hidden:", pages))
    for page in chapters:
        notebook = json.loads((ROOT / page).read_text(encoding="utf-8"))
        for cell in notebook["cells"]:
            if cell["cell_type"] == "markdown":
                cell["source"] = relinked("".join(cell["source"]), page, stage)
        fold_set_up(notebook)
        with_figures(page.stem, notebook)
        notebook["cells"].append(_origin(page, len(notebook["cells"])))
        write(stage / page, json.dumps(notebook))
    for name in modules():
        write(stage / "reference" / f"{name}.md", _reference(name, documented=name in documented))
    write(stage / "reference" / "index.md", _public_api())
    write(stage / "notebooks" / "quizzes.md", quizzes(chapters))
    write(stage / "docs" / "decisions" / "index.md", _records(records))
    shutil.copytree(ROOT / "docs" / "site", stage, dirs_exist_ok=True)
    write(stage / "static" / "tokens.css", tokens_by_theme())
    for picture in PICTURES:
        shutil.copyfile(ROOT / picture, stage / "static" / Path(picture).name)
    importlib.import_module("landing_scene").write_landing(stage / "static")
    (stage / "static" / "tiles.png").write_bytes(_figure(*TILES))
    landing = (stage / "index.md").read_text(encoding="utf-8")
    write(stage / "index.md", landing + _contents(chapters))


def quizzes(chapters: list[Path]) -> str:
    """Return the page of the questions of notebooks/quizzes.toml, with folded answers."""
    parts = [
        "# Quizzes\n\nFive questions for each chapter; teachers find them in `notebooks/quizzes.toml`.\n"
    ]
    asked = tomllib.loads((ROOT / "notebooks" / "quizzes.toml").read_text(encoding="utf-8"))
    for page in chapters:
        title = json.loads((ROOT / page).read_text(encoding="utf-8"))["cells"][0]["source"]
        parts.append(f"## [{''.join(title).splitlines()[0].removeprefix('# ')}]({page.name})\n")
        for number, one in enumerate(asked[page.name[:2]], 1):
            options = one.get("options", [])
            rows = [f"   - {letter}) {option}" for letter, option in zip("abc", options, strict=False)]
            answer = f"{'abc'[one['answer']]})" if options else f"{one['answer']:g}."
            told = f"   <details><summary>Answer</summary>\n\n   {answer} {one['why']}\n\n   </details>\n"
            parts.append("\n".join([f"{number}. {one['ask']}\n", *rows, *([""] if rows else []), told]))
    return "\n".join(parts)


def fold_set_up(notebook: dict[str, Any]) -> None:
    """Fold the code of a chapter's cells that begin with imports; their output stays visible.

    Args:
        notebook: The notebook; its cells are changed.
    """
    for cell in notebook["cells"]:
        is_chapter = cell["cell_type"] == "code" and cell["id"].startswith("cell-")
        if is_chapter and re.match(r"(import|from) ", "".join(cell["source"])):
            cell["metadata"] = {**cell["metadata"], "tags": ["hide-input"]}


@functools.cache
def built_from(root: Path = ROOT) -> str:
    """Return the commit of a working tree, with `-dirty` if files differ from it; "unknown" outside git.

    Args:
        root: The top folder of the working tree. An archive unpacked inside another repository is not of its commits.
    """
    found = []
    for command in (["rev-parse", "--show-toplevel"], ["describe", "--always", "--dirty", "--abbrev=12"]):
        try:
            done = subprocess.run(
                ["git", "-C", str(root), *command], capture_output=True, text=True, check=False
            )
        except FileNotFoundError:  # git is not installed
            return "unknown"
        if done.returncode:
            return "unknown"
        found.append(done.stdout.strip())
    return found[1] if Path(found[0]).resolve() == root.resolve() else "unknown"


def _origin(page: Path, number: int) -> dict[str, Any]:
    """Return the last cell of a chapter's page: what it was built from."""
    source = f"notebooks/source/{page.stem}.py"
    text = f"---\n\nThis page was built from `{source}` at commit `{built_from()}`."
    return {"cell_type": "markdown", "id": f"cell-{number:02d}", "metadata": {}, "source": text}


def _figure(page: str, number: int) -> bytes:
    """Return a figure of an executed notebook as PNG."""
    notebook = json.loads((ROOT / page).read_text(encoding="utf-8"))
    outputs = [output for cell in notebook["cells"] for output in cell.get("outputs", [])]
    figures = [output["data"]["image/png"] for output in outputs if "image/png" in output.get("data", {})]
    return base64.b64decode("".join(figures[number]))


def _reference(name: str, *, documented: bool) -> str:
    """Return the page of a module; the page of a package also lists its modules.

    These pages are not part of the sidebar: two hundred entries on every page would hide the others.
    """
    # The package's own names are indexed where they are defined.
    again = "   :no-index:\n" if "." not in name else ""
    above = name.split(".")[:-1]
    path = [f"[{'.'.join(above[: i + 1])}]({'.'.join(above[: i + 1])}.md)" for i in range(len(above))]
    head = " / ".join(["[Reference](index.md)", *path])
    page = f"---\norphan: true\n---\n\n{head}\n\n# {name}\n\n"
    members = f".. automodule:: {name}\n   :members:\n{again}" if documented else f".. py:module:: {name}"
    page += f"```{{eval-rst}}\n{members}\n```\n"
    inside = [other for other in modules() if other.rpartition(".")[0] == name and name != "gsplat_edu"]
    return page + ("\n## Modules\n\n" + _listed(inside) if inside else "")


def _listed(names: Iterable[str]) -> str:
    """Return a list of modules, linked, with the first sentence of their docstrings."""
    rows = []
    for name in names:
        path = ROOT / "src" / Path(*name.split("."))
        source = path / "__init__.py" if path.is_dir() else path.with_suffix(".py")
        docstring = ast.get_docstring(ast.parse(source.read_text(encoding="utf-8"))) or ""
        rows.append(f"- [{name}]({name}.md): {docstring.partition(chr(10))[0]}")
    return "\n".join(rows) + "\n"


def _public_api() -> str:
    """Return the first page of the reference: the public API by topic, then every package."""
    parts = ["# Reference\n\nThe public API first; the pages of all packages and modules follow.\n"]
    for topic, listed in PUBLIC.items():
        names = _names(listed) if isinstance(listed, str) else listed
        parts.append(f"## {topic}\n\n| name | what it is |\n|---|---|")
        parts += [_row(name) for name in names]
        parts.append("")
    top = [name for name in modules() if name.count(".") == 1]
    packages = [name for name in top if any(other.startswith(f"{name}.") for other in modules())]
    parts += ["## Packages\n", _listed(packages)]
    parts += ["## Modules\n", _listed(["gsplat_edu", *(n for n in top if n not in packages)])]
    return "\n".join(parts)


def _public_modules() -> set[str]:
    """Return the modules that define a name of `PUBLIC`."""
    listed = [_names(names) if isinstance(names, str) else names for names in PUBLIC.values()]
    names = [name for topic in listed for name in topic]
    found = {getattr(_found(name), "__module__", None) or name.rpartition(".")[0] for name in names}
    return found | {name.rpartition(".")[0] for name in names}


def _names(module: str) -> list[str]:
    """List the functions and classes of a module's `__all__`."""
    everything = [f"{module}.{name}" for name in importlib.import_module(module).__all__]
    return [name for name in everything if callable(_found(name))]


def _found(name: str) -> object:
    module, _, attribute = name.rpartition(".")
    return getattr(importlib.import_module(module), attribute)


def _row(name: str) -> str:
    """Return a table row that links a name to its definition and quotes the first line of its docstring."""
    thing: Any = _found(name)
    if not (isinstance(thing, type) or inspect.isfunction(thing)):  # a type alias: its module documents it
        return (
            f"| {{py:obj}}`{name}` | {(getattr(thing, '__doc__', '') or '').strip().partition(chr(10))[0]} |"
        )
    text = (inspect.getdoc(thing) or "").partition("\n\n")[0]
    target = f"{thing.__module__}.{thing.__qualname__}"
    return (
        f"| {{py:obj}}`{thing.__name__} <{target}>` | {' '.join(text.split()).replace('|', chr(92) + '|')} |"
    )


def _records(records: list[Path]) -> str:
    head = "# Decision records\n\nOne short record for each choice that was hard to make.\n\n"
    return head + _toctree("maxdepth: 1", [page.stem for page in records])


def _toctree(options: str, pages: Iterable[str]) -> str:
    return f"```{{toctree}}\n:{options}\n\n" + "\n".join(pages) + "\n```\n"


def _contents(chapters: list[Path]) -> str:
    """Return the sidebar with its sections: learn, use, build on."""
    sections = {"Learn": LEARN, "Use": USE, "Build on": BUILD_ON}
    entries = {
        section: [f"{title} <{name.removesuffix('.md')}>" for name, title in documents.items()]
        for section, documents in sections.items()
    }
    first, *others = entries["Learn"]
    entries["Learn"] = [first, *(str(page.with_suffix("")) for page in chapters), *others]
    return "\n".join(
        _toctree(f"caption: {section}\n:hidden:\n:maxdepth: 2", pages) for section, pages in entries.items()
    )


def write(path: Path, text: str) -> None:
    """Write a page; its folders are made."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text, encoding="utf-8")


def main() -> int:
    """Build the site; return 1 if the generator warned."""
    parser = argparse.ArgumentParser(description="Build the site of chapters, documents and reference.")
    parser.add_argument("--out", type=Path, default=ROOT / "out" / "site", help="folder (default: out/site)")
    parser.add_argument("--public", action="store_true", help="document only the modules of the public API")
    given = parser.parse_args()
    out = given.out.resolve()
    if out.exists() and not (out / "objects.inv").is_file() and not (out.is_dir() and not any(out.iterdir())):
        print(f"build_site.py: --out: {out} exists and is not a site; choose another folder", file=sys.stderr)
        return 2
    with tempfile.TemporaryDirectory() as scratch:
        stage, made = Path(scratch) / "source", Path(scratch) / "site"
        gather(stage, given.public)
        # Python's collector would look through all pages again and again.
        program = (
            "import gc, sys; gc.set_threshold(200_000); from sphinx.cmd.build import main; sys.exit(main())"
        )
        options = ["-b", "html", "-q", "-W", "--keep-going", "-d", f"{scratch}/trees"]
        command = [sys.executable, "-c", program, *options]
        done = subprocess.run([*command, str(stage), str(made)], check=False)
        if done.returncode:
            print(
                "build_site.py: the site was not written; the lines above name the problems", file=sys.stderr
            )
            return 1
        write_page(made / "train")
        if out.exists():
            shutil.rmtree(out)
        out.parent.mkdir(parents=True, exist_ok=True)
        shutil.move(made, out)
    print(f"site: {out / 'index.html'}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
