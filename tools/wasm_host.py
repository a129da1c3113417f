"""Node with the WebAssembly module, for tests and benchmarks that compare it with the package."""

from __future__ import annotations

import base64
import json
import subprocess
from pathlib import Path
from typing import Any

import numpy as np

import build_wasm
from gsplat_edu.scene.camera import Camera
from gsplat_edu.scene.views import View

KINDS: dict[str, type] = {"Float64Array": np.float64, "Float32Array": np.float32, "Uint8Array": np.uint8}
TYPES = {np.dtype(kind): name for name, kind in KINDS.items()}


class EngineError(Exception):
    """What the module refused."""


class Host:
    """A process of node that holds the module; `ask` calls a function of wasm_host.mjs."""

    def __init__(self, node: str) -> None:
        script = Path(__file__).with_suffix(".mjs")
        words = [node, "--no-warnings", str(script), str(build_wasm.MODULE.parent)]
        self._process = subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        self.ask("load")

    def ask(self, call: str, **given: Any) -> Any:  # noqa: ANN401
        """Return the answer of a call, with arrays as NumPy's.

        Raises:
            EngineError: the module refused what it was given.
        """
        assert self._process.stdin is not None and self._process.stdout is not None
        self._process.stdin.write(json.dumps({"call": call, **_packed(given)}) + "\n")
        self._process.stdin.flush()
        answer = json.loads(self._process.stdout.readline())
        if "error" in answer:
            raise EngineError(answer["error"])
        return _unpacked(answer["value"])

    def close(self) -> None:
        """End the process."""
        self._process.communicate(timeout=60)
        assert self._process.returncode == 0


def camera_of(camera: Camera) -> dict[str, Any]:
    """Return a pinhole as engine.js takes it."""
    plain: dict[str, Any] = {name: float(getattr(camera, name)) for name in ("fx", "fy", "cx", "cy")}
    plain |= {"W": camera.W, "H": camera.H}
    return plain | {"R": list(map(float, np.ravel(camera.R))), "eye": list(map(float, camera.eye))}


def view_of(view: View) -> dict[str, Any]:
    """Return a view with its photo as engine.js takes it."""
    image = view.read().image
    pixels = image if image.dtype == np.uint8 else np.round(255 * image).astype(np.uint8)
    return {"name": view.name, "camera": camera_of(view.camera), "pixels": pixels.ravel()}


def options_of(views: list[View], points: Any, colors: Any, **settings: Any) -> dict[str, Any]:  # noqa: ANN401
    """Return the options of a training in the module."""
    arrays = {"points": np.ravel(points).astype(np.float64), "colors": np.ravel(colors).astype(np.float64)}
    return {**arrays, "views": [view_of(view) for view in views], "settings": settings}


def _packed(value: Any) -> Any:  # noqa: ANN401
    if isinstance(value, np.ndarray):
        encoded = base64.b64encode(np.ascontiguousarray(value).tobytes()).decode()
        return {"type": TYPES[value.dtype], "bytes": encoded}
    if isinstance(value, dict):
        return {name: _packed(each) for name, each in value.items()}
    if isinstance(value, (list, tuple)):
        return [_packed(each) for each in value]
    return value


def _unpacked(value: Any) -> Any:  # noqa: ANN401
    if isinstance(value, list):
        return [_unpacked(each) for each in value]
    if not isinstance(value, dict):
        return value
    if value.keys() == {"type", "bytes"}:
        return np.frombuffer(base64.b64decode(value["bytes"]), KINDS[value["type"]])
    return {name: _unpacked(each) for name, each in value.items()}
