"""Inputs and expected results of the JavaScript tests, computed by the Python twins, NumPy and SciPy."""

import base64
import json
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from gsplat_edu.base import constants
from gsplat_edu.edits.apply import apply_operation, moved_together
from gsplat_edu.edits.cells import EditWork
from gsplat_edu.edits.membership import Values, members
from gsplat_edu.io.edit import IDENTITY
from gsplat_edu.io.scene import Scene
from gsplat_edu.io.sog import codec as sog
from gsplat_edu.io.sog.files import decode, write_bundle
from gsplat_edu.paths.curve import PathCurve
from gsplat_edu.scene.camera import look_at
from gsplat_edu.scene.gaussians import Gaussians
from gsplat_edu.scene.mesh import Mesh
from gsplat_edu.viewer.page_data import packed
from gsplat_edu.viewer.page_parts import SHADER_CONSTANTS
from js.camera_paths import PATHS
from js.random_edits import (
    NUMBER,
    gaussians_at,
    odd_arrays,
    parsed,
    random_moves,
    random_regions,
    random_spheres,
    witness,
)
from js.tilted_cameras import TILT, UP, around, rolled
from viewer.test_page_mesh import VIEW, ball, cast, rays


def numbers(array: np.ndarray) -> dict[str, str]:
    """Return an array for `arrayOf` in vectors.js: exact, also where it is NaN or infinite."""
    data = np.ascontiguousarray(array)
    return {"dtype": data.dtype.name, "base64": base64.b64encode(data.tobytes()).decode()}


def paths() -> list[dict[str, Any]]:
    """Return camera paths and their poses before, within and after them, and exactly at keyframes."""
    found = []
    for name, path in PATHS.items():
        curve = PathCurve(path)
        times = np.r_[
            np.linspace(-1.0, curve.seconds + 1.0, 53), [float(k.time or 0) for k in path.keyframes]
        ]
        eyes, rotations, fovs = curve.poses(times)
        found.append(
            {
                "name": name,
                "path": path.document(),
                "length": curve.length,
                "times": times.tolist(),
                "eyes": eyes.tolist(),
                "rotations": rotations.tolist(),
                "fovs": fovs.tolist(),
            }
        )
    return found


def regions() -> dict[str, Any]:
    """Return regions, the splats in each, and the number of tests that all of them take."""
    arrays = odd_arrays(rng := np.random.default_rng(0), NUMBER)
    chosen = random_regions(rng, 8)
    values = Values(**{name: array.astype(np.float64) for name, array in arrays.items()})
    edits = parsed([{"op": "select", "how": "add", **region} for region in chosen], NUMBER)
    work = EditWork()
    inside = [members(select.region, values, work) for select in edits.operations]
    return {
        "count": NUMBER,
        "arrays": {name: numbers(array.ravel()) for name, array in arrays.items()},
        "regions": chosen,
        "inside": [np.flatnonzero(one).tolist() for one in inside],
        "left": work.left,
    }


def near_means(spread: str, rng: np.random.Generator) -> np.ndarray:
    """Return centres that are odd numbers, exactly a radius apart, or so far apart that most are in outermost cells."""
    if spread == "grid":
        return rng.integers(-6, 7, (NUMBER, 3)).astype(np.float32)
    if spread == "far":
        wide = rng.normal(size=(NUMBER, 3)) * 10.0 ** rng.uniform(-8, 20, (NUMBER, 1))
        return wide.clip(-1e38, 1e38).astype(np.float32)
    return odd_arrays(rng, NUMBER)["means"]


def near(spread: str) -> dict[str, Any]:
    """Return growths and shrinkings of a selection, the states after each, and the tests left."""
    rng = np.random.default_rng(1)
    means = near_means(spread, rng)
    flags = rng.choice(np.array([0, 1, 2, 4], np.uint8), NUMBER, p=(0.6, 0.2, 0.1, 0.1))
    values = Values(
        means.astype(np.float64), *np.zeros((1, NUMBER, 3)), np.zeros(NUMBER), np.zeros((NUMBER, 3))
    )
    work, cases = EditWork(), []
    for _ in range(40):
        op = str(rng.choice(["grow", "shrink", "shrink"]))
        radius = float(rng.choice([1.0, 10.0 ** rng.uniform(-3, 0.3)]))
        (operation,) = parsed([{"op": op, "radius": radius}], NUMBER).operations
        after = flags.copy()
        apply_operation(operation, values, after, work)
        cases.append({"op": op, "radius": radius, "flags": after.tolist(), "left": work.left})
    return {"means": numbers(means.ravel()), "flags": flags.tolist(), "cases": cases}


def moves() -> list[dict[str, Any]]:
    """Return operations on splats, and the states and centres that a witness finds splat by splat."""
    means, cases = random_moves()
    found = []
    for operations in cases:
        flags, after = witness(operations, means)
        found.append(
            {
                "operations": operations,
                "means": numbers(means.ravel()),
                "flags": flags.tolist(),
                "after": numbers(after.ravel()),
            }
        )
    return found


def moved_parts() -> list[dict[str, Any]]:
    """Return operations on splats, and what the moves of all that are left do together."""
    rng = np.random.default_rng(5)
    means = (0.6 * rng.normal(size=(40, 3))).astype(np.float32)
    found = []
    for operations in (random_spheres(rng) for _ in range(12)):
        move, partly = moved_together(parsed(operations, 40).operations, gaussians_at(means))
        found.append(
            {
                "operations": operations,
                "means": numbers(means.ravel()),
                "R": move.R.tolist(),
                "t": move.t.tolist(),
                "stays": move is IDENTITY,
                "partly": partly,
            }
        )
    return found


def rotations() -> dict[str, Any]:
    """Return angles (tilt, heading, roll), and SciPy's rotation by roll about z, tilt about x and heading about y."""
    angles = np.random.default_rng(3).uniform((-1.5, -3.1, -3.1), (1.5, 3.1, 3.1), (40, 3))
    rows = Rotation.from_euler("YXZ", angles[:, [1, 0, 2]]).as_matrix()
    return {"angles": angles.tolist(), "rows": rows.tolist()}


def eigenvalues() -> list[dict[str, Any]]:
    """Return symmetric matrices and their eigenvalues by NumPy."""
    rng = np.random.default_rng(1)
    matrices = [a @ a.T for a in rng.normal(size=(30, 3, 3))] + [np.diag([3.0, 1.0, 2.0]), np.zeros((3, 3))]
    return [{"matrix": m.tolist(), "values": np.linalg.eigvalsh(m).tolist()} for m in matrices]


def tilts() -> dict[str, Any]:
    """Return cameras in a tilted scene: level ones, ones with rolls of 4 degrees, portraits, and undecided ones."""

    def turns(cameras: list) -> list:
        return [R.tolist() for R, _ in cameras]

    rng = np.random.default_rng(2)
    series = [
        {
            "directions": directions,
            "photos": [turns(around(n, turn, rolls=rng.normal(0, np.radians(4), n))) for _ in range(60)],
        }
        for n, turn, directions in ((60, 2 * np.pi, 2), (60, 1.6, 1))
    ]
    portraits = np.random.default_rng(4)

    def photos(share: float, turn: float = 2 * np.pi) -> list:
        rolls = portraits.normal(0, np.radians(1), 200)
        rolls[portraits.permutation(200)[: round(share * 200)]] += np.pi / 2
        return turns(around(200, turn, rolls=rolls))

    few = photos(0.05)
    forward = look_at(np.array((0.0, 0.0, -3.0)), np.zeros(3)) @ TILT.T
    down = [(rolled(look_at((0.0, -3.0, 1e-6), np.zeros(3)), x) @ TILT.T, None) for x in range(6)]
    level = (around(12), around(40, 1.0), around(9, height=-2.9), around(5, 3.0))
    return {
        "up": UP.tolist(),
        "level": [turns(cameras) for cameras in level],
        "rolled": series,
        "few": few,
        "differently": [
            *(photos(share, turn) for share, turn in ((0.5, 2 * np.pi), (0.5, 0.3), (0.35, 2 * np.pi))),
            turns(around(40, rolls=np.where(np.arange(40) % 2, 0, np.pi))),  # half of them upside down
            turns(down),  # from straight above, whether the camera looks up or down is undecided
        ],
        "row": turns([(forward, None)] * 20),
        "two": turns(around(2)),
    }


def order() -> dict[str, Any]:
    """Return centres, many at equal or nearly equal depths, and NumPy's order by float32 depth, far to near."""
    rng = np.random.default_rng(0)
    means = (np.round(0.6 * rng.normal(size=(20_000, 3)) * 8) / 8).astype(np.float32)
    means[:5000] = rng.normal(size=(5000, 3)).astype(np.float32) * 1e-3
    means[5000:5010] = np.nan
    means[5010:5020, 2] = -0.48  # nearer than the near plane
    depths = (means[:, 2].astype(np.float64) + 0.5).astype(np.float32)
    seen = np.flatnonzero(depths > 0.05)
    order = seen[np.argsort(depths[seen], kind="stable")][::-1]
    return {"means": numbers(means.ravel()), "order": numbers(order.astype(np.uint32))}


def sample() -> dict[str, Any]:
    """Return splats of different size and opacity, and the area and weight of each."""
    rng = np.random.default_rng(6)
    n = 15_000
    log_scales = (0.7 * rng.normal(size=(n, 3)) - 3.2).astype(np.float32)
    logits = (2 * rng.normal(size=n)).astype(np.float16)
    scales = np.exp(log_scales.astype(float))
    area = scales.prod(axis=1) / scales.min(axis=1)
    return {
        "means": numbers((0.2 * rng.normal(size=(n, 3))).astype(np.float32).ravel()),
        "log_scales": numbers(log_scales.ravel()),
        "logits": numbers(logits.view(np.uint16)),
        "area": numbers(area),
        "weight": numbers(np.sqrt(area / (1 + np.exp(-logits.astype(float))))),
    }


def packed_scene() -> dict[str, Any]:
    """Return packed splats of degree 2, and the arrays that the page finds in them."""
    generator = torch.Generator().manual_seed(3)
    shapes = {"means": (7, 3), "quats": (7, 4), "log_scales": (7, 3), "sh0": (7, 1, 3), "sh_rest": (7, 8, 3)}
    tensors = {name: torch.randn(shape, generator=generator) for name, shape in shapes.items()}
    gaussians = Gaussians(**tensors, logit_opacities=torch.randn(7, generator=generator))
    quats = tensors["quats"].double().numpy()
    quats = np.round(32767 * quats / np.linalg.norm(quats, axis=1, keepdims=True)).astype(np.int16)
    sh = torch.cat([tensors["sh0"], tensors["sh_rest"]], dim=1).half().numpy()
    return {
        "facts": {"count": 7, "sh_degree": 2},
        "packed": base64.b64encode(packed(gaussians)).decode(),
        "means": numbers(tensors["means"].numpy().ravel()),
        "log_scales": numbers(tensors["log_scales"].numpy().ravel()),
        "quats": numbers(quats.ravel()),
        "sh": numbers(sh.view(np.uint16).ravel()),
        "logit_opacities": numbers(gaussians.logit_opacities.half().numpy().view(np.uint16)),
    }


def streamed_run() -> dict[str, Any]:
    """Return the images of a SOG, as a browser decodes them, and what Python reads from it."""
    generator = torch.Generator().manual_seed(4)
    shapes = {"means": (300, 3), "quats": (300, 4), "log_scales": (300, 3), "sh0": (300, 1, 3)}
    tensors = {name: torch.randn(shape, generator=generator) for name, shape in shapes.items()}
    tensors["sh_rest"] = 0.3 * torch.randn((300, 8, 3), generator=generator)
    opacities = 3 * torch.randn(300, generator=generator)
    gaussians = Gaussians(**tensors, logit_opacities=opacities)
    contents = sog.packed(Scene(gaussians), sort=False)
    with TemporaryDirectory() as folder:
        path = Path(folder) / "scene.sog"
        write_bundle(path, contents)
        scene = sog.read(path).gaussians
        images = {
            name: decode(path, name, data).reshape(-1)
            for name, data in contents.items()
            if name.endswith(".webp")
        }
    return {
        "count": 300,
        "meta": json.loads(contents["meta.json"]),
        "images": {name: numbers(pixels) for name, pixels in images.items()},
        "means": scene.means.tolist(),
        "log_scales": numbers(scene.log_scales.numpy().ravel()),
        "quats": (32767 * scene.quats.double()).tolist(),
        "sh": numbers(torch.cat([scene.sh0, scene.sh_rest], dim=1).half().numpy().view(np.uint16).ravel()),
        "logit_opacities": scene.logit_opacities.tolist(),
    }


def mesh_rays() -> dict[str, Any]:
    """Return a mesh, rays from a camera's eye, and the depths at which NumPy finds it; None for a miss."""
    mesh = Mesh(ball().vertices.astype(np.float32).astype(np.float64), ball().faces)
    columns, rows = np.random.default_rng(2).uniform((20, 20), (160, 100), (300, 2)).T
    directions = rays(VIEW, columns, rows)
    face, depths, _ = cast(mesh, np.broadcast_to(VIEW.eye, directions.shape), directions)
    return {
        "positions": numbers(mesh.vertices.astype(np.float32).ravel()),
        "faces": mesh.faces.tolist(),
        "eye": VIEW.eye.tolist(),
        "directions": directions.tolist(),
        "depths": [depth if hit >= 0 else None for hit, depth in zip(face, depths.tolist(), strict=True)],
    }


def shader_constants() -> dict[str, float]:
    """Return those constants of the shaders that are single numbers."""
    values = {name: getattr(constants, name) for name in SHADER_CONSTANTS}
    return {name: value for name, value in values.items() if not isinstance(value, tuple)}


VECTORS: dict[str, Callable[[], Any]] = {
    "paths": paths,
    "regions": regions,
    "near-odd": lambda: near("odd"),
    "near-grid": lambda: near("grid"),
    "near-far": lambda: near("far"),
    "moves": moves,
    "moved-parts": moved_parts,
    "rotations": rotations,
    "eigenvalues": eigenvalues,
    "tilts": tilts,
    "order": order,
    "sample": sample,
    "packed-scene": packed_scene,
    "streamed-run": streamed_run,
    "mesh-rays": mesh_rays,
    "constants": shader_constants,
}
"""By name; vectors.js reads them from a folder."""
