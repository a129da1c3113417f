"""Fixtures: scenes, and a browser without a network."""

import base64
from collections import defaultdict

import numpy as np
import pytest
import torch

from gsplat_edu.io.scene import Scene
from gsplat_edu.render.settings import RenderSettings
from gsplat_edu.runs.source import Source
from gsplat_edu.scene.camera import Camera, look_at
from gsplat_edu.scene.gaussians import Gaussians
from gsplat_edu.viewer import page
from gsplat_edu.viewer.edit_page import editing_of
from viewer.handles import until

PIXELS = """async (camera) => {
  const { pixels } = await viewer.setCamera(camera);
  const bytes = new Uint8Array(pixels.buffer);
  let text = "";
  for (let i = 0; i < bytes.length; i += 8192) text += String.fromCharCode(...bytes.subarray(i, i + 8192));
  return btoa(text);
}"""


def described(camera):
    """Return the camera in the form that the page expects."""
    numbers = {name: getattr(camera, name) for name in ("fx", "fy", "cx", "cy", "H", "W")}
    return {"R": camera.R.tolist(), "eye": camera.eye.tolist(), **numbers}


def picture_of(tab, camera):
    """Return the picture that the page in a tab draws from this camera, (H, W, 3) float32."""
    encoded = tab.evaluate(PIXELS, described(camera))
    return np.frombuffer(base64.b64decode(encoded), "<f4").reshape(camera.H, camera.W, 3)


READING = "GPU stall due to ReadPixels"
"""Message that Chromium's driver sometimes logs if a test reads the page's pixels. A page that watches a training
must not cause it, so `test_live_browser.py` does not ignore it."""


RESTS = "Boolean(window.viewer?.isWhole && !viewer.frameAsked && !viewer.catching && !viewer.timing)"
"""Whether a page draws nothing more by itself."""


class Visit:
    """An open page. It records the console messages, errors and requests."""

    def __init__(self, tab):
        self.tab = tab
        self.complaints = []
        self.requests = []
        self._heard = {
            "console": lambda message: self.complaints.append(f"{message.type}: {message.text}"),
            "pageerror": lambda error: self.complaints.append(str(error)),
            "request": lambda request: self.requests.append(request.url),
        }
        for event, note in self._heard.items():
            tab.on(event, note)

    def leave(self):
        """Empty the tab for the next visit."""
        for event, note in self._heard.items():
            self.tab.remove_listener(event, note)
        self.tab.goto("about:blank")

    def open(self, path):
        self.tab.goto(path.as_uri())
        return self

    def ready(self):
        """Wait until the page shows its whole picture, which a slow computer draws in parts, and rests."""
        self.tab.wait_for_selector("#message", state="hidden")
        until(self.tab, RESTS)
        return self

    def message(self, text):
        """Wait until the page shows this message."""
        self.tab.wait_for_selector(f'#message:has-text("{text}")')

    def camera(self):
        """Return the camera of the current view."""
        found = self.tab.evaluate("viewer.camera()")
        for other in ("name", "held_out", "saved", "text"):
            found.pop(other, None)
        return Camera(**found)

    def picture(self, camera):
        """Return the page's picture from this camera, (H, W, 3) float32."""
        return picture_of(self.tab, camera)


@pytest.fixture
def picture():
    """Return a function that draws a camera's picture in a tab of any page."""
    return picture_of


@pytest.fixture(scope="module")
def tabs(browser):
    """Empty tabs by their options. Opening a tab takes as long as the rest of most tests."""
    return defaultdict(list)


@pytest.fixture
def visit(browser, tabs):
    """Return a function that opens tabs without a network. A tab that logs a complaint or requests another address
    fails."""
    visits = []

    def make(width=320, height=200, *, fresh=False, **options):
        """Open a tab of this size; a `fresh` one if the test leaves init scripts, keys or clicks in it."""
        free = None if fresh else tabs[repr(sorted(options.items()))]
        if free:
            tab = free.pop()
        else:
            context = browser.new_context(**options)
            context.set_offline(True)
            tab = context.new_page()
        tab.set_viewport_size({"width": width, "height": height})
        visits.append((Visit(tab), free))
        return visits[-1][0]

    yield make
    for one, free in visits:
        if free is None:
            one.tab.context.close()
        else:
            one.leave()
            free.append(one.tab)
    for one, _ in visits:
        assert [text for text in one.complaints if READING not in text] == []
        assert [url for url in one.requests if not url.startswith(("file:", "blob:", "data:"))] == []


@pytest.fixture
def show(visit, tmp_path):
    """Write a page and open it."""

    def make(gaussians, views=(), settings=None, **options):
        path = tmp_path / "scene.html"
        page.write(path, Scene(gaussians), views, settings)
        return visit(**options).open(path).ready()

    return make


@pytest.fixture
def random_gaussians():
    """Make n random Gaussians around zero with `rest` SH coefficients beyond the first."""

    def make(n, rest=15, seed=0):
        generator = torch.Generator().manual_seed(seed)

        def normal(*shape):
            return torch.randn(*shape, generator=generator)

        return Gaussians(
            means=0.6 * normal(n, 3),
            quats=normal(n, 4),
            log_scales=0.7 * normal(n, 3) - 3.2,
            sh0=normal(n, 1, 3),
            sh_rest=0.3 * normal(n, rest, 3),
            logit_opacities=2.0 * normal(n),
        )

    return make


@pytest.fixture
def camera():
    """A camera with an image that is not square and an off-centre principal point."""
    eye = (0.4, -0.6, -2.2)
    return Camera(look_at(eye, (0.1, 0.0, 0.0)), eye, fx=230.0, fy=250.0, cx=150.3, cy=108.6, H=200, W=320)


@pytest.fixture
def three_views(camera):
    """Named cameras around zero, of different sizes."""
    named = [("first", camera)]
    for name, eye, width in (("second", (2.0, -0.5, 0.3), 200), ("third <b>", (-1.0, -0.4, 2.0), 240)):
        named.append(
            (name, Camera(look_at(eye, (0.0, 0.0, 0.0)), eye, 180.0, 180.0, width / 2, 80.0, 160, width))
        )
    return named


@pytest.fixture
def edit_page(visit, tmp_path):
    """Return a function that opens a scene's page with the editor."""

    def make(gaussians, cameras=(), width=900, height=700, **options):
        source = Source(tmp_path / "s.ply", Scene(gaussians), cameras, RenderSettings(jacobian_limit=1.3))
        editing = editing_of(source, tmp_path / "s.ply", tmp_path / "edits.json")
        html = page.html(source.scene, cameras, source.settings, "scene", (), editing=editing)
        (tmp_path / "edit.html").write_bytes(html)
        shown = visit(width=width, height=height, fresh=True, **options).open(tmp_path / "edit.html").ready()
        shown.tab.wait_for_selector("#edit")
        return shown

    return make
