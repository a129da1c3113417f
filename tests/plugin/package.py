"""The package of docs/PLUGINS.md, installed as pip would install it: modules, and metadata with the entry points."""

import os
import re
import subprocess
import sys
import tomllib
from pathlib import Path

DOCUMENT = Path(__file__).parents[2] / "docs" / "PLUGINS.md"


def files():
    """Return the files that the document shows, by name."""
    text = DOCUMENT.read_text(encoding="utf-8")
    return dict(re.findall(r"^`([\w/.]+)`[^\n]*:\n\n```\w+\n(.*?)```", text, re.MULTILINE | re.DOTALL))


def install(site):
    """Write the package into a folder that a Python with this folder on its path imports from."""
    shown = files()
    project = tomllib.loads(shown.pop("pyproject.toml"))["project"]
    (site / "gsplat_crisp").mkdir(parents=True)
    (site / "gsplat_crisp" / "__init__.py").touch()
    for name, text in shown.items():
        (site / name).write_text(text)
    info = site / f"{project['name'].replace('-', '_')}-{project['version']}.dist-info"
    info.mkdir()
    (info / "METADATA").write_text(
        f"Metadata-Version: 2.1\nName: {project['name']}\nVersion: {project['version']}\n"
    )
    groups = (
        f"[{group}]\n" + "".join(f"{name} = {value}\n" for name, value in points.items())
        for group, points in project["entry-points"].items()
    )
    (info / "entry_points.txt").write_text("\n".join(groups))


def python(*words, site=None):
    """Run Python, with the package if a folder is given; return exit code, output and errors."""
    paths = [str(site)] if site else []
    environment = os.environ | {
        "PYTHONPATH": os.pathsep.join([*paths, os.environ.get("PYTHONPATH", "")]).strip(os.pathsep)
    }
    done = subprocess.run(
        [sys.executable, *words], capture_output=True, text=True, check=False, env=environment
    )
    return done.returncode, done.stdout, done.stderr


def command(*words, site=None):
    """Run gsplat-edu likewise."""
    return python("-m", "gsplat_edu", *map(str, words), site=site)
