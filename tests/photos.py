"""Photos of the course's sphere and of the procedural scene, rendered once. The reference renderer takes seconds for
them, and dozens of tests need the same photos. The processes of a test run, and the programs that `processes.Program`
starts, share them in a folder.
"""

import hashlib
import os
import struct
import threading
import zlib
from pathlib import Path

import numpy as np

from gsplat_edu import Camera
from gsplat_edu.data import procedural, synthetic

VARIABLE = "GSPLAT_TEST_PHOTOS"
"""Environment variable with the folder's name."""


def keep() -> None:
    """From now on, read photos from the folder, and add missing ones to it."""
    original, folder = synthetic.render_gaussians, Path(os.environ[VARIABLE])
    folder.mkdir(exist_ok=True)

    def photographed(camera: Camera, *splats: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        pose = repr(camera.intrinsics).encode() + camera.R.tobytes() + camera.eye.tobytes()
        path = folder / f"{hashlib.sha256(pose + b''.join(a.tobytes() for a in splats)).hexdigest()}.npz"
        if not path.exists():
            image, transmittance = original(camera, *splats)
            part = path.with_suffix(f".{os.getpid()}-{threading.get_ident()}.npz")
            np.savez(part, image=image, transmittance=transmittance)
            part.replace(path)
        with np.load(path) as kept:
            return kept["image"], kept["transmittance"]

    synthetic.render_gaussians = procedural.render_gaussians = photographed


def blank_png(W: int, H: int) -> bytes:
    """Return a small gray PNG whose header declares a larger size than its contents have."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    header = struct.pack(">IIBBBBB", W, H, 8, 0, 0, 0, 0)
    body = chunk(b"IDAT", zlib.compress(bytes(1000)))
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + body + chunk(b"IEND", b"")
