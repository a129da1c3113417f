"""Pack a wheel: the package, a native module and what describes them, the same bytes for the same content."""

from __future__ import annotations

import base64
import hashlib
import json
import os
import subprocess
import time
import zipfile
from email.parser import Parser
from pathlib import Path

from wheels.contents import sbom

ROOT = Path(__file__).resolve().parents[2]


def epoch() -> int:
    """Return the time that every file of a wheel gets: SOURCE_DATE_EPOCH, or that of the commit."""
    given = os.environ.get("SOURCE_DATE_EPOCH")
    if given:
        return int(given)
    done = subprocess.run(
        ["git", "log", "-1", "--format=%ct"], cwd=ROOT, capture_output=True, text=True, check=False
    )
    return (
        int(done.stdout) if done.returncode == 0 and done.stdout.strip() else 315532800
    )  # 1980, zip's first year


def _entry(name: str, seconds: int) -> zipfile.ZipInfo:
    entry = zipfile.ZipInfo(name, time.gmtime(max(seconds, 315532800))[:6])
    entry.compress_type = zipfile.ZIP_DEFLATED
    entry.create_system = 3  # Unix, wherever it is packed
    executable = name.endswith((".so", ".pyd"))
    entry.external_attr = (0o100755 if executable else 0o100644) << 16
    return entry


def record_line(name: str, data: bytes) -> str:
    """Return the line of a file in a wheel's RECORD."""
    digest = base64.urlsafe_b64encode(hashlib.sha256(data).digest()).rstrip(b"=").decode()
    return f"{name},sha256={digest},{len(data)}"


def pack(pure: Path, module: tuple[str, bytes], tag: str, bundled: list[dict[str, str]], out: Path) -> Path:
    """Write a wheel for one platform.

    Args:
        pure: A wheel of the package without the module.
        module: The module's file name in the package, and its bytes.
        tag: Tag of the wheel, such as cp312-abi3-win_amd64.
        bundled: What the module was linked with: name, version, licence and text of the licence.
        out: The folder to write to.
    """
    with zipfile.ZipFile(pure) as archive:
        files = {name: archive.read(name) for name in archive.namelist() if not name.endswith("/")}
    (record,) = (name for name in files if name.endswith(".dist-info/RECORD"))
    info = record.rsplit("/", 1)[0]
    del files[record]
    metadata = Parser().parsestr(files[f"{info}/METADATA"].decode(), headersonly=True)
    files[f"gsplat_edu/{module[0]}"] = module[1]
    files[f"{info}/WHEEL"] = (
        f"Wheel-Version: 1.0\nGenerator: gsplat_edu\nRoot-Is-Purelib: false\nTag: {tag}\n".encode()
    )
    for part in bundled:
        files[f"{info}/licenses/{part['name']}.txt"] = part["text"].encode()
    seconds = epoch()
    bill = sbom(metadata, module, bundled, seconds)
    files[f"{info}/sboms/gsplat_edu.cdx.json"] = (json.dumps(bill, indent=2) + "\n").encode()
    lines = [*(record_line(name, files[name]) for name in sorted(files)), f"{record},,"]
    files[record] = "".join(f"{line}\n" for line in lines).encode()
    out.mkdir(parents=True, exist_ok=True)
    path = out / f"{info.removesuffix('.dist-info')}-{tag}.whl"
    # The description comes last, as the format recommends.
    names = sorted(files, key=lambda name: (name.startswith(info), name))
    with zipfile.ZipFile(path, "w") as archive:
        for name in names:
            archive.writestr(_entry(name, seconds), files[name], compresslevel=9)
    return path
