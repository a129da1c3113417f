"""Short trainings whose bits are known, run by tests/golden/test_training_bits.py and recorded by this file.

    python tests/training_bits.py --record

writes the hashes for every instruction set of this machine into tests/golden/training_bits.json. A change of the
trainer that should not change results keeps the hashes. A commit that changes results records the hashes again and
explains why.
"""

import argparse
import functools
import hashlib
import json
import os
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch

from gsplat_edu.data.procedural import procedural_capture
from gsplat_edu.data.synthetic import sphere_capture
from gsplat_edu.ops import kernels
from gsplat_edu.render.backends import load_backend
from gsplat_edu.train.compose import Start, Views, training
from gsplat_edu.train.config import recipe
from gsplat_edu.train.course import EXTENT, course_config
from gsplat_edu.train.events import DensifyEvent, RelocateEvent, ResetEvent, StepEvent
from gsplat_edu.train.initialize import from_points, random_ball
from gsplat_edu.train.trainer import Trainer, TrainResult

RECORDS = Path(__file__).parent / "golden" / "training_bits.json"

CAPABILITIES = {"v2": "default", "v3": "avx2", "v4": "avx512"}
"""Torch's capability on a machine, by the best of our instruction sets that the machine has."""

SCHEDULE = {"densify_start": 5, "densify_every": 10, "densify_stop": 100, "mcmc_stop": 100, "sh_every": 20}


CAPTURE, SPHERE = functools.cache(procedural_capture), functools.cache(sphere_capture)


def train_capture(config, events, size=40) -> tuple[Trainer, TrainResult]:
    views, points, colors = CAPTURE(size, 6, splats=120)
    start = from_points(points, colors, config)
    watch = [lambda _, event: events.append(event)]
    trainer = training(config, Views(views), load_backend("cpu"), Start(start, extent=2.0), callbacks=watch)
    return trainer, trainer.run()


def train_adc(events):
    """Clone, split, and prune by opacity and scale, with two resets and random backgrounds."""
    numbers = {"reset_every": 40, "grad_threshold": 5e-5, "min_opacity": 0.02}
    return train_capture(recipe(120, random_background=True, **numbers, **SCHEDULE), events)


def train_mcmc(events):
    """Relocate, grow up to the cap, add noise, and regularise."""
    numbers = {"max_gaussians": 150, "min_opacity": 0.4, "mcmc_growth": 1.1}
    return train_capture(recipe(120, strategy="mcmc", **numbers, **SCHEDULE), events)


def train_fast(events):
    """Photos of 43, 48, 68 and 96 px, a planned number of Gaussians with pruning on the way, and rates that fall."""
    numbers = {"max_gaussians": 200, "min_opacity": 0.05, "densify_start": 5, "densify_every": 10}
    return train_capture(recipe(120, strategy="fast", **numbers), events, size=96)


def train_sphere(events):
    """A shorter version of the course's run, with more frequent densification and a cap that drops Gaussians."""
    config = course_config(iterations=120, max_gaussians=400)
    config = config.changed(densify_every=20, densify_stop=100)
    generator = torch.Generator().manual_seed(9)
    start = Start(random_ball(150, generator), extent=EXTENT, generator=generator)
    watch = [lambda _, event: events.append(event)]
    trainer = training(config, Views(SPHERE(40).train), load_backend("cpu"), start, callbacks=watch)
    return trainer, trainer.run()


CASES: dict[str, Callable] = {
    "adc": train_adc,
    "mcmc": train_mcmc,
    "fast": train_fast,
    "sphere": train_sphere,
}


def took_part(name: str, events: list) -> bool:
    """Return whether the training had the density control that the case is meant to test."""
    if name == "mcmc":
        moved = [event for event in events if isinstance(event, RelocateEvent)]
        return any(event.num_relocated for event in moved) and any(event.num_added for event in moved)
    changed = [event for event in events if isinstance(event, DensifyEvent)]
    densified = any(event.num_cloned or event.num_split_children for event in changed)
    if name == "sphere":
        return densified
    if name == "fast":
        return densified and any(event.num_pruned for event in changed) and changed[-1].num_gaussians > 150
    resets = sum(isinstance(event, ResetEvent) for event in events)
    return densified and resets == 2 and any(event.num_pruned for event in changed)


def digest(name: str) -> str:
    """Train, and return a hash of the bits of all parameters, losses and counts."""
    events = []
    trainer, result = CASES[name](events)
    assert took_part(name, events), [event for event in events if not isinstance(event, StepEvent)]
    found = hashlib.sha256()
    found.update(np.array(result.losses, dtype=np.float64).tobytes())
    found.update(np.array(result.counts, dtype=np.int64).tobytes())
    for key, tensor in trainer.gaussians.tensors().items():
        found.update(key.encode())
        found.update(np.ascontiguousarray(tensor.numpy(force=True)).tobytes())
    return found.hexdigest()


def compiler() -> str:
    """Return the compiler named in the native module's file. Other compilers may fuse other products and sums."""
    data = Path(kernels.native().__file__).read_bytes()
    found = re.search(rb"GCC: \([^)]*\) [\d.]+|clang version [\d.]+", data)
    return found[0].decode() if found else sys.platform


def arithmetic() -> str:
    """Return a name for everything besides our code that a training's bits depend on. A new name means another
    machine, not a bug. The libraries' exponentials, roots, matrix products and generators differ between CPUs. Their
    results are part of the name, so CPUs with equal results have the same name.
    """
    probe, rng = hashlib.sha256(), np.random.default_rng(0)
    numbers = rng.normal(size=4099)
    matrices = torch.from_numpy(rng.normal(size=(301, 3, 3)))
    with torch.no_grad():
        for tensor in (torch.from_numpy(numbers), torch.from_numpy(numbers).float()):
            for function in (torch.exp, torch.sigmoid, torch.abs, torch.lgamma):
                probe.update(function(tensor).numpy().tobytes())
            for function in (torch.log, torch.sqrt, torch.rsqrt):
                probe.update(function(tensor.abs() + 0.1).numpy().tobytes())
            probe.update(tensor.sum().numpy().tobytes() + tensor.norm().numpy().tobytes())
            probe.update(torch.cumsum(tensor, 0).numpy().tobytes())
        for some in (matrices, matrices.float()):
            probe.update((some @ some.mT).numpy().tobytes())
        drawn = torch.randn(4099, generator=torch.Generator().manual_seed(0))
        probe.update(drawn.numpy().tobytes())
    for function in (np.exp, np.sin, np.arctan, np.log1p):
        probe.update(function(np.abs(numbers)).tobytes())
    probe.update((matrices.numpy() @ matrices.numpy()).tobytes())
    capability = torch.backends.cpu.get_cpu_capability()
    return f"{kernels.native().isa()}, {compiler()}, torch {capability} {probe.hexdigest()[:16]}"


def recorded() -> dict[str, dict[str, str]]:
    """Read the known hashes: by arithmetic, then by case."""
    return json.loads(RECORDS.read_text())


def record() -> None:
    """Record this machine's hashes for each of its instruction sets."""
    found = recorded() if RECORDS.exists() else {}
    for isa in kernels.native().isas():
        env = {**os.environ, "GSPLAT_EDU_ISA": isa, "ATEN_CPU_CAPABILITY": CAPABILITIES[isa]}
        done = subprocess.run([sys.executable, __file__], env=env, capture_output=True, check=True)
        found |= json.loads(done.stdout)
    RECORDS.write_text(json.dumps(dict(sorted(found.items())), indent=2) + "\n")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="Print the hashes of this process as JSON.")
    parser.add_argument("--record", action="store_true", help="record the hashes of every instruction set")
    if parser.parse_args().record:
        record()
    else:
        print(json.dumps({arithmetic(): {name: digest(name) for name in CASES}}))
