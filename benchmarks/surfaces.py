"""How far from the true surface are the depths of trained scenes, with and without the setting `surface`?

    python benchmarks/surfaces.py [--captures NAME ...] [--iterations N] [--seed S] [--smoke] [--out FILE.json]

Captures: the textured box, and the solids with textured, plain and glossy surfaces (lab/captures). Each is trained by
the recipe `fast`, from start points that are off the surface by 0.01. Median depths of the training views are compared
with the true ones at each pixel, and as points in space with the true surface: F1 at 0.01 world units, where only
surface that a photo sees counts for recall. Ground far from the objects is left out. Then each scene is meshed, and the
mesh compared. Last, the mesh gets a texture of the photos. It is drawn from held-out cameras between the training's,
and compared with their photos at the pixels that it covers, beside renders of the splats at the same pixels.
"""

from __future__ import annotations

import dataclasses
import functools
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import hardware
import numpy as np
import torch

from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.cli.running import run_command
from gsplat_edu.evaluate.metrics import score_views, summarize
from gsplat_edu.evaluate.surface import Comparison, Counts, score_points, score_surface, visible_points
from gsplat_edu.mesh.extract import MeshResult, extract_mesh
from gsplat_edu.mesh.raster import Raster, picture, rasterized
from gsplat_edu.mesh.texture import TextureSettings, TextureView, textured
from gsplat_edu.mesh.tidy import TidySettings, tidied
from gsplat_edu.render.api import render
from gsplat_edu.render.backends import load_backend
from gsplat_edu.render.maps import render_maps
from gsplat_edu.render.settings import RenderSettings
from gsplat_edu.scene.camera import Camera
from gsplat_edu.scene.gaussians import Gaussians
from gsplat_edu.scene.mesh import Mesh
from gsplat_edu.scene.views import View
from gsplat_edu.train.compose import training
from gsplat_edu.train.config import recipe
from lab.captures.solids import Part, SolidScene
from lab.captures.solids_mesh import solids_mesh
from lab.captures.solids_photos import (
    FINISHES,
    START_NOISE,
    photograph_solids,
    scan_solids,
    solids_capture,
    solids_orbit,
)
from lab.captures.solids_shapes import Block
from lab.captures.textured_box import box_orbit, photograph_box

TAU = 0.01
"""Threshold of F1, world units. A point of the truth is seen if it is at most this far behind the true depth."""

POINTS = 400_000
"""Number of points from depth maps that are compared; so dense that gaps between them do not limit recall."""

HELD_OUT = 8
"""Number of cameras that the texture is compared from."""

TEXTURE_FACES = 50_000
"""Faces of a mesh with a texture, as those of `gsplat-edu mesh --texture`."""

TEXTURES = {
    "best of three": TextureSettings(),
    "best photo": TextureSettings(best=1),
}
"""Textures that are compared."""

CAPTURES = ("box", *FINISHES)
"""Names of the captures."""


@dataclass(frozen=True, eq=False)
class Capture:
    """Views to train on, and the truth. `training` takes it as its dataset.

    Args:
        train: The views.
        points: (N, 3) start points, world units.
        colors: (N, 3) their colours, 0 to 1.
        scans: True depth (H, W) and normals (H, W, 3) of each view.
        truth: The true surface.
        bounds: (2, 3) corners of the box that is compared.
        held_out: Views between those of the training, from which textures are compared.
    """

    train: list[View]
    points: np.ndarray
    colors: np.ndarray
    scans: list[tuple[np.ndarray, np.ndarray]]
    truth: Mesh
    bounds: np.ndarray
    held_out: Sequence[View]

    @functools.cached_property
    def cameras(self) -> list[Camera]:
        """The cameras of the views."""
        return [view.camera for view in self.train]


class Depths(NamedTuple):
    """What a scene's depth maps say."""

    points: np.ndarray  # (N, 3) world units
    errors: np.ndarray  # |depth - true depth| at the pixels that have both, world units
    angles: np.ndarray  # angle between normal and true normal at these pixels, degrees
    missing: float  # fraction of the pixels with true depth that have none


def solids_of(finish: str, size: int, count: int, seed: int, step: float) -> Capture:
    """Make the capture of the solids with a finish; `step` is the edge of the truth's triangles."""
    made = solids_capture(finish, size, count, seed=seed)
    scans = [(photo.depth, photo.normals) for photo in made.photos]
    bounds = np.array([[-1.35, -1.2, -1.35], [1.35, 0.03, 1.35]])
    between = between_views(solids_orbit(2 * count, (size, 3 * size // 4)))
    held_out = [View(c, photograph_solids(made.scene, c, finish).image, name="between") for c in between]
    truth = solids_mesh(made.scene, step)
    return Capture(made.views, made.points, made.colors, scans, truth, bounds, held_out=held_out)


def box_of(size: int, count: int, seed: int, step: float) -> Capture:
    """Make the capture of the textured box; its truth are two blocks."""
    floor = Block(np.array([0.0, 0.05, 0.0]), np.array([4.0, 0.05, 4.0]))
    body = Block(np.array([0.0, -0.475, 0.0]), np.array([0.7, 0.525, 0.5]))
    scene = SolidScene((Part("floor", floor), Part("box", body)))
    cameras = box_orbit(count, size=(size, 3 * size // 4))
    views = [
        View(camera, photograph_box(camera), name=f"view_{i:03d}.png") for i, camera in enumerate(cameras)
    ]
    scans = [scan_solids(scene, camera)[:2] for camera in cameras]
    rng = np.random.default_rng(seed)
    points, colors = [], []
    for view, (depth, _) in zip(views, scans, strict=True):
        pixels = rng.choice(np.flatnonzero(depth), 4_000 // count)
        points.append(lifted(view.camera, depth).reshape(-1, 3)[pixels])
        colors.append(view.image.reshape(-1, 3)[pixels] / 255.0)
    exact = np.concatenate(points)
    noisy = exact + START_NOISE * rng.normal(size=exact.shape)
    bounds = np.array([[-1.5, -1.1, -1.5], [1.5, 0.03, 1.5]])
    between = between_views(box_orbit(2 * count, size=(size, 3 * size // 4)))
    held_out = [View(camera, photograph_box(camera), name="between") for camera in between]
    truth = solids_mesh(scene, step)
    return Capture(views, noisy, np.concatenate(colors), scans, truth, bounds, held_out=held_out)


def between_views(cameras: list[Camera]) -> list[Camera]:
    """Return at most `HELD_OUT` of the odd ones among twice as many cameras as the training has."""
    odd = cameras[1::2]
    return odd[:: max(len(odd) // HELD_OUT, 1)][:HELD_OUT]


def lifted(camera: Camera, depth: np.ndarray) -> np.ndarray:
    """Return the point in space of each pixel, (H, W, 3), world units."""
    u, v = np.meshgrid(np.arange(camera.W), np.arange(camera.H))
    seen = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones(u.shape)], axis=-1)
    return np.asarray(camera.eye + (depth[..., None] * seen) @ camera.R)


def inside(points: np.ndarray, bounds: np.ndarray) -> np.ndarray:
    """Return which points are in a box."""
    return np.asarray(((points >= bounds[0]) & (points <= bounds[1])).all(axis=-1))


def depths_of(capture: Capture, trainer: Any, settings: RenderSettings) -> Depths:  # noqa: ANN401
    """Render the training views' depths and normals, and compare them with the true ones."""
    points, errors, angles, missing, asked = [], [], [], 0, 0
    for camera, (true, normals) in zip(capture.cameras, capture.scans, strict=True):
        maps, _ = render_maps(trainer.gaussians, camera, ("median-depth", "normal"), settings, "cpu")
        depth = maps["median-depth"].detach().numpy().astype(np.float64)
        found = lifted(camera, depth)
        points.append(found[(depth > 0) & inside(found, capture.bounds)])
        wanted = (true > 0) & inside(lifted(camera, true), capture.bounds)
        both = wanted & (depth > 0)
        asked, missing = asked + int(wanted.sum()), missing + int((wanted & ~both).sum())
        errors.append(np.abs(depth - true)[both])
        cosine = (maps["normal"].detach().numpy() * normals).sum(axis=-1)[both]
        angles.append(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))))
    return Depths(
        np.concatenate(points), np.concatenate(errors), np.concatenate(angles), missing / max(asked, 1)
    )


def measure_one(capture: Capture, iterations: int, seed: int, surface: bool) -> dict[str, Any]:
    """Train one scene and compare it with the truth."""
    changes: dict[str, Any] = {"surface": True} if surface else {}
    config = recipe(iterations, strategy="fast", seed=seed, **changes)
    trainer = training(config, capture, load_backend("cpu"))
    began = time.perf_counter()
    trainer.run()
    seconds = time.perf_counter() - began
    settings = RenderSettings(config.background, jacobian_limit=config.jacobian_limit)
    shown = functools.partial(render, settings=settings, backend="cpu")
    psnr = summarize(score_views(trainer.gaussians, capture.train, shown, config.background))["psnr"]
    depths = depths_of(capture, trainer, settings)
    row: dict[str, Any] = {
        "splats": len(trainer.gaussians),
        "ms per step": 1e3 * seconds / iterations,
        "psnr of training views": psnr,
        "depth missing": depths.missing,
    }
    if not len(depths.points) or not len(depths.errors):
        return row
    rng = np.random.default_rng(seed)
    chosen = rng.choice(len(depths.points), min(POINTS, len(depths.points)), replace=False)
    counts = functools.partial(
        visible_points,
        cameras=capture.cameras,
        depths=[depth for depth, _ in capture.scans],
        tolerance=TAU,
    )
    comparison = Comparison(TAU, seed=seed, bounds=capture.bounds)
    scores = score_points(depths.points[chosen], capture.truth, comparison, counts)
    row |= mesh_scores(capture, trainer.gaussians, settings, comparison, counts)
    return row | {
        "depth error mean": float(depths.errors.mean()),
        "depth error median": float(np.median(depths.errors)),
        "normals, degrees": float(depths.angles.mean()),
        "accuracy": scores.accuracy,
        "completeness": scores.completeness,
        "precision": scores.precision,
        "recall": scores.recall,
        "f1": scores.f1,
    }


def mesh_scores(
    capture: Capture,
    gaussians: Gaussians,
    settings: RenderSettings,
    comparison: Comparison,
    counts: Counts,
) -> dict[str, Any]:
    """Mesh a trained scene and compare it with the truth: at the threshold of the depths, and at one voxel."""
    cameras = [(view.name, view.camera) for view in capture.train]
    began = time.perf_counter()
    try:
        found = extract_mesh(gaussians, cameras, settings, load_backend("cpu"))
    except ArgumentError:  # a training of a few steps has no surface
        return {"mesh faces": 0}
    seconds = time.perf_counter() - began
    scores = score_surface(found.mesh, capture.truth, comparison, counts)
    at_voxel = score_surface(
        found.mesh, capture.truth, dataclasses.replace(comparison, tau=found.voxel), counts
    )
    return texture_scores(capture, found, gaussians, settings) | {
        "mesh faces": len(found.mesh.faces),
        "mesh seconds": seconds,
        "mesh voxel": found.voxel,
        "mesh f1": scores.distances.f1,
        "mesh f1 at a voxel": at_voxel.distances.f1,
        "mesh accuracy": scores.distances.accuracy,
        "mesh completeness": scores.distances.completeness,
        "mesh normals, degrees": scores.normal_degrees,
    }


def texture_scores(
    capture: Capture, found: MeshResult, gaussians: Gaussians, settings: RenderSettings
) -> dict[str, Any]:
    """Paint the mesh, and compare it with held-out photos at the pixels that it covers, beside the splats."""
    near = inside(found.mesh.corners.reshape(-1, 3), capture.bounds).reshape(-1, 3).all(axis=1)
    cut = Mesh(
        found.mesh.vertices, found.mesh.faces[near], found.mesh.colors
    ).used()  # the backdrop hides objects
    if not len(cut.faces):
        return {}
    mesh = tidied(cut, TidySettings(faces=TEXTURE_FACES, smoothing=0))  # it is smooth already
    photos = {view.name: view.image for view in capture.train}
    views = [TextureView(view.camera, photos[view.name], view.depth) for view in found.views]
    rasters = [rasterized(mesh, view.camera) for view in capture.held_out]
    shown = functools.partial(render, settings=settings, backend="cpu")
    renders = [
        255.0 * shown(gaussians, view.camera).image.detach().clamp(0, 1).numpy() for view in capture.held_out
    ]
    row = {
        "covered": float(np.mean([raster.covered.mean() for raster in rasters])),
        "splats there, dB": covered_psnr(capture.held_out, rasters, renders),
    }
    for name, texture in TEXTURES.items():
        began = time.perf_counter()
        painted = textured(mesh, views, dataclasses.replace(texture, size=4 * views[0].camera.W))
        drawn = [picture(painted, raster, (0, 0, 0)) for raster in rasters]
        row[f"texture, {name}, dB"] = covered_psnr(capture.held_out, rasters, drawn)
        row[f"texture, {name}, seconds"] = time.perf_counter() - began
    return row


def covered_psnr(views: Sequence[View], rasters: list[Raster], images: list[np.ndarray]) -> float:
    """Return the PSNR of images at the pixels that the mesh covers, of all views together, dB."""
    squares = [
        ((image.astype(np.float64) - view.image)[raster.covered] ** 2).ravel()
        for view, raster, image in zip(views, rasters, images, strict=True)
    ]
    return float(10.0 * np.log10(255.0**2 / np.concatenate(squares).mean()))


def measure(arguments: Any) -> dict[str, Any]:  # noqa: ANN401
    """Train and compare every capture."""
    size, count, step = (32, 6, 0.06) if arguments.smoke else (320, 32, 0.015)
    iterations = 10 if arguments.smoke else arguments.iterations
    table: dict[str, Any] = {"iterations": iterations}
    for name in arguments.captures:
        began = time.perf_counter()
        make = box_of if name == "box" else functools.partial(solids_of, name)
        capture = make(size, count, arguments.seed, step)
        print(f"{name}: {count} photos and {capture.truth} in {time.perf_counter() - began:.1f} s")
        for surface in (False, True):
            row = measure_one(capture, iterations, arguments.seed, surface)
            table[f"{name}, surface {'on' if surface else 'off'}"] = row
            print(
                f"  surface {'on ' if surface else 'off'} "
                + ", ".join(f"{k} {v:.4g}" for k, v in row.items())
            )
    return table


def main() -> int:
    """Read the command line and measure."""
    parser = hardware.parser(__doc__.partition("\n")[0])
    parser.add_argument("--captures", nargs="+", choices=CAPTURES, default=CAPTURES, help="default: all")
    parser.add_argument("--iterations", type=int, default=2_000, help="steps (default: %(default)s)")
    parser.add_argument("--seed", type=int, default=0, help="seed (default: %(default)s)")
    parser.add_argument("--threads", type=int, help="threads (default: torch's choice)")
    arguments = parser.parse_args()
    if arguments.threads is not None:
        torch.set_num_threads(arguments.threads)

    def run() -> None:
        hardware.report({"surfaces": measure(arguments)}, arguments.out)

    return run_command("surfaces.py", run, debug=False)


if __name__ == "__main__":
    sys.exit(main())
