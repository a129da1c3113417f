"""Node, and the WebAssembly module in it."""

import shutil

import pytest

import build_wasm
from wasm_host import Host


@pytest.fixture(scope="session")
def node():
    """The path of node."""
    found = shutil.which("node")
    if found is None:
        pytest.skip("node is not installed")
    assert build_wasm.is_built(), "the WebAssembly module is missing or old: run tools/set_up.sh dev"
    return found


@pytest.fixture
def host(node):
    """A fresh module in node."""
    made = Host(node)
    yield made
    made.close()
