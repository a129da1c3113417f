"""A visitor's page in a headset, which iwer (Immersive Web Emulation Runtime) emulates in the page."""

import base64
from pathlib import Path

import numpy as np
import pytest

import gestures
from accessibility import grave_faults
from gsplat_edu.evaluate.metrics import psnr
from gsplat_edu.io.scene import Scene
from gsplat_edu.render.api import render
from gsplat_edu.runs.source import file_settings
from gsplat_edu.scene.camera import Camera
from gsplat_edu.viewer import page
from viewer.handles import until
from waiting import awaited, resize

RUNTIME = Path(__file__).parents[1] / "npm" / "node_modules" / "iwer" / "build" / "iwer.min.js"

QUEST = """
window.quest = new IWER.XRDevice(IWER.metaQuest3, { stereoEnabled: true });
quest.installRuntime({ forceInstall: true });
"""
"""A Quest 3 instead of the browser's own devices, of which a headless one has none."""

HALF = """
XRWebGLLayer = class extends XRWebGLLayer {
  constructor(session, gl, init) {
    super(session, gl, init);
    this.share = init.framebufferScaleFactor;
    this.own = gl.createFramebuffer();
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.own);
    const image = gl.createTexture();
    gl.bindTexture(gl.TEXTURE_2D, image);
    gl.texStorage2D(gl.TEXTURE_2D, 1, gl.RGBA8, this.share * innerWidth, this.share * innerHeight);
    gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, image, 0);
  }

  get framebuffer() { return this.own; }
  get framebufferWidth() { return this.share * innerWidth; }
  get framebufferHeight() { return this.share * innerHeight; }

  getViewport(view) {
    const { x, y, width, height } = super.getViewport(view);
    return { x: this.share * x, y: this.share * y, width: this.share * width, height: this.share * height };
  }
};
"""
"""A framebuffer of its own with the number of pixels that a page asks for, as a headset has. The emulator's is the
canvas, of any size."""

SIZE = (640, 400)
"""The emulator divides the window between the eyes."""

EYES_APART = 0.063
"""Distance of the emulated eyes, metres. They see 90 degrees of the height."""

FRAME = """() => new Promise((done) => quest.activeSession.requestAnimationFrame(() => {
  const { gl } = viewer.renderer;
  const { framebuffer, framebufferWidth: width, framebufferHeight: height } = quest.activeSession.renderState.baseLayer;
  const bytes = new Uint8Array(4 * width * height);
  gl.bindFramebuffer(gl.FRAMEBUFFER, framebuffer);
  gl.readPixels(0, 0, width, height, gl.RGBA, gl.UNSIGNED_BYTE, bytes);
  let text = "";
  for (let i = 0; i < bytes.length; i += 8192) text += String.fromCharCode(...bytes.subarray(i, i + 8192));
  done({ width, height, pixels: btoa(text) });
}))"""
"""The pixels of a frame, read after the page has drawn it."""

PUSH = """async ([hand, x, y]) => {
  const frame = () => new Promise((done) => quest.activeSession.requestAnimationFrame(done));
  quest.controllers[hand].updateAxes("thumbstick", x, y);
  for (let i = 0; i < 3; ++i) await frame();
  quest.controllers[hand].updateAxes("thumbstick", 0, 0);
  for (let i = 0; i < 2; ++i) await frame();
}"""

ALIKE = 55.0
"""Required PSNR, dB, against the renderer's picture. Rounding to bytes alone is 59 dB where there is no background, and
64 to 66 dB were measured."""


@pytest.fixture
def scene(random_gaussians):
    return random_gaussians(60)


@pytest.fixture
def shared(visit, tmp_path, scene, three_views):
    """Open an exported page, in a browser with a headset or without, before which a script may run."""

    def make(*, headset=True, script="", address="", unit=None, **options):
        if headset and not RUNTIME.exists():
            pytest.skip("iwer is not installed: npm ci --prefix tests/npm")
        path = tmp_path / "scene.html"
        page.write(path, Scene(scene, unit=unit), three_views)
        seen = visit(*SIZE, fresh=True, **options)
        if headset:
            seen.tab.add_init_script(RUNTIME.read_text("utf-8") + QUEST + script)
        seen.tab.goto(path.as_uri() + address)
        return seen.ready()

    return make


@pytest.fixture
def worn(shared):
    """Open the page and press VR; return the page and where the visitor stands."""

    def make(**options):
        seen = shared(**options)
        seen.tab.wait_for_selector("#vr")
        stand = Stand(seen)
        seen.tab.click("#vr")
        sorted_in(seen)
        return seen, stand

    return make


def sorted_in(seen):
    until(seen.tab, "viewer.headset.session && viewer.headset.isSorted")


class Stand:
    """Where a visitor stands whose headset starts in the page's view, without the scene's unit: the subject is two
    metres away."""

    size = SIZE
    """Of both pictures together, px."""

    def __init__(self, seen):
        self.up = np.array(seen.evaluate("viewer.view.up"))
        camera = seen.camera()
        ahead = camera.R[2] - self.up * (camera.R[2] @ self.up)
        self.ahead = ahead / np.linalg.norm(ahead)
        self.at = camera.eye
        self.metre = seen.evaluate("viewer.view.distance") / 2

    @property
    def right(self):
        return np.cross(self.ahead, self.up)

    def eye(self, side, down=0.0):
        """Return the camera of the left eye (side -1) or of the right one, of a head that looks down by an angle."""
        width, height = self.size[0] // 2, self.size[1]
        forward = np.cos(down) * self.ahead - np.sin(down) * self.up
        R = np.array([self.right, np.cross(forward, self.right), forward])
        place = self.at + 0.5 * side * EYES_APART * self.metre * self.right
        focal = height / 2
        return Camera(R, place, focal, focal, (width - 1) / 2, (height - 1) / 2, height, width)


def eyes(seen):
    """Return the pictures of the left and the right eye, (H, W, 3) from 0 to 1."""
    frame = seen.evaluate(FRAME)
    flat = np.frombuffer(base64.b64decode(frame["pixels"]), np.uint8)
    whole = flat.reshape(frame["height"], frame["width"], 4)[::-1, :, :3] / 255
    return np.split(whole.astype(np.float32), 2, axis=1)


def check_eyes(seen, scene, stand, down=0.0):
    """Check that both eyes see what the renderer draws from their places."""
    sorted_in(seen)
    found = eyes(seen)
    settings = file_settings(Scene(scene))
    likeness = [
        psnr(eye, render(scene, stand.eye(side, down), settings=settings).image.numpy().clip(0, 1))
        for side, eye in zip((-1, 1), found, strict=True)
    ]
    assert min(likeness) >= ALIKE, likeness
    for picture in found:
        assert (picture.max(axis=2) > 0.1).mean() > 0.02, "more than the background"
    return found


def push(seen, hand, x, y):
    """Push the stick of a controller for three frames, and let it go for two."""
    seen.evaluate(PUSH, [hand, x, y])


def step_aside(seen, metres):
    """Move the head to the right."""
    seen.evaluate("(metres) => { quest.position.x += metres; }", metres)
    push(seen, "left", 0, 0)


def test_both_eyes_see_the_scene_where_the_page_showed_it(worn, scene):
    seen, stand = worn()
    left, right = check_eyes(seen, scene, stand)
    assert psnr(left, right) < 30, "each eye has its own picture"
    # looking down by 20 degrees and stepping 30 cm to the right
    seen.evaluate("quest.quaternion.set(-Math.sin(Math.PI / 18), 0, 0, Math.cos(Math.PI / 18))")
    step_aside(seen, 0.3)
    stand.at = stand.at + 0.3 * stand.metre * stand.right
    check_eyes(seen, scene, stand, np.radians(20))


def test_pictures_are_drawn_into_the_headsets_framebuffer_at_half_its_resolution(worn, scene):
    seen, stand = worn(script=HALF)
    stand.size = (SIZE[0] // 2, SIZE[1] // 2)
    check_eyes(seen, scene, stand)


def test_who_turns_round_within_the_scene_sees_what_was_behind(worn, scene):
    seen, stand = worn()
    seen.evaluate("() => { quest.position.z -= 2; }")
    push(seen, "left", 0, 0)
    sorted_in(seen)
    order = seen.evaluate("viewer.sorter.sorted")
    seen.evaluate("quest.quaternion.set(0, 1, 0, 0)")
    push(seen, "left", 0, 0)
    stand.at = stand.at + 2 * stand.metre * stand.ahead
    stand.ahead = -stand.ahead
    check_eyes(seen, scene, stand)
    assert seen.evaluate("viewer.sorter.sorted") == order, "an order by distance has all directions"


def test_one_stick_turns_in_steps_and_the_other_one_glides(worn, scene):
    seen, stand = worn()
    push(seen, "right", 1, 0)  # for three frames, but it turns once
    stand.ahead = np.cos(np.pi / 6) * stand.ahead + np.sin(np.pi / 6) * stand.right
    check_eyes(seen, scene, stand)
    push(seen, "right", -0.8, 0)
    stand.ahead = np.cos(np.pi / 6) * stand.ahead - np.sin(np.pi / 6) * stand.right
    check_eyes(seen, scene, stand)
    push(seen, "left", 0.6, -0.8)
    moved = np.array(seen.evaluate("viewer.headset.eye")) - stand.at
    length = np.linalg.norm(moved) / stand.metre
    assert 0.001 < length < 0.5, "a metre per second, and at most 0.1 s a frame"
    way = 0.8 * stand.ahead + 0.6 * stand.right
    np.testing.assert_allclose(moved, length * stand.metre * way, atol=1e-5)
    stand.at = stand.at + moved
    check_eyes(seen, scene, stand)


def test_the_view_stops_softly_beyond_the_photos(worn):
    seen, stand = worn(reduced_motion="reduce")
    away = "Math.hypot(...viewer.headset.eye.map((x, i) => x - viewer.view.pivot[i])) / viewer.view.reach"
    push(seen, "left", 0, 1)
    step = np.linalg.norm(np.array(seen.evaluate("viewer.headset.eye")) - stand.at) / stand.metre
    assert step == pytest.approx(0.5, abs=1e-5), "a step instead of gliding"
    for _ in range(12):
        push(seen, "left", 0, 1)
    assert 1.1 < seen.evaluate(away) < 1.7


def test_a_scene_of_known_unit_has_its_size(worn, scene):
    seen, stand = worn(unit="m")
    stand.metre = 1
    step_aside(seen, 0.5)
    stand.at = stand.at + 0.5 * stand.right
    check_eyes(seen, scene, stand)


@pytest.mark.parametrize("end", ["button", "key", "Escape", "system"])
def test_after_vr_the_page_draws_its_view_again(worn, end):
    seen, _ = worn()
    before = seen.evaluate("viewer.view.camera")
    assert not seen.evaluate("viewer.isWhole")
    assert seen.tab.get_attribute("#vr", "aria-pressed") == "true"
    push(seen, "right", 1, 0)
    seen.evaluate("viewer.canvas.width = 7")  # the page has to set it
    ends = {
        "button": lambda: seen.evaluate("document.getElementById('vr').click()"),
        "key": lambda: seen.press("x"),
        "Escape": lambda: seen.press("Escape"),
        "system": lambda: seen.evaluate("quest.activeSession.end()"),
    }
    ends[end]()
    until(seen.tab, "!viewer.headset.session")
    seen.ready()
    assert seen.tab.get_attribute("#vr", "aria-pressed") == "false"
    assert seen.evaluate("viewer.view.camera") == before
    assert seen.evaluate("[viewer.canvas.width, viewer.canvas.height]") == list(SIZE)
    gestures.drag(seen.tab, (320, 150), (350, 150))
    assert seen.evaluate("viewer.view.camera") != before
    seen.ready()
    seen.press("x")  # and once more
    sorted_in(seen)
    seen.press("x")
    until(seen.tab, "!viewer.headset.session")
    seen.ready()


def test_the_page_does_not_draw_during_vr(worn):
    seen, _ = worn()
    seen.evaluate("viewer.canvas.width = 222")
    assert seen.evaluate("(viewer.reset(), viewer.frameAsked)") == 0
    seen.evaluate("viewer.draw(viewer.camera())")  # as what has waited for a sort does
    push(seen, "left", 0, 0)
    assert seen.evaluate("viewer.canvas.width") == 222


def test_the_page_that_view_serves_has_vr_too(shared, tmp_path, scene, three_views):
    seen = shared()
    (tmp_path / "own.html").write_bytes(page.html(Scene(scene), three_views))
    seen.open(tmp_path / "own.html").ready()
    stand = Stand(seen)
    seen.tab.get_by_role("button", name="VR").click()
    check_eyes(seen, scene, stand)


def test_what_the_headset_refuses_is_said_until_something_is_pressed(shared):
    refusing = (
        "navigator.xr.requestSession = () => Promise.reject(new DOMException('no', 'NotAllowedError'));"
    )
    seen = shared(script=refusing)
    seen.tab.click("#vr")
    seen.message("VR did not start. Check that the headset is on")
    seen.tab.mouse.click(300, 100)
    seen.tab.wait_for_selector("#message", state="hidden")
    assert seen.evaluate("viewer.headset.session") is None
    seen.press("x")
    seen.message("VR did not start")


def test_a_session_that_cannot_be_drawn_is_ended(shared):
    seen = shared(
        script="WebGL2RenderingContext.prototype.makeXRCompatible = () => Promise.reject(new Error());"
    )
    seen.tab.click("#vr")
    seen.message("VR did not start")
    awaited(seen.tab, lambda: seen.evaluate("quest.activeSession === undefined"))


@pytest.mark.parametrize("case", ["none", "no VR", "blocked"])
def test_without_a_headset_there_is_no_button(shared, case):
    script = {
        "none": "",
        "no VR": "navigator.xr.isSessionSupported = (mode) => Promise.resolve(mode === 'inline');",
        "blocked": "navigator.xr.isSessionSupported = () => Promise.reject(new DOMException('', 'SecurityError'));",
    }[case]
    seen = shared(headset=case != "none", script=script)
    seen.press("x")
    seen.evaluate(
        "Promise.resolve(navigator.xr?.isSessionSupported('immersive-vr')).catch(() => 0).then(() => 0)"
    )
    assert not seen.tab.is_visible("#vr") and seen.evaluate("viewer.headset") is None
    seen.press("h")
    assert "headset" not in seen.tab.inner_text("#help")


@pytest.mark.parametrize("width", [320, 360, 1440])
def test_the_bar_with_all_its_buttons_fits_into_the_window(shared, width):
    seen = shared()
    resize(seen.tab, width, 640)
    seen.evaluate("document.querySelectorAll('#bar button').forEach((button) => { button.hidden = false; })")
    boxes = [one.bounding_box() for one in seen.tab.locator("#bar button").all()]
    assert len(boxes) == 7
    assert min(box["x"] for box in boxes) >= 0 and max(box["x"] + box["width"] for box in boxes) <= width
    assert len({box["y"] for box in boxes}) == 1 and min(box["width"] for box in boxes) >= 24
    assert grave_faults(seen.tab) == []
