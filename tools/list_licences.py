"""List the licences of everything that pip installs with gsplat_edu, from the metadata of the installed packages.

    python tools/list_licences.py

Writes docs/LICENCES.md. A licence that is not in COMPATIBLE ends it with exit code 1, unless the package is in
EXCEPTIONS. `tests/repo/test_licences.py` fails if the document is out of date.
"""

from __future__ import annotations

import argparse
import re
import sys
from importlib.metadata import Distribution, PackageNotFoundError, distribution
from pathlib import Path

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).resolve().parent.parent
DOCUMENT = ROOT / "docs" / "LICENCES.md"
EXTRAS = ("sfm", "course", "heic", "cluster", "gpu", "mesh", "depth", "usd", "scans")
"""Extras that users install. Those of developers are tools, which nothing that we give away contains."""

COMPATIBLE = {
    *(
        "0BSD",
        "Apache-2.0",
        "BSD-2-Clause",
        "BSD-3-Clause",
        "BSL-1.0",
        "CC0-1.0",
        "HPND",
        "ISC",
        "MIT",
        "MIT-0",
        "MIT-CMU",
    ),
    *("PSF-2.0", "Python-2.0", "Unlicense", "Zlib", "bzip2-1.0.6", "Apache-2.0 WITH LLVM-exception"),
    "GPL-3.0-or-later WITH GCC-exception-3.1",  # libraries of the compiler, whose exception frees what uses them
    "MPL-2.0",  # obliges only those who change the package's own files
    "OFL-1.1",  # fonts
    "LicenseRef-TOST-1.0",  # of USD: Apache-2.0 with another paragraph on trademarks
}
"""SPDX names of licences that a program under Apache-2.0 may depend on."""

EXCEPTIONS = {"pillow-heif"}
"""Packages that are not held to COMPATIBLE; NOTES says why."""

NOTES = {
    "coacd": "its wheels also contain OpenVDB (MPL-2.0, since version 12 Apache-2.0), oneTBB, Boost and GCC's libgomp",
    "opencv-python-headless": "its wheels also contain FFmpeg, a library under LGPL-2.1",
    "pillow-heif": "only with the extra heic: its wheels also contain x265, and are GPL-2.0 as a whole",
    "usd-core": "Apache-2.0 with another section on trademarks; its wheels also contain other permissive code",
    "wgpu": "its wheels also contain wgpu-native, under MIT OR Apache-2.0",
    "torch": "pip's default build for Linux adds NVIDIA's libraries under NVIDIA's terms; the CPU build does not",
}
"""What the metadata of a package do not say about its wheels."""

TEXTS = {"rendercanvas": "BSD-2-Clause", "wgpu": "BSD-2-Clause", "xatlas": "MIT", "openexr": "BSD-3-Clause"}
"""Packages whose metadata contain the text of their licence, but not its SPDX name."""

CLASSIFIERS = {
    "Apache Software License": "Apache-2.0",
    "BSD License": "BSD-3-Clause",
    "ISC License (ISCL)": "ISC",
    "MIT License": "MIT",
    "MIT No Attribution License (MIT-0)": "MIT-0",
    "Mozilla Public License 2.0 (MPL 2.0)": "MPL-2.0",
    "Python Software Foundation License": "PSF-2.0",
    "The Unlicense (Unlicense)": "Unlicense",
}
WORDS = {
    "3-Clause BSD License": "BSD-3-Clause",
    "Apache 2.0": "Apache-2.0",
    "Apache License 2.0": "Apache-2.0",
    "Apache 2": "Apache-2.0",
    "Apache License, Version 2.0": "Apache-2.0",
    "Apache Software License": "Apache-2.0",
    "BSD": "BSD-3-Clause",
    "BSD 3-Clause": "BSD-3-Clause",
    "BSD 3-Clause License": "BSD-3-Clause",
    "BSD-2-Clause": "BSD-2-Clause",
    "ISC license": "ISC",
    "MIT License": "MIT",
    "MIT license": "MIT",
    "The MIT License": "MIT",
    "PSF": "PSF-2.0",
    "PSFL": "PSF-2.0",
}
"""What packages without an SPDX expression write, and the expression that it means."""


def installed() -> dict[str, Distribution]:
    """Return the packages that pip installs with gsplat_edu and EXTRAS, by name, as far as they are installed here."""
    found: dict[str, Distribution] = {}
    waiting: list[tuple[str, frozenset[str]]] = [("gsplat-edu", frozenset(EXTRAS))]
    seen: set[tuple[str, frozenset[str]]] = set()
    while waiting:
        name, extras = waiting.pop()
        if (name, extras) in seen:
            continue
        seen.add((name, extras))
        try:
            package = distribution(name)
        except PackageNotFoundError:
            continue  # asked for on another platform only
        found[name] = package
        for line in package.requires or ():
            wanted = Requirement(line)
            if any(
                wanted.marker is None or wanted.marker.evaluate({"extra": extra}) for extra in {"", *extras}
            ):
                waiting.append((canonicalize_name(wanted.name), frozenset(wanted.extras)))
    del found["gsplat-edu"]
    return dict(sorted(found.items()))


def licence(package: Distribution) -> str:
    """Return a package's licence as an SPDX expression; what it says itself if that is not one."""
    expression = package.metadata.get("License-Expression")  # KeyError with the backport that dask imports
    if expression:
        return expression
    stated = (package.metadata.get("License") or "").strip()
    if stated != "UNKNOWN" and stated and "\n" not in stated and len(stated) < 60:
        return WORDS.get(stated, stated)
    named = [
        CLASSIFIERS.get(line.rsplit(" :: ", 1)[1], line.rsplit(" :: ", 1)[1])
        for line in package.metadata.get_all("Classifier") or ()
        if line.startswith("License :: OSI Approved ::") and line.count("::") > 1
    ]
    return " OR ".join(named) if named else TEXTS.get(str(package.metadata["Name"]).lower(), "unknown")


def compatible(expression: str) -> bool:
    """Return whether an SPDX expression allows use by a program under Apache-2.0: of OR one side, of AND both."""
    depth, flat = 0, ""
    for character in expression:  # alternatives in brackets are judged first
        depth += character == "("
        flat += character if depth == 0 else ""
        depth -= character == ")"
    for inner in re.findall(r"\(([^()]*)\)", expression):
        if not compatible(inner):
            return False
    parts = [part.strip() for part in re.split(r"\bAND\b", flat) if part.strip()]
    return all(any(one.strip() in COMPATIBLE for one in re.split(r"\bOR\b", part)) for part in parts)


def incompatible() -> list[str]:
    """List "package: licence" of every installed package whose licence is neither compatible nor excepted."""
    return [
        f"{name}: {licence(package)}"
        for name, package in installed().items()
        if name not in EXCEPTIONS and not compatible(licence(package))
    ]


def document() -> str:
    """Return the text of docs/LICENCES.md."""
    rows = [
        f"| {name} | {licence(package)} | {NOTES.get(name, '')} |" for name, package in installed().items()
    ]
    return "\n".join(
        [
            "# Licences of other packages",
            "",
            "What pip installs with gsplat_edu and its extras "
            + ", ".join(f"`{extra}`" for extra in EXTRAS)
            + " on Linux.",
            "`tools/list_licences.py` writes this page from the metadata of the installed packages. A test fails",
            "when a licence is not compatible with ours, Apache-2.0. Metadata speak for the code of a package; its",
            "wheels may contain libraries under other licences, and the notes name those that we know of.",
            "",
            "Our wheels contain none of these packages. They contain nanobind (BSD-3-Clause) with robin-map (MIT) and",
            "the C++ library of LLVM (Apache-2.0 with LLVM's exception). The texts are in the wheel's `licenses`, and",
            "`sboms/gsplat_edu.cdx.json` lists them.",
            "",
            "| package | licence | note |",
            "| --- | --- | --- |",
            *rows,
            "",
        ]
    )


def main() -> int:
    """Run the tool."""
    argparse.ArgumentParser(description=(__doc__ or "").split("\n", 1)[0]).parse_args()
    wrong = incompatible()
    print("".join(f"not compatible with Apache-2.0: {line}\n" for line in wrong), end="")
    DOCUMENT.write_text(document(), encoding="utf-8")
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
