"""The WebAssembly module against the package: images, gradients, the recipe, and what it refuses."""

import gzip
import math

import numpy as np
import pytest

import build_wasm
import generate_recipe
import run
from gsplat_edu.render.camera_tensors import INTRINSICS
from gsplat_edu.scene.camera import Camera
from gsplat_edu.scene.intrinsics import Intrinsics
from gsplat_edu.scene.projection import Distortion, Projection
from gsplat_edu.scene.rig import scene_extent
from gsplat_edu.scene.shutter import RollingShutter, readout_axis, readout_pace
from gsplat_edu.train.capacity import planned_gaussians
from gsplat_edu.train.config import recipe
from wasm_host import EngineError, Host

MOST_BYTES = 1_500_000
"""Bound of the module, gzipped."""


class Renderer:
    """The module as the two functions that the conformance kit takes."""

    def __init__(self, host, dtype):
        self.host, self.dtype = host, dtype

    def render(self, gaussians, camera, settings):
        out = self._ask(gaussians, camera, settings, None)
        images = {name: out[name] for name in run.OUTPUTS if name in out}
        return _shaped(images | {"alpha": 1 - out["transmittance"]}, gaussians, camera)

    def gradients(self, gaussians, camera, settings, upstream):
        given = dict(upstream)
        if "alpha" in given:
            given["transmittance"] = given.get("transmittance", 0) - given.pop("alpha")
        given = {name: _flat(array, self.dtype) for name, array in given.items()}
        found = self._ask(gaussians, camera, settings, given)["gradients"]
        count = len(gaussians["means"])
        numbers = found.pop("camera")
        sh = np.concatenate(
            [found.pop("sh0").reshape(count, 1, 3), found.pop("sh_rest").reshape(count, -1, 3)], 1
        )
        shapes = {name: array.shape for name, array in gaussians.items()} | {"background": (3,)}
        result = {name: array.reshape(shapes[name]).astype(np.float64) for name, array in found.items()}
        result |= {"sh": sh.astype(np.float64), "R": numbers[:9].reshape(3, 3), "eye": numbers[9:12]}
        result |= dict(zip(INTRINSICS, numbers[12:16], strict=True))
        if len(numbers) > 16:
            result |= {"distortion": numbers[16:31], "turn": numbers[31:34], "shift": numbers[34:37]}
        return result

    def _ask(self, gaussians, camera, settings, upstream):
        sh = gaussians["sh"]
        arrays = {name: _flat(array, self.dtype) for name, array in gaussians.items() if name != "sh"}
        arrays |= {"sh0": _flat(sh[:, :1], self.dtype), "sh_rest": _flat(sh[:, 1:], self.dtype)}
        chosen = {
            "rest": sh.shape[1] - 1,
            "background": list(map(float, settings["background"])),
            "shDegree": int(min(settings["sh_degree"], math.isqrt(sh.shape[1]) - 1)),
            "antialiased": bool(settings["antialiased"]),
            "alphaMax": float(settings["alpha_max"]),
            "zNear": float(settings["z_near"]),
        }
        numbers = camera_numbers(camera, settings["jacobian_limit"])
        return self.host.ask("render", gaussians=arrays, camera=numbers, settings=chosen, upstream=upstream)


def _flat(array, dtype):
    return np.ascontiguousarray(array, dtype).ravel()


def _shaped(images, gaussians, camera):
    size = camera["height"], camera["width"]
    channels = gaussians["features"].shape[1]
    shapes = {"image": (*size, 3), "features": (*size, channels)}
    if not len(gaussians["means"]):  # flat arrays without rows do not say how many channels there are
        images["features"] = np.zeros(shapes["features"])
    return {
        name: np.asarray(image, np.float64).reshape(shapes.get(name, size)) for name, image in images.items()
    }


def camera_numbers(given, limit):
    """A camera of the kit as engine.js takes it."""
    distortion, still = given["distortion"], given["readout"] == "none" and not given["exposure"]
    lens = (
        Distortion(tuple(map(float, distortion)), bool(given["radial_first"])) if np.any(distortion) else None
    )
    readout = "down" if still else given["readout"]
    shutter = None if still else RollingShutter(given["turn"], given["shift"], readout, given["exposure"])
    numbers = (given["width"], given["height"], *(float(given[name]) for name in INTRINSICS))
    intrinsics = Intrinsics(*numbers, projection=Projection(given["projection"], lens))
    camera = Camera.posed(given["R"], given["eye"], intrinsics, shutter)
    bounds = np.array(camera.jacobian_bounds(limit)).ravel()
    plain = {name: float(given[name]) for name in INTRINSICS}
    plain |= {"R": list(map(float, np.ravel(given["R"]))), "eye": list(map(float, given["eye"]))}
    plain |= {"W": camera.W, "H": camera.H, "bounds": bounds}
    if camera.pinhole:
        return plain
    kind = camera.projection.kind
    widest = {"perspective": math.tan(camera.widest) ** 2, "fisheye": math.cos(camera.widest)}.get(kind, 0.0)
    return plain | {
        "projection": kind,
        "distortion": None if camera.coefficients is None else list(camera.coefficients),
        "radialFirst": bool(camera.projection.radial_first),
        "moving": camera.motion is not None,
        "motion": list(camera.motion or (0.0,) * 6),
        "axis": readout_axis(camera.readout),
        "pace": readout_pace(camera.readout, camera.H, camera.W),
        "widest": widest,
        "exposure": float(camera.exposure),
    }


@pytest.mark.parametrize("precision", ["float32", "float64"])
def test_the_conformance_kit_passes(host, precision):
    """All cases, with all lenses and gradients, within the kit's derived tolerances."""
    renderer = Renderer(host, np.dtype(precision))
    report = run.check(renderer.render, renderer.gradients, precision=precision)
    assert report.passed, str(report)
    assert len({row.case for row in report.rows}) == len(run.load_cases()) >= 56
    assert sum(row.what.startswith("d/d") for row in report.rows) > 100


def test_the_module_is_small_and_asks_for_nothing(host):
    assert len(gzip.compress(build_wasm.MODULE.read_bytes())) <= MOST_BYTES
    asked = {
        name for name in host.ask("facts")["imports"] if not name.startswith("wasi_snapshot_preview1.fd_")
    }
    assert asked == {"env.memory", "host.refuse", "host.now"}


def test_the_recipe_is_generated_from_the_package():
    assert generate_recipe.HEADER.read_text() == generate_recipe.header()
    assert generate_recipe.MODULE.read_text() == generate_recipe.module()


@pytest.mark.parametrize("iterations", [1, 15, 45, 150, 199, 200, 777, 1999, 2000, 4321, 30_000])
def test_the_recipe_of_any_length_is_that_of_the_package(host, iterations):
    ours = recipe(iterations, strategy="fast", max_gaussians=5_000).flat()
    theirs = host.ask("recipe", iterations=iterations, changes={"max_gaussians": 5_000})
    assert theirs == {name: ours[name] for name in generate_recipe.FIELDS}


@pytest.mark.parametrize(("pixels", "views", "separate"), [(734_580, 85, 1), (60_000.5, 7, 3.2), (400, 2, 1)])
def test_the_planned_number_is_that_of_the_package(host, pixels, views, separate):
    found = host.ask("planned", pixels=pixels, views=views, separate=separate)
    assert found == planned_gaussians(pixels, views, separate)


def test_the_extent_is_that_of_the_package(host):
    eyes = np.random.default_rng(3).normal(size=(9, 3)) + 5
    cameras = [Camera(np.eye(3), eye, 50, 50, 20, 15, 30, 40) for eye in eyes]
    found = host.ask("extent", cameras=[{"eye": list(eye)} for eye in eyes])
    assert found == pytest.approx(scene_extent(cameras), rel=1e-12)
    assert host.ask("extent", cameras=[{"eye": [1, 2, 3]}]) == 1


PLAIN = {
    "R": [1, 0, 0, 0, 1, 0, 0, 0, 1],
    "eye": [0, 0, -4],
    "fx": 40,
    "fy": 40,
    "cx": 19.5,
    "cy": 15.5,
    "W": 40,
    "H": 32,
}


def ball(count, dtype=np.float32, seed=0):
    """Gaussians around the origin, as the module takes them."""
    rng = np.random.default_rng(seed)
    return {
        "means": rng.normal(size=3 * count).astype(dtype) * dtype(0.5),
        "quats": rng.normal(size=4 * count).astype(dtype),
        "log_scales": np.full(3 * count, -1.5, dtype),
        "sh0": rng.normal(size=3 * count).astype(dtype),
        "sh_rest": np.zeros(0, dtype),
        "logit_opacities": np.zeros(count, dtype),
    }


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"camera": {"fx": "none"}}, "a camera has a number that is not finite"),
        ({"camera": {"W": 0}}, "a camera has a number"),
        ({"camera": {"R": [1, 0, 0]}}, "a rotation of 9 numbers"),
        (
            {"camera": {"projection": "spherical"}},
            "the projection spherical is unknown; there are perspective",
        ),
        ({"camera": {"distortion": [0.1], "projection": "perspective"}}, "15 coefficients"),
        ({"settings": {"shDegree": 3}}, "harmonics or features that cannot be rendered"),
        ({"settings": {"shDegree": 7}}, "a setting of the render is out of range"),
        ({"settings": {"shDegree": 0, "alphaMax": 1.0}}, "a setting of the render is out of range"),
        (
            {"gaussians": {"quats": np.zeros(5, np.float32)}},
            "quats: has to have 4 numbers for each of 6 splats",
        ),
        ({"gaussians": {"means": np.zeros(18, np.float64)}}, "quats: has to have 4 numbers"),
        ({"gaussians": {"features": np.zeros(6 * 33, np.float32)}}, "features that cannot be rendered"),
    ],
)
def test_what_cannot_be_rendered_is_refused(host, change, message):
    given = {"gaussians": ball(6), "camera": PLAIN, "settings": {"shDegree": 0}}
    given = {name: value | change.get(name, {}) for name, value in given.items()}
    with pytest.raises(EngineError, match=message):
        host.ask("render", **given)


def test_too_little_memory_is_refused_in_one_line(node):
    host = Host(node)
    host.ask("load", limit=8 << 20)
    with pytest.raises(EngineError, match="there is not enough memory"):
        host.ask("render", gaussians=ball(60_000), camera=PLAIN, settings={"shDegree": 0})
    host.ask("load", limit=256 << 20)
    assert host.ask("render", gaussians=ball(60_000), camera=PLAIN, settings={"shDegree": 0})["image"].any()
    host.close()
