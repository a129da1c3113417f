"""Makes checkpoints with damage to their bytes, tensors and numbers."""

import json
import struct
from pathlib import Path

import numpy as np
import torch
from safetensors import safe_open
from safetensors.torch import save_file

from gsplat_edu.data.procedural import procedural_capture
from gsplat_edu.render.backends import load_backend
from gsplat_edu.train.compose import Start, Views, training
from gsplat_edu.train.config import recipe
from gsplat_edu.train.initialize import from_points
from gsplat_edu.train.trainer import Trainer

SCHEDULE = {"densify_start": 0, "densify_every": 2, "densify_stop": 60, "mcmc_stop": 60, "sh_every": 2}
CONFIGS = {
    "adc": recipe(64, reset_every=3, max_gaussians=40, sh_degree=1, **SCHEDULE),
    "mcmc": recipe(64, strategy="mcmc", max_gaussians=40, sh_degree=1, random_background=True, **SCHEDULE),
    "fast": recipe(64, strategy="fast", max_gaussians=60, sh_degree=1, fast_stop=60, **SCHEDULE),
}


class Maker:
    """Makes equal tiny trainers with a given strategy.

    Args:
        strategy: The density strategy.
    """

    def __init__(self, strategy: str) -> None:
        self.config = CONFIGS[strategy]
        self.views, points, colors = procedural_capture(12, 3, splats=30)
        self.start = from_points(points, colors, self.config)

    def __call__(self) -> Trainer:
        begin = Start(self.start, extent=2.0)
        return training(self.config, Views(self.views), load_backend("cpu"), begin)


def step(trainer: Trainer, count: int = 1) -> None:
    end = trainer.iteration + count
    trainer.run(lambda: trainer.iteration >= end)


def read(path: Path) -> tuple[dict[str, torch.Tensor], dict[str, str]]:
    with safe_open(path, framework="pt") as file:
        return {name: file.get_tensor(name).clone() for name in file.keys()}, file.metadata()  # noqa: SIM118


def write(path: Path, tensors: dict[str, torch.Tensor], metadata: dict[str, str]) -> None:
    save_file({name: tensor.contiguous() for name, tensor in tensors.items()}, path, metadata)


DTYPES = (torch.float16, torch.bfloat16, torch.float64, torch.int32, torch.int64, torch.uint8, torch.bool)
POISONS = (float("nan"), float("inf"), -float("inf"), -1.0, 0.0, 1e-42, 3e38, -3e38, 1e20)
ODD = (None, True, False, -1, 0, 1, 63, 64, 65, 2**31, 2**63, 2**64, 2**128, 10**400, 0.5, 1e300, -0.0)
ODD += (
    float("nan"),
    float("inf"),
    "",
    "text",
    "\ud800",
    "1",
    [],
    [0],
    [[]],
    {},
    {"a": 1},
    [0, 0],
    [0, 1, 2, 3],
)


def changed_tensor(tensor: torch.Tensor, rng: np.random.Generator) -> torch.Tensor:
    """Change the dtype, shape or numbers of a tensor."""
    match int(rng.integers(0, 9)):
        case 0:
            return tensor.to(DTYPES[rng.integers(len(DTYPES))])
        case 1:
            return tensor[: int(rng.integers(0, len(tensor) + 1))] if tensor.ndim else tensor
        case 2:
            return torch.cat([tensor, tensor])
        case 3:
            return tensor.reshape(-1)
        case 4:
            return tensor[..., : int(rng.integers(0, 3))]
        case 5:
            return torch.zeros(())
        case 6:
            return torch.zeros([int(n) for n in rng.integers(0, 6, rng.integers(0, 6))], dtype=tensor.dtype)
        case 7 if tensor.is_floating_point() and tensor.numel():
            changed = tensor.flatten()
            changed[torch.from_numpy(rng.integers(0, len(changed), 3))] = POISONS[rng.integers(len(POISONS))]
            return changed.reshape(tensor.shape)
        case _ if tensor.numel():
            raw = tensor.contiguous().flatten().view(torch.uint8).clone()
            # the important fields of torch's generator states are at both ends
            reach = len(raw) if rng.random() < 0.5 else min(len(raw), 24)
            raw[torch.from_numpy(rng.integers(0, reach, 2))] = int(rng.integers(0, 256))
            return raw.view(tensor.dtype).reshape(tensor.shape)
    return tensor


def changed_json(value: object, rng: np.random.Generator) -> object:
    """Change one place in a JSON value: replace a value or remove an entry."""
    inside = isinstance(value, dict | list) and len(value) > 0 and rng.random() < 0.8
    if inside and isinstance(value, dict):
        key = sorted(value)[rng.integers(len(value))]
        if rng.random() < 0.1:
            return {k: v for k, v in value.items() if k != key}
        return value | {key: changed_json(value[key], rng)}
    if inside:
        at = int(rng.integers(len(value)))
        return [*value[:at], changed_json(value[at], rng), *value[at + 1 :]]
    if isinstance(value, int) and rng.random() < 0.3:
        return value + int(rng.integers(-3, 4))
    if rng.random() < 0.05:
        return NEST
    return ODD[rng.integers(len(ODD))]


NEST = "a placeholder for nesting too deep for Python's own JSON writer"


def spelled(value: object, rng: np.random.Generator) -> str:
    """Write JSON, with thousands of brackets in place of NEST."""
    depth = int(rng.integers(1, 6)) * 997
    return json.dumps(value).replace(json.dumps(NEST), "[" * depth + "]" * depth)


def mutate(data: bytes, path: Path, rng: np.random.Generator) -> None:
    """Write a checkpoint with damage to the bytes of its header or data, to its tensors, or to its numbers."""
    kind = int(rng.integers(0, 5))
    header_size = struct.unpack_from("<Q", data)[0]
    if kind == 0:  # bytes anywhere in the data
        damaged = bytearray(data)
        for at in rng.integers(8 + header_size, len(data), rng.integers(1, 6)):
            damaged[at] = int(rng.integers(0, 256))
        path.write_bytes(damaged[: int(rng.integers(0, len(damaged)))] if rng.random() < 0.1 else damaged)
    elif kind == 1:  # bytes in the header
        damaged = bytearray(data)
        for at in rng.integers(0, 8 + header_size, rng.integers(1, 3)):
            damaged[at] = int(rng.choice([rng.integers(0, 256), *b'0123456789"[]{},:-']))
        path.write_bytes(damaged)
    elif kind == 2:  # the header as JSON: other offsets, dtypes, shapes
        header = json.loads(data[8 : 8 + header_size])
        text = spelled(changed_json(header, rng), rng).encode("utf-8", "replace")
        path.write_bytes(struct.pack("<Q", len(text)) + text + data[8 + header_size :])
    else:
        path.write_bytes(data)
        tensors, metadata = read(path)
        if kind == 3:
            for name in rng.choice(sorted(tensors), int(rng.integers(1, 3)), replace=False):
                tensors[name] = changed_tensor(tensors[name], rng)
            if rng.random() < 0.1:
                del tensors[str(rng.choice(sorted(tensors)))]
            if rng.random() < 0.1:
                tensors[str(rng.choice(["more", "second.more", "density.", "gaussians.means.x"]))] = (
                    torch.ones(2)
                )
        else:
            entry = "seconds" if rng.random() < 0.1 else "state"
            metadata[entry] = spelled(changed_json(json.loads(metadata[entry]), rng), rng)
            if rng.random() < 0.05:
                del metadata[str(rng.choice(sorted(metadata)))]
        write(path, tensors, metadata)
