"""How fast does the page draw without a graphics processor?

    python benchmarks/page.py [SCENE ...] [--cameras N] [--seconds S] [--pictures FOLDER] [--smoke] [--out FILE.json]

Without scenes, makes three of 37,000, 152,000 and 1,000,000 splats with harmonics of degree 3: an object on a floor.
Writes the page of each by `gsplat-edu convert` and opens it from disk in a headless Chromium that draws in software, in
windows of a desktop's and of a phone's size. Prints, for each,

- the seconds from opening the page to its poster, to its first picture, and to the first complete one;
- the time per picture that a user sees while the mouse turns the view, median, 90th percentile and longest, and the
  processor time of the browser for each;
- the seconds from the last movement to the complete picture.

--cameras N measures the page of a capture of N cameras and 200,000 points instead, which `gsplat-edu view` serves.

--pictures writes a screenshot taken while the view turns, and one at rest. --smoke writes the page of a tiny scene, and
opens no browser.
"""

from __future__ import annotations

import itertools
import math
import re
import shutil
import statistics
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import hardware
import numpy as np
import torch
from live import FLAGS, browser_seconds

from gsplat_edu.data.writers import write_transforms
from gsplat_edu.io.formats import write_scene
from gsplat_edu.io.scene import Scene
from gsplat_edu.scene.camera import Camera
from gsplat_edu.scene.gaussians import Gaussians
from gsplat_edu.scene.views import View

COUNTS = (37_000, 152_000, 1_000_000)
WINDOWS = {"desktop": (1440, 900), "phone": (390, 844)}
MOVE_EVERY = 16.0
"""Milliseconds between two movements of the mouse."""

PATIENCE = 300e3
"""Milliseconds that a picture may take."""

SHOWN = """() => {
  window.shown = [];
  const put = viewer.put.bind(viewer);
  viewer.put = (camera) => {
    put(camera);
    viewer.renderer.drawn().then(() => window.shown.push(performance.now()));
  };
}"""
"""Script that records when each picture is on the screen."""


SHOWN_CAPTURE = """() => {
  window.shown = [];
  const draw = viewer.draw.bind(viewer);
  viewer.draw = (camera, points) => {
    draw(camera, points);
    viewer.renderer.finish();
    window.shown.push(performance.now());
  };
}"""
"""The same for the page of a capture, which waits for each of its pictures."""

POINTS = 200_000
"""Points of a capture."""


def write_capture(folder: Path, count: int) -> None:
    """Write a capture of cameras on a spiral around a cloud of points, with photos of 64 x 48 px.

    Args:
        folder: Where to write it.
        count: Number of cameras.
    """
    rng = np.random.default_rng(0)
    pixels = np.full((48, 64, 3), 90, np.uint8)
    views = []
    for i in range(count):
        turn, height = 40.0 * math.pi * i / count, 2.0 - 4.0 * i / count
        eye = (4.0 * math.sin(turn), height, -4.0 * math.cos(turn))
        views.append(View(Camera.looking_at(eye, (0, 0, 0), 60, 60, 48, 64), pixels, name=f"{i:05d}.png"))
    points = rng.normal(size=(POINTS, 3))
    write_transforms(folder, views, points, rng.uniform(size=(POINTS, 3)))


def room(count: int, seed: int = 0) -> Gaussians:
    """Make flat splats with harmonics on a bumpy object and on the floor below it.

    Args:
        count: Number of splats.
        seed: Seed of the random numbers.
    """
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=generator)

    on_object = torch.rand(count, 1, generator=generator) < 0.5
    outwards = torch.nn.functional.normalize(normal(count, 3), dim=1)
    bumps = torch.sin(5 * outwards[:, :1]) * torch.sin(4 * outwards[:, 1:2] + 1)
    floor = 8 * torch.rand(count, 3, generator=generator) - 4
    floor[:, 1] = 1.2
    means = torch.where(on_object, outwards * (1 + 0.15 * bumps), floor) + 0.01 * normal(count, 3)
    normals = torch.where(on_object, outwards, torch.tensor([0.0, 1.0, 0.0]))
    area = torch.where(on_object, 4 * math.pi, 64.0) / (0.5 * count)
    turn = torch.linalg.cross(torch.tensor([0.0, 0.0, 1.0]).expand(count, 3), normals)
    color = 0.5 + 0.4 * torch.sin(3 * means + torch.tensor([0.0, 1.0, 2.0])) + 0.05 * normal(count, 3)
    return Gaussians(
        means=means,
        quats=torch.cat([1.001 + normals[:, 2:], turn], 1),
        log_scales=0.5 * torch.log(area) + torch.tensor([0.2, -0.2, -2.0]) + 0.6 * normal(count, 3),
        sh0=((color - 0.5) / 0.28)[:, None],
        sh_rest=0.05 * normal(count, 15, 3),
        logit_opacities=1.5 * normal(count),
    )


def exported(scene: Path) -> str:
    """Write the page of a scene beside it by the command; return its address."""
    page = scene.with_suffix(".html")
    subprocess.run([sys.executable, "-m", "gsplat_edu", "convert", str(scene), str(page)], check=True)
    return page.as_uri()


@contextmanager
def served(scene: Path) -> Iterator[str]:
    """Serve a scene by the command; yield the address."""
    words = [sys.executable, "-m", "gsplat_edu", "view", str(scene), "--port", "0", "--no-open"]
    server = subprocess.Popen(words, stdout=subprocess.PIPE, text=True)
    try:
        found = None  # the line with the address
        while found is None:
            line = server.stdout.readline() if server.stdout else ""
            if not line:
                raise SystemExit(f"{scene}: is not served; see above")
            found = re.search(r"http://\S+", line)
        yield found[0]
    finally:
        server.terminate()
        server.wait()


@contextmanager
def browser(smoke: bool) -> Iterator[Any]:
    """Yield a headless Chromium; None with `smoke`."""
    if smoke:
        yield None
        return
    from playwright.sync_api import sync_playwright

    with sync_playwright() as driver:
        launched = driver.chromium.launch(executable_path=shutil.which("chromium"), args=list(FLAGS))
        yield launched
        launched.close()


def until(tab: Any, words: str, limit: float = PATIENCE) -> None:  # noqa: ANN401
    """Wait until a condition holds in a page, whose policy forbids the evaluated strings of Playwright's function."""
    end = time.perf_counter() + limit / 1e3
    while not tab.evaluate(words):
        if time.perf_counter() > end:
            raise SystemExit(f"the page took longer than {limit / 1e3:.0f} s")
        tab.wait_for_timeout(20)


def turned(tab: Any, seconds: float, picture: Path | None) -> None:  # noqa: ANN401
    """Drag the view back and forth, and take a screenshot meanwhile."""
    size = tab.viewport_size
    across, down = size["width"] // 2, size["height"] // 2
    tab.mouse.move(across, down)
    tab.mouse.down()
    began, taken = time.perf_counter(), picture is None
    while (now := time.perf_counter() - began) < seconds:
        tab.mouse.move(across + 0.3 * across * math.sin(1.5 * now), down + 0.05 * down * math.sin(now))
        if not taken and now > 0.6 * seconds:
            tab.screenshot(path=picture)
            taken = True
        tab.wait_for_timeout(MOVE_EVERY)
    tab.mouse.up()


def measured(opened: Any, url: str, window: tuple[int, int], seconds: float, pictures: Path | None) -> Any:  # noqa: ANN401
    """Open a page and rotate the view; return the figures."""
    tab = opened.new_page(viewport={"width": window[0], "height": window[1]})
    tab.set_default_timeout(PATIENCE)
    began = time.perf_counter()
    tab.goto(url, wait_until="commit")
    poster = None
    if url.startswith("file:"):
        until(tab, "document.getElementById('poster')?.complete")
        poster = time.perf_counter() - began
    tab.wait_for_selector("#message", state="hidden")
    first = time.perf_counter() - began
    until(tab, "window.viewer?.isWhole === true")
    tab.evaluate("viewer.renderer.finish()")
    whole = time.perf_counter() - began
    is_capture = tab.evaluate("!viewer.put")
    tab.evaluate(SHOWN_CAPTURE if is_capture else SHOWN)
    used = browser_seconds()
    while_turning = pictures and pictures.with_name(f"{pictures.name}-turning.png")
    turned(tab, seconds, while_turning)
    shown = tab.evaluate("[...window.shown]")
    busy = browser_seconds() - used
    let_go = time.perf_counter()
    until(tab, "window.viewer.isWhole === true")
    tab.evaluate("viewer.renderer.finish()")
    rest = time.perf_counter() - let_go
    if pictures:
        tab.screenshot(path=pictures.with_name(f"{pictures.name}-rest.png"))
    apart = [later - earlier for earlier, later in itertools.pairwise(shown)]
    detail = tab.evaluate("viewer.put ? viewer.pace.detail : { points: viewer.moving }")
    tab.close()
    return {
        "poster": poster,
        "first": first,
        "whole": whole,
        "frames": len(shown),
        "median_ms": statistics.median(apart) if apart else math.inf,
        "p90_ms": statistics.quantiles(apart, n=10)[-1] if len(apart) > 1 else math.inf,
        "longest_ms": max(apart, default=math.inf),
        "busy_ms": 1e3 * busy / max(1, len(shown)),
        "rest": rest,
        "detail": detail,
    }


def main() -> None:
    """Measure, print and write the JSON."""
    parser = hardware.parser("The page: frames without a graphics processor.")
    parser.add_argument("scenes", type=Path, nargs="*")
    parser.add_argument("--cameras", type=int, help="of a capture to measure instead of scenes")
    parser.add_argument("--seconds", type=float, default=8.0, help="of turning")
    parser.add_argument("--pictures", type=Path, help="folder for screenshots")
    arguments = parser.parse_args()
    results: dict[str, Any] = {}
    with TemporaryDirectory() as scratch, browser(arguments.smoke) as opened:
        scenes = arguments.scenes
        if arguments.cameras:
            scenes = [Path(scratch) / f"{arguments.cameras} cameras"]
            write_capture(scenes[0], arguments.cameras)
        if not scenes:
            scenes = [Path(scratch) / f"{count}.ply" for count in ((300,) if arguments.smoke else COUNTS)]
            for path in scenes:
                write_scene(path, Scene(room(int(path.stem))))
        if arguments.pictures:
            arguments.pictures.mkdir(parents=True, exist_ok=True)
        for scene in scenes:
            with served(scene) if arguments.cameras else nullcontext(exported(scene)) as url:
                for name, window in WINDOWS.items() if opened else ():
                    pictures = arguments.pictures and arguments.pictures / f"{scene.stem}-{name}"
                    found = measured(opened, url, window, arguments.seconds, pictures)
                    results[f"{scene.stem} {name}"] = found
                    poster = "" if found["poster"] is None else f"poster {found['poster']:.1f} s, "
                    print(
                        f"{scene.stem} {name}: {poster}first picture {found['first']:.1f} s,"
                        f" complete {found['whole']:.1f} s; turning {found['median_ms']:.0f} ms a picture,"
                        f" of nine in ten at most {found['p90_ms']:.0f}, longest {found['longest_ms']:.0f} ms,"
                        f" {found['busy_ms']:.0f} ms of processor time; complete {found['rest']:.1f} s after it;"
                        f" {found['detail']}"
                    )
    hardware.report(results, arguments.out)


if __name__ == "__main__":
    main()
