"""Node with the WebAssembly module, for tests that compare it with the package."""

import base64
import json
import subprocess

import numpy as np

import build_wasm

KINDS = {"Float64Array": np.float64, "Float32Array": np.float32, "Uint8Array": np.uint8}
TYPES = {np.dtype(kind): name for name, kind in KINDS.items()}


class EngineError(Exception):
    """What the module refused."""


class Host:
    """A process of node that holds the module; `ask` calls a function of tests/tab/host.mjs."""

    def __init__(self, node):
        script = build_wasm.ROOT / "tests" / "tab" / "host.mjs"
        words = [node, "--no-warnings", script, build_wasm.MODULE.parent]
        self._process = subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        self.ask("load")

    def ask(self, call, **given):
        """Return the answer of a call, with arrays as NumPy's."""
        self._process.stdin.write(json.dumps({"call": call, **_packed(given)}) + "\n")
        self._process.stdin.flush()
        answer = json.loads(self._process.stdout.readline())
        if "error" in answer:
            raise EngineError(answer["error"])
        return _unpacked(answer["value"])

    def close(self):
        """End the process."""
        self._process.stdin.close()
        self._process.stdout.close()
        assert self._process.wait(60) == 0


def _packed(value):
    if isinstance(value, np.ndarray):
        return {
            "type": TYPES[value.dtype],
            "bytes": base64.b64encode(np.ascontiguousarray(value).tobytes()).decode(),
        }
    if isinstance(value, dict):
        return {name: _packed(each) for name, each in value.items()}
    if isinstance(value, (list, tuple)):
        return [_packed(each) for each in value]
    return value


def _unpacked(value):
    if isinstance(value, list):
        return [_unpacked(each) for each in value]
    if not isinstance(value, dict):
        return value
    if value.keys() == {"type", "bytes"}:
        return np.frombuffer(base64.b64decode(value["bytes"]), KINDS[value["type"]])
    return {name: _unpacked(each) for name, each in value.items()}
