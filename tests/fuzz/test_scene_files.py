"""Damaged scene files end in a finite scene or a one-line error, and memory stays small."""

import tracemalloc
import zipfile

import numpy as np
import pytest

import tiers
from damage import damaged_bytes
from gsplat_edu.base.errors import SceneFormatError
from gsplat_edu.io.formats import read_scene
from lcc_files import small_lcc, small_lcc2
from scene_files import IN_A_PROCESS, small_file, small_levels, suffixes

pytestmark = pytest.mark.fuzz

FILES = tiers.count("GSPLAT_EDU_FUZZ", 100, 20_000)
"""Mutated files per reader."""

SLOWER = 5
"""Of files whose readers start a process, every fifth is read."""

SEEDS = range(tiers.SEED, tiers.SEED + FILES)

MOST_MEMORY = 24 << 20
"""Largest memory that reading may take, bytes. The files have at most 32 KiB; 1 MiB of contents and float32 copies of
them are allowed."""


def check(path, seed):
    tracemalloc.start()
    try:
        scene = read_scene(path)
    except SceneFormatError as error:
        message = str(error)
        assert str(path) in message and "\n" not in message, seed
    else:
        assert bool(scene.gaussians.finite_rows().all()), seed
    finally:
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
    assert peak < MOST_MEMORY, f"seed {seed}: {peak:,} bytes"


@pytest.mark.parametrize("suffix", suffixes())
def test_damaged_files(tmp_path, suffix):
    data = small_file(tmp_path, suffix).read_bytes()
    path = tmp_path / f"damaged{suffix}"
    for seed in SEEDS[:: SLOWER if suffix in IN_A_PROCESS else 1]:
        path.write_bytes(damaged_bytes(data, np.random.default_rng(seed)))
        check(path, seed)


def test_damage_inside_a_sog(tmp_path):
    """A zip has checksums, so the damage is done before zipping."""
    parts = {}
    with zipfile.ZipFile(small_file(tmp_path, ".sog")) as bundle:
        for name in bundle.namelist():
            parts[name] = bundle.read(name)
    path = tmp_path / "damaged.sog"
    names = sorted(parts)
    for seed in SEEDS:
        rng = np.random.default_rng(seed)
        victim = names[int(rng.integers(0, len(names)))] if rng.random() < 0.5 else "meta.json"
        with zipfile.ZipFile(path, "w") as bundle:
            for name, content in parts.items():
                bundle.writestr(name, damaged_bytes(content, rng) if name == victim else content)
        check(path, seed)


@pytest.mark.parametrize("small", [small_levels, small_lcc, small_lcc2])
def test_damage_inside_levels_of_detail(tmp_path, small):
    """Half of the damage is in the index, the rest in one of the files that it names."""
    whole = small(tmp_path)
    files = sorted(file for file in whole.parent.rglob("*") if file.is_file())
    for seed in SEEDS:
        rng = np.random.default_rng(seed)
        victim = files[int(rng.integers(0, len(files)))] if rng.random() < 0.5 else whole
        content = victim.read_bytes()
        victim.write_bytes(damaged_bytes(content, rng))
        check(whole, seed)
        victim.write_bytes(content)
