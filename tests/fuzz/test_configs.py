"""On a damaged config.json, `train --resume` exits with 0, or with 2 and one line; other readers refuse in one line."""

import contextlib
import io

import numpy as np
import pytest

import tiers
from damage import damaged_json
from gsplat_edu.base.errors import SplatError
from gsplat_edu.cli.main import main
from gsplat_edu.data.procedural import procedural_capture
from gsplat_edu.data.writers import write_colmap
from gsplat_edu.runs.folder import RunFolder, render_settings
from gsplat_edu.runs.source import open_source

pytestmark = pytest.mark.fuzz

MUTATIONS = tiers.count("GSPLAT_EDU_FUZZ_CONFIGS", 25, 1_000)
"""Number of damaged files."""

SEEDS = range(tiers.SEED, tiers.SEED + MUTATIONS)


def resumed(words):
    """Run the command; return its exit code and what it wrote to stderr, which is encoded as Python's own is."""
    stream = io.TextIOWrapper(io.BytesIO(), "utf-8", errors="backslashreplace", write_through=True)
    with contextlib.redirect_stderr(stream), contextlib.redirect_stdout(io.StringIO()):
        code = main(words)
    return code, stream.buffer.getvalue().decode()


@pytest.mark.usefixtures("as_shipped")
def test_damaged_configs(tmp_path):
    write_colmap(tmp_path / "egg", *procedural_capture(12, 4, splats=30))
    out = tmp_path / "run"
    words = ["train", str(tmp_path / "egg"), "--out", str(out), "--iterations", "3", "--resume"]
    assert main(words) == 0
    whole = (out / "config.json").read_bytes()
    for seed in SEEDS:
        (out / "config.json").write_bytes(damaged_json(whole, np.random.default_rng(seed)))
        code, said = resumed(words)
        assert code in (0, 2), seed
        assert code == 0 or (said.count("\n") == 1 and said.startswith("gsplat-edu")), (seed, said)
        try:
            render_settings(RunFolder(out).read_config())
            open_source(out)
        except SplatError as error:
            assert "\n" not in str(error), seed
