"""Operations, regions and splats with numbers of all kinds, for both languages."""

import json

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from gsplat_edu.edits.apply import DELETED, SELECTED
from gsplat_edu.edits.document import parse_edits
from gsplat_edu.edits.identity import Identity
from gsplat_edu.edits.runs import runs_of
from gsplat_edu.scene.gaussians import Gaussians

NUMBER = 400
"""Splats of random values, many of which are odd."""


def random_regions(rng, count):
    """Return regions as in a file, with numbers of all kinds: whole, tiny, huge, and equal to those of splats."""

    def numbers(n, spread=1.0):
        return (spread * rng.normal(size=n)).round(int(rng.integers(0, 17))).tolist()

    def rotation():
        return Rotation.random(random_state=int(rng.integers(1 << 30))).as_matrix().tolist()

    def camera():
        at = numbers(3, 2.0)
        sizes = dict(zip(("fx", "fy", "cx", "cy"), rng.uniform(10, 300, 4).tolist(), strict=True))
        return {"position": at, "rotation": rotation(), **sizes, "width": 300, "height": 200}

    made = []
    for _ in range(count):
        u0, u1, v0, v1 = *np.sort(rng.uniform(-50, 350, 2)), *np.sort(rng.uniform(-50, 250, 2))
        low, high = sorted(numbers(2))
        points = rng.uniform(-20, 320, (int(rng.integers(3, 40)), 2))
        half = np.abs(numbers(3)) + 0.01
        columns, rows = rng.integers(1, 20, 2).tolist()
        deepest = [None if rng.random() < 0.2 else float(z) for z in rng.uniform(0, 5, rows * columns)]
        front = {"bounds": [u0, v0, u1 + 1, v1 + 1], "columns": columns, "rows": rows, "deepest": deepest}
        made += [
            {"by": "rectangle", "camera": camera(), "corners": [float(x) for x in (u0, v0, u1, v1)]},
            {"by": "lasso", "camera": camera(), "points": points.tolist()},
            {"by": "lasso", "camera": camera(), "points": points.round().tolist()},
            {
                "by": "brush",
                "camera": camera(),
                "radius": 10.0,
                "points": points[: len(points) // 3 + 1].tolist(),
            },
            {"by": "rectangle", "camera": camera(), "corners": [-1e6, -1e6, 1e6, 1e6], "front": front},
            {"by": "lasso", "camera": camera(), "points": points.tolist(), "front": front},
            {"by": "brush", "camera": camera(), "radius": 40.0, "points": points.tolist(), "front": front},
            {"by": "sphere", "center": numbers(3), "radius": float(10.0 ** rng.uniform(-2, 30))},
            {"by": "sphere", "center": [0, 0, 0], "radius": 1},
            {"by": "box", "center": numbers(3), "rotation": rotation(), "half": half.tolist()},
            {"by": "color", "low": [-1, low, -1e6], "high": [1, 1e6, high]},
            {"by": "opacity", "low": low},
            {"by": "size", "low": low, "high": high},
            {"by": "distance", "center": numbers(3), "low": abs(low), "high": abs(low) + abs(high)},
            {"by": "distance", "center": [0, 0, 0], "high": 1},
            {"by": "list", "reason": "", "runs": runs_of(rng.random(NUMBER) < 0.3)},
        ]
    return made


def odd_arrays(rng, n):
    """Return the values of splats with NaN, infinite, denormal and huge numbers."""
    odd = np.array([np.nan, np.inf, -np.inf, 3e38, -1e-45, 0.0, 1.0, -1.0, 0.1], dtype=np.float32)

    def mixed(*shape):
        values = rng.normal(size=shape).astype(np.float32)
        where = rng.random(shape) < 0.15
        values[where] = rng.choice(odd, int(where.sum()))
        return values

    means = mixed(n, 3)
    means[:6] = [*np.eye(3), *-np.eye(3)]  # on the border of the sphere around zero with a radius of 1
    return {"means": means, "log_scales": mixed(n, 3), "logits": mixed(n), "sh0": mixed(n, 3)}


def parsed(operations, count):
    """Read operations as from a file of a scene with a number of splats."""
    scene = Identity(count, "ab" * 32, (0.0, 0.0, 0.0)).document()
    content = {"format": "gsplat_edu edits", "version": 1, "scene": scene, "operations": operations}
    return parse_edits(json.dumps(content).encode(), "e.json")


def moved_one_by_one(operation, mean):
    """Return a moved mean, by the order of operations in docs/EDITS.md."""
    offset = [float(x) - c for x, c in zip(mean, operation["center"], strict=True)]
    result = []
    for row, c, t in zip(operation["rotation"], operation["center"], operation["translation"], strict=True):
        total = row[0] * offset[0]
        total = total + row[1] * offset[1]
        total = total + row[2] * offset[2]
        result.append(float(np.float32((total + c) + t)))
    return result


STEPS = 40


def random_operations(seed):
    """Return selections, moves and deletions; later selections see moved splats. Some turn by 1e-9 about a point at
    1e9, so that float64 rounds in digits of the float32 means, and another order of the sums gives other means."""
    rng = np.random.default_rng(seed)
    made = []
    for _ in range(STEPS):
        center = rng.normal(0, 0.6, 3).tolist()
        region = {"by": "sphere", "center": center, "radius": float(rng.uniform(0.2, 0.8))}
        made.append(
            {"op": "select", "how": str(rng.choice(["replace", "add", "intersect", "subtract"])), **region}
        )
        rotation = Rotation.random(random_state=int(rng.integers(1 << 30))).as_matrix().tolist()
        by = rng.normal(0, 0.3, 3).tolist()
        if rng.random() < 0.3:
            rotation = Rotation.from_rotvec(rng.normal(0, 1e-9, 3)).as_matrix().tolist()
            center = rng.normal(0, 1e9, 3).tolist()
        made.append({"op": "move", "rotation": rotation, "translation": by, "center": center})
        if rng.random() < 0.15:
            made.append({"op": str(rng.choice(["delete", "hide", "invert", "show"]))})
    return made


def witness(operations, means):
    """Return states and means after selections by spheres, moves and changes of states, splat by splat."""
    means = [[float(x) for x in mean] for mean in means]
    flags = [0] * len(means)
    for operation in operations:
        for i, (flag, (x, y, z)) in enumerate(zip(list(flags), list(means), strict=True)):
            op = operation["op"]
            if op == "select" and flag <= SELECTED:
                (a, b, c), r = operation["center"], operation["radius"]
                inside = ((x - a) * (x - a) + (y - b) * (y - b)) + (z - c) * (z - c) <= r * r
                old = bool(flag)
                flags[i] = int(
                    {
                        "replace": inside,
                        "add": old or inside,
                        "intersect": old and inside,
                        "subtract": old and not inside,
                    }[operation["how"]]
                )
            elif op == "move" and flag == SELECTED:
                means[i] = moved_one_by_one(operation, means[i])
            elif op == "delete" and flag == SELECTED:
                flags[i] = DELETED
            elif op == "hide" and flag == SELECTED:
                flags[i] = 2
            elif op == "invert" and flag <= SELECTED:
                flags[i] = 1 - flag
            elif op == "show" and flag == 2:
                flags[i] = 0
    return np.array(flags), np.array(means)


def random_moves():
    """Return the means of 250 splats, (250, 3) float32, and three lists of operations on them."""
    means = 0.6 * np.random.default_rng(11).normal(size=(250, 3))
    return means.astype(np.float32), [random_operations(seed) for seed in range(3)]


def random_spheres(rng):
    """Return moves of small or large spheres; some of the splats in a small one are hidden or deleted."""
    made = []
    for _ in range(5):
        wide = float(rng.choice([0.8, 50.0], p=[0.3, 0.7]))
        region = {"by": "sphere", "center": rng.normal(0, 0.3, 3).tolist(), "radius": wide}
        R = Rotation.random(random_state=int(rng.integers(1 << 30))).as_matrix().tolist()
        made += [{"op": "select", "how": "replace", **region}]
        made += [{"op": str(rng.choice(["hide", "delete", "show"]))}] if wide < 1 else []
        by, center = rng.normal(0, 0.2, 3).tolist(), rng.normal(0, 1, 3).tolist()
        made += [{"op": "move", "rotation": R, "translation": by, "center": center}]
    return made


def gaussians_at(means):
    """Return Gaussians with these means, (N, 3) float32, of which nothing else matters."""
    n = len(means)
    return Gaussians(
        means=torch.from_numpy(means),
        quats=torch.tensor([1.0, 0, 0, 0]).repeat(n, 1),
        log_scales=torch.full((n, 3), -3.0),
        sh0=torch.zeros(n, 1, 3),
        sh_rest=torch.zeros(n, 0, 3),
        logit_opacities=torch.zeros(n),
    )
