"""What a wheel contains that others wrote: the parts linked into the module, and the bill of materials."""

from __future__ import annotations

import datetime
import hashlib
import re
from email.message import Message
from importlib.metadata import distribution
from pathlib import Path


def _licence_of(package: str, file: str = "LICENSE") -> str:
    found = distribution(package)
    for path in found.files or ():
        if path.name == file and "licenses" in path.parts:
            return path.read_text()
    raise SystemExit(f"wheels: {package} has no file {file} in its licences")


def nanobind_parts() -> list[dict[str, str]]:
    """Describe nanobind and the hash map that it contains."""
    import nanobind

    header = Path(nanobind.include_dir()).parent / "ext" / "robin_map" / "include" / "tsl" / "robin_map.h"
    text = re.match(r"/\*\*(.*?)\*/", header.read_text(), re.S)
    if text is None:
        raise SystemExit("wheels: nanobind's robin_map.h does not start with its licence")
    mit = "\n".join(line.strip().removeprefix("*").strip() for line in text[1].strip().splitlines())
    return [
        {
            "name": "nanobind",
            "version": nanobind.__version__,
            "licence": "BSD-3-Clause",
            "text": _licence_of("nanobind"),
        },
        {"name": "robin-map", "version": "", "licence": "MIT", "text": mit + "\n"},
    ]


def zig_parts(windows: bool) -> list[dict[str, str]]:
    """Describe what zig links: the C++ library, on Windows the C runtime's start, and WebAssembly's C library."""
    import ziglang

    folder = Path(ziglang.__file__).parent
    version = distribution("ziglang").version
    llvm = "Apache-2.0 WITH LLVM-exception"
    parts = [("libcxx", llvm, "lib/libcxx/LICENSE.TXT"), ("libunwind", llvm, "lib/libunwind/LICENSE.TXT")]
    parts.append(("zig-compiler-rt", "MIT", "LICENSE"))
    parts.append(("wasi-libc", "MIT", "lib/libc/wasi/LICENSE-MIT"))
    parts.append(("musl", "MIT", "lib/libc/musl/COPYRIGHT"))  # most of wasi-libc
    if windows:
        parts.append(("mingw-w64", "ZPL-2.1", "lib/libc/mingw/COPYING"))
    return [
        {"name": name, "version": f"zig-{version}", "licence": licence, "text": (folder / file).read_text()}
        for name, licence, file in parts
    ]


def _components(metadata: Message, bundled: list[dict[str, str]]) -> list[dict[str, object]]:
    """Return the parts that are linked into the module, and the dependencies that pip installs."""
    components: list[dict[str, object]] = []
    for part in bundled:
        component: dict[str, object] = {
            "type": "library",
            "bom-ref": part["name"],
            "name": part["name"],
            "licenses": [{"expression": part["licence"]}],
            "properties": [{"name": "gsplat_edu:linked", "value": "static"}],
        }
        if part["version"]:
            component["version"] = part["version"]
        components.append(component)
    for line in metadata.get_all("Requires-Dist") or []:
        if ";" in line:  # of an extra
            continue
        parsed = re.match(r"([A-Za-z0-9._-]+)(.*)", line)
        assert parsed is not None
        components.append(
            {
                "type": "library",
                "bom-ref": f"pkg:pypi/{parsed[1]}",
                "name": parsed[1],
                "scope": "required",
                "purl": f"pkg:pypi/{parsed[1]}",
                "properties": [{"name": "gsplat_edu:range", "value": parsed[2].strip()}],
            }
        )
    return components


def sbom(
    metadata: Message, module: tuple[str, bytes], bundled: list[dict[str, str]], seconds: int
) -> dict[str, object]:
    """Return the bill of materials of a wheel, in CycloneDX 1.6.

    Components are what the module contains; dependencies that pip installs stand beside them with scope "required" and
    the range that is asked for.
    """
    name, version = metadata["Name"], metadata["Version"]
    own = f"pkg:pypi/{name}@{version}"
    components = _components(metadata, bundled)
    components.append(
        {
            "type": "file",
            "bom-ref": module[0],
            "name": f"gsplat_edu/{module[0]}",
            "hashes": [{"alg": "SHA-256", "content": hashlib.sha256(module[1]).hexdigest()}],
        }
    )
    return {
        "bomFormat": "CycloneDX",
        "specVersion": "1.6",
        "version": 1,
        "metadata": {
            "timestamp": datetime.datetime.fromtimestamp(seconds, datetime.UTC).strftime(
                "%Y-%m-%dT%H:%M:%SZ"
            ),
            "component": {
                "type": "library",
                "bom-ref": own,
                "name": name,
                "version": version,
                "licenses": [{"expression": metadata["License-Expression"]}],
                "purl": own,
            },
        },
        "components": components,
        "dependencies": [{"ref": own, "dependsOn": [c["bom-ref"] for c in components]}],
    }
