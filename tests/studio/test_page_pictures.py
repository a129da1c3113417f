"""In a Chromium without WebGL, the server draws pictures on request by our renderer."""

import base64
import io
import json
import re

import numpy as np
import pytest
from PIL import Image

from browsers import chromium
from gestures import drag, inside
from gsplat_edu.data.procedural import procedural_capture
from gsplat_edu.data.writers import write_colmap
from gsplat_edu.evaluate.metrics import psnr
from gsplat_edu.render.api import render
from gsplat_edu.runs.source import open_source
from gsplat_edu.studio.painter import Painter
from gsplat_edu.viewer import page_data
from gsplat_edu.viewer.live import picture_camera
from gsplat_edu.viewer.live_folder import LiveFolder, framed
from studio.conftest import Inline
from studio.pages import go
from waiting import awaited, resize, until_in

CAMERA = """() => {
  const { R, eye, fx, fy, cx, cy, W, H } = viewer.camera();
  return { R, eye, fx, fy, cx, cy, W, H };
}"""


@pytest.fixture(scope="module")
def browser():
    with chromium(["--disable-gpu", "--disable-software-rasterizer", "--disable-3d-apis"]) as launched:
        yield launched


def framed_viewer(tab):
    """Wait for a picture in the screen's frame; return the frame."""
    frame = tab.wait_for_selector(".scene iframe:not([hidden])").content_frame()
    until_in(tab, frame, "Boolean(window.viewer) && !viewer.renderer.asking && !viewer.frameAsked")
    return frame


def shown(frame):
    """Return the canvas of the frame without the elements on top of it, (H, W, 3)."""
    data = base64.b64decode(frame.evaluate("document.getElementById('canvas').toDataURL()").partition(",")[2])
    return np.asarray(Image.open(io.BytesIO(data)).convert("RGB"), dtype=float)


def drawn(tab, frame, as_wanted):
    """Wait for a picture and return it."""
    awaited(tab, lambda: as_wanted(shown(frame)), "the picture")
    return shown(frame)


def test_a_scene_is_drawn_by_the_server(visitor, wall_entry):
    person = visitor()
    tab = person.tab
    resize(tab, 800, 700)
    assert tab.evaluate("document.createElement('canvas').getContext('webgl2')") is None
    go(tab, "scenes/wall")
    frame = framed_viewer(tab)
    frame.locator("#fold").press("Enter")  # the bar lies below the window
    frame.locator("#count", has_text="176 splats, drawn by the program that serves this page").wait_for()
    assert "no WebGL2" in frame.inner_text("#count")
    frame.locator("#message").wait_for(state="hidden")
    before = drawn(tab, frame, lambda pixels: pixels.std() > 5)

    camera = frame.evaluate(CAMERA)
    answer = tab.request.post(
        f"{tab.url.split('/#')[0]}/api/scenes/wall/picture",
        data=camera,
        headers={"Origin": tab.url.split("/#")[0]},
    )
    found = open_source(wall_entry / "wall.ply")
    truth = render(found.scene.gaussians, picture_camera(camera), settings=found.settings).image.clamp(0, 1)
    sent = np.asarray(Image.open(io.BytesIO(answer.body())), dtype=np.float64) / 255
    assert psnr(sent, truth.double().numpy()) > 35  # the loss of JPEG of quality 85

    box = frame.locator("#canvas").bounding_box()
    drag(tab, *inside(box, (0.25, 0.4), (0.45, 0.5)))  # beside the bar
    assert tab.evaluate("scrollY") == 0  # the page does not jump to the canvas that was pressed
    drawn(tab, frame, lambda pixels: np.abs(pixels - before).mean() > 2)  # seen from another side


def test_the_editor_reports_missing_webgl_in_one_line(visitor, wall_entry):
    tab = visitor().tab
    go(tab, "scenes/wall/edit")
    frame = tab.wait_for_selector(".scene iframe:not([hidden])").content_frame()
    frame.locator("#message", has_text=re.compile("WebGL2.* gsplat-edu render")).wait_for()
    assert "\n" not in frame.inner_text("#message")


def test_a_training_is_drawn_while_it_runs(visitor, library, tmp_path):
    write_colmap(library[0].library.root / "captures" / "egg", *procedural_capture(24, 6, splats=60))
    person = visitor()
    tab = person.tab
    go(tab, "captures/egg")
    tab.locator("summary", has_text="More").click()
    tab.get_by_label("Iterations instead of a quality").fill("100000")
    tab.get_by_role("button", name="Start training").click()
    person.reach("#/runs/egg")
    tab.get_by_role("button", name="Pause", exact=True).wait_for()
    frame = framed_viewer(tab)
    assert "no WebGL2, so the training's computer draws" in frame.inner_text("#live")
    drawn(tab, frame, lambda pixels: pixels.std() > 5)
    assert frame.evaluate("viewer.renderer.failure") == ""
    tab.get_by_role("button", name="Stop", exact=True).click()
    tab.locator(".job .state", has_text="stopped").wait_for()


def camera_at(z, focal, W, H):
    """Return a page's camera on the z axis that looks along it."""
    turn = np.eye(3).tolist()
    return {"R": turn, "eye": [0, 0, z], "fx": focal, "fy": focal, "cx": W / 2, "cy": H / 2, "W": W, "H": H}


def painter_here():
    """Return a painter that draws in this process."""
    painter = Painter()
    painter.worker = Inline()
    return painter


def test_pictures_wait_only_while_a_training_runs(wall_entry):
    painter = painter_here()
    camera = camera_at(-4, 20, 20, 20)
    task = {"source": str(wall_entry / "wall.ply"), "camera": camera, "live": False}
    first = painter.paint(lambda: True, **task)
    painter.free_at += 1e6  # the clock makes the picture seem slow
    asked = []

    def ends_soon():
        asked.append(len(asked))
        return len(asked) < 4

    # it waited for the end of the training
    assert painter.paint(ends_soon, **task) == first and len(asked) == 5
    painter.free_at += 1e6
    # no training is slowed down, so pictures do not wait
    assert painter.paint(lambda: False, **task) == first


def test_a_snapshot_is_drawn_with_the_settings_of_its_training(wall_entry, tmp_path):
    found = open_source(wall_entry / "wall.ply")
    run = LiveFolder(tmp_path)
    run.path.mkdir()
    settings = {"background": [0.0, 0.0, 1.0], "sh_degree": 0, "antialiased": False, "jacobian_limit": None}
    run.page.write_text(json.dumps({"settings": settings}))
    gaussians = found.scene.gaussians
    run.scene.write_bytes(framed(7, len(gaussians), 0, page_data.packed(gaussians)))
    camera = camera_at(-18, 40, 80, 40)
    data = painter_here().paint(lambda: False, source=str(tmp_path), camera=camera, live=True)
    pixels = np.asarray(Image.open(io.BytesIO(data)), dtype=int)
    assert np.abs(pixels[0, 0] - (0, 0, 255)).max() < 8 and pixels[20, 40, 2] < 250
