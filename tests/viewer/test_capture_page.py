"""The page of a capture in a browser: outlines, photos, findings, and the list of photos."""

import base64
import io
import json
import urllib.error
import urllib.request

import numpy as np
import pytest
from PIL import Image

from accessibility import grave_faults_in_all_styles
from gestures import drag
from gsplat_edu.data.left_out import read_left_out
from gsplat_edu.data.procedural import procedural_capture
from gsplat_edu.data.writers import write_transforms
from gsplat_edu.scene.camera import Camera
from gsplat_edu.viewer import capture_page
from gsplat_edu.viewer.capture_serve import CaptureServer, Examination
from viewer.captures import measured, ring
from viewer.handles import until
from viewer.pages import running
from waiting import FRAMES, awaited, resize

REFUSED = "the server responded with a status of 400"
"""What Chromium logs about an answer that the page shows to the user."""


@pytest.fixture
def folder(tmp_path, request):
    """A ring of cameras with a gap; if asked for, one without a gap that has no points."""
    folder = tmp_path / "egg & spoon"
    if getattr(request, "param", "") == "no points":
        write_transforms(folder, procedural_capture(size=48, count=12)[0], [])
        return folder
    ring(folder, skipped=(4, 5, 6))
    measured(folder)
    return folder


@pytest.fixture
def served(folder):
    """Serve the capture."""
    with CaptureServer("127.0.0.1", 0, capture_page.policy(), folder) as server, running(server):
        server.prepare("egg & spoon")
        yield server


@pytest.fixture
def opened(served, visit):
    """Return a function that opens the page in a tab."""

    def make(width=900, height=600, **options):
        shown = visit(width, height, url=served.url, **options).ready()
        shown.expected = REFUSED
        return shown.tab

    return make


def view_of(tab):
    """Return the camera of the page's view."""
    found = tab.evaluate("(() => { const { R, eye, fx, fy, cx, cy, W, H } = viewer.camera();"
                         " return { R, eye, fx, fy, cx, cy, W, H }; })()")  # fmt: skip
    return Camera(**found)


def pixels(tab):
    """Return the picture of the canvas, (H, W, 3)."""
    text = tab.evaluate("""() => {
      const { gl } = viewer.renderer;
      viewer.draw(viewer.camera(), viewer.facts.count);
      const { width, height } = gl.canvas;
      const bytes = new Uint8Array(4 * width * height);
      gl.readPixels(0, 0, width, height, gl.RGBA, gl.UNSIGNED_BYTE, bytes);
      let text = "";
      for (let i = 0; i < bytes.length; i += 8192) text += String.fromCharCode(...bytes.subarray(i, i + 8192));
      return btoa(text);
    }""")
    size = tab.evaluate("[viewer.canvas.height, viewer.canvas.width]")
    return np.frombuffer(base64.b64decode(text), np.uint8).reshape(*size, 4)[::-1, :, :3].astype(int)


def corners_of(tab, index):
    """Return where `Camera` projects the eye and the corners of a camera's outline in the page's view, px."""
    facts = tab.evaluate("viewer.facts")
    camera = facts["cameras"][index]
    outline = np.array(facts["shapes"][camera["shape"]]["outline"])
    places = (
        np.concatenate([np.zeros((1, 3)), facts["size"] * outline]) @ np.array(camera["R"]) + camera["eye"]
    )
    view = view_of(tab)
    u, v, z = view.project(view.world_to_cam(places))
    assert (z > 0).all()
    return np.stack([u, v], axis=1)


def middle_of(tab, index):
    """Return the middle of the image of a camera's outline in the window, CSS px."""
    return corners_of(tab, index)[1:].mean(axis=0) + 0.5


def alone(tab):
    """Return a camera that no other outline overlaps in the window."""
    count = tab.evaluate("viewer.cameras.list.length")
    for i in range(count):
        x, y = middle_of(tab, i)
        if 310 < x < 560 and tab.evaluate("([x, y]) => viewer.at(x, y)", [x, y]) == i:
            return i
    raise AssertionError("every outline overlaps another")


@pytest.mark.parametrize("folder", ["no points"], indirect=True)
def test_a_capture_without_points_shows_its_cameras(opened):
    tab = opened()
    assert tab.evaluate("[viewer.facts.count, viewer.cameras.list.length]") == [0, 12]
    x, y = middle_of(tab, alone(tab))
    before = pixels(tab)
    tab.mouse.click(x, y)
    tab.wait_for_selector("#photo:not([hidden])")
    assert np.ptp(before.reshape(-1, 3), axis=0).max() > 100  # outlines on the backdrop


def test_the_photo_of_a_camera_is_shown_under_the_pointer(opened, served):
    tab = opened()
    index = alone(tab)
    x, y = middle_of(tab, index)
    assert not tab.locator("#hover").is_visible()
    tab.mouse.move(x, y)
    tab.locator("#hover img").wait_for()
    name = tab.evaluate("index => viewer.facts.cameras[index].name", index)
    assert name in tab.inner_text("#hover figcaption")
    until(tab, "document.querySelector('#hover img').naturalWidth > 0")
    shown = np.array(
        tab.evaluate("""() => {
      const img = document.querySelector('#hover img');
      const canvas = document.createElement('canvas');
      [canvas.width, canvas.height] = [img.naturalWidth, img.naturalHeight];
      const drawing = canvas.getContext('2d');
      drawing.drawImage(img, 0, 0);
      return [...drawing.getImageData(0, 0, canvas.width, canvas.height).data];
    }""")
    ).reshape(36, 48, 4)[..., :3]
    away = {
        photo: np.abs(shown - np.asarray(Image.open(path).convert("RGB")).astype(int)).mean()
        for photo, path in served.photos.items()
    }
    assert away.pop(f"images/{name}") < 6 < min(away.values())  # of the JPEG, and of other photos
    tab.mouse.move(5, 595)
    tab.locator("#hover").wait_for(state="hidden")


def test_a_person_chooses_steps_and_orbits(opened):
    tab = opened()
    index = alone(tab)
    tab.mouse.click(*middle_of(tab, index))
    chosen = tab.get_by_role("region", name="photo")
    names = tab.evaluate("viewer.facts.cameras.map(({ name }) => name)")
    chosen.get_by_role("heading", name=names[index]).wait_for()
    points = tab.evaluate("index => viewer.facts.cameras[index].points", index)
    assert points > 0
    assert f"{points} matched points" in chosen.inner_text()
    chosen.get_by_alt_text(names[index]).wait_for()
    count = len(names)
    tab.keyboard.press("ArrowRight")
    chosen.get_by_role("heading", name=names[(index + 1) % count]).wait_for()
    tab.keyboard.press("ArrowLeft")
    tab.keyboard.press("ArrowLeft")
    chosen.get_by_role("heading", name=names[(index - 1) % count]).wait_for()
    chosen.get_by_role("button", name="next").click()
    chosen.get_by_role("heading", name=names[index]).wait_for()
    current = tab.locator("#cameras button[aria-current=true]")
    assert current.count() == 1
    tab.keyboard.press("Escape")
    assert not tab.locator("#chosen").is_visible()
    tab.mouse.click(5, 595)  # where there is none
    assert tab.evaluate("viewer.cameras.chosen") == -1

    before = view_of(tab)
    x, y = middle_of(tab, alone(tab))
    drag(tab, (x, y), (x + 80, y))
    assert tab.evaluate("viewer.cameras.chosen") == -1
    after = view_of(tab)
    assert np.linalg.norm(after.eye - before.eye) > 0.5
    pivot = tab.evaluate("viewer.view.focus")
    distances = [np.linalg.norm(np.array(pivot) - camera.eye) for camera in (before, after)]
    assert distances[0] == pytest.approx(distances[1])
    tab.keyboard.press("r")
    np.testing.assert_allclose(view_of(tab).eye, before.eye)


def test_a_person_looks_through_a_camera(opened):
    tab = opened()
    tab.evaluate("viewer.choose(2)")
    tab.keyboard.press("t")
    tab.locator("#through").wait_for()
    camera = tab.evaluate("viewer.facts.cameras[2]")
    view = view_of(tab)
    np.testing.assert_allclose(view.eye, camera["eye"])
    np.testing.assert_allclose(view.R, camera["R"])
    until(tab, "document.getElementById('through').getBoundingClientRect().width > 0")
    box = tab.locator("#through").bounding_box()
    # a ray through a corner of the photo is that of the window's pixel under the corner of the picture
    own = Camera(**{k: camera[k] for k in ("R", "eye", "fx", "fy", "cx", "cy", "H", "W")})
    for u, v, x, y in (
        (-0.5, -0.5, box["x"], box["y"]),
        (own.W - 0.5, own.H - 0.5, box["x"] + box["width"], box["y"] + box["height"]),
    ):
        point = own.R.T @ [(u - own.cx) / own.fx, (v - own.cy) / own.fy, 1] + own.eye
        column, row, _ = view.project(view.world_to_cam(point))
        assert (column + 0.5, row + 0.5) == pytest.approx((x, y), abs=0.1)
    tab.keyboard.press("ArrowRight")  # looks through the next one
    np.testing.assert_allclose(view_of(tab).eye, tab.evaluate("viewer.facts.cameras[3].eye"))
    tab.mouse.wheel(0, 100)
    tab.locator("#through").wait_for(state="hidden")


def test_photos_are_left_out_and_used_again_but_for_the_last_one(opened, folder):
    tab = opened()
    tab.evaluate("viewer.choose(1)")
    name = tab.evaluate("viewer.facts.cameras[1].photo")
    plain = tab.evaluate("[...viewer.cameras.styles.slice(0, 4)]")
    tab.get_by_role("button", name="leave out").click()
    tab.get_by_role("button", name="use again").wait_for()
    assert read_left_out(folder) == (name,)
    tab.evaluate("viewer.choose(-1)")
    first = tab.evaluate("8 * viewer.cameras.firsts[1]")
    assert tab.evaluate("at => [...viewer.cameras.styles.slice(at, at + 3)]", first) == [
        169,
        177,
        188,
    ]  # --edge
    assert tab.evaluate("[...viewer.cameras.styles.slice(0, 4)]") == plain
    assert "left out (1)" in tab.inner_text("#legend")
    tab.evaluate("viewer.choose(1)")
    tab.keyboard.press("x")
    tab.get_by_role("button", name="leave out").wait_for()
    assert read_left_out(folder) == ()

    names = tab.evaluate("viewer.facts.cameras.map(({ photo }) => photo)")
    for i in range(len(names) - 1):
        tab.evaluate("async (i) => { viewer.choose(i); await viewer.leave(); }", i)
    assert len(read_left_out(folder)) == len(names) - 1
    tab.evaluate("async (i) => { viewer.choose(i); await viewer.leave(); }", len(names) - 1)
    assert "none of its 9 photos would be left" in tab.inner_text("#trouble")
    assert len(read_left_out(folder)) == len(names) - 1


def test_gap_points_and_outlines_are_drawn_where_the_view_projects_them(opened, served):
    tab = opened()
    gap = np.array(tab.evaluate("viewer.facts.gap"))
    view = view_of(tab)
    u, v, _ = view.project(view.world_to_cam(gap[len(gap) // 2]))
    box = tab.locator("#missing").bounding_box()
    assert box["x"] + box["width"] / 2 == pytest.approx(u + 0.5, abs=1)
    assert box["y"] < v
    assert "an arc of 120 degrees" in tab.inner_text("#gap")
    red = pixels(tab)
    inside = (red[..., 0] > 200) & (red[..., 1] < 110) & (red[..., 2] < 110)
    column, row = round(float(u)), round(float(v))
    assert inside[row - 3 : row + 4, column - 3 : column + 4].any()

    tab.evaluate("document.getElementById('show-path').click()")
    positions = np.array(tab.evaluate("[...viewer.positions]")).reshape(-1, 3)
    view = view_of(tab)
    with_points = pixels(tab)
    tab.evaluate("document.getElementById('show-points').click()")
    changed = (with_points != pixels(tab)).any(axis=2)
    u, v, _ = view.project(view.world_to_cam(positions))
    inside = (u > 2) & (u < view.W - 3) & (v > 2) & (v < view.H - 3)
    expected = np.zeros(changed.shape, bool)
    reach = np.arange(-2, 3)
    for x, y in zip(np.rint(u[inside]).astype(int), np.rint(v[inside]).astype(int), strict=True):
        expected[np.ix_(y + reach, x + reach)] = True
    assert changed.sum() > 200
    assert not (changed & ~expected).any()

    tab.evaluate("() => { viewer.cameras.arc = viewer.cameras.count; viewer.paint(); }")
    picture = pixels(tab)
    ground = picture[-1, -1]
    drawn = np.abs(picture - ground).sum(axis=2) > 120
    H, W = drawn.shape
    rows, columns = np.indices((H, W))
    near, close = np.zeros((H, W), bool), np.zeros((H, W), bool)
    for index in range(tab.evaluate("viewer.cameras.list.length")):
        eye, *rim = corners_of(tab, index)
        pairs = [(rim[k], rim[(k + 1) % 4]) for k in range(4)] + [(eye, corner) for corner in rim]
        top = (
            np.minimum.reduce([*rim, eye]) - 30,
            np.maximum.reduce([*rim, eye]) + 30,
        )  # with the mark above the image
        near |= ((columns > top[0][0]) & (columns < top[1][0]) & (rows > top[0][1]) & (rows < top[1][1]))  # fmt: skip
        for a, b in pairs:
            along = b - a
            share = ((columns - a[0]) * along[0] + (rows - a[1]) * along[1]) / max(along @ along, 1e-9)
            share = share.clip(0, 1)
            close |= np.hypot(a[0] + share * along[0] - columns, a[1] + share * along[1] - rows) < 0.3
    assert close.sum() > 500
    assert drawn[close].mean() > 0.99
    assert not (drawn & ~near).any()


def test_findings_color_cameras_when_the_doctor_is_done(opened, served):
    tab = opened(color_scheme="dark")
    assert "examines" in tab.inner_text("#doctor")
    name = tab.evaluate("viewer.facts.cameras[3].name")
    served.marks = {name: ["blurred"]}
    tab.get_by_text("The doctor found something about 1 photo.").wait_for()
    assert "blurred (1)" in tab.inner_text("#legend")
    styles = "i => [...viewer.cameras.styles.slice(8 * viewer.cameras.firsts[i], 8 * viewer.cameras.firsts[i] + 3)]"
    assert tab.evaluate(styles, 3) == [255, 170, 0]
    assert tab.evaluate(styles, 2) == [138, 180, 248]  # --accent
    tab.evaluate("viewer.choose(3)")
    assert "blurred" in tab.inner_text("#facts-of")


def test_the_ground_is_dark_in_both_themes(opened):
    dark, light = opened(color_scheme="dark"), opened(color_scheme="light")
    assert tuple(pixels(dark)[-1, -1]) == tuple(pixels(light)[-1, -1]) == (14, 17, 21)  # --glass


def test_on_a_phone_everything_fits_and_is_large_enough(opened):
    tab = opened(390, 844, has_touch=True)
    assert not tab.locator("#tools").is_visible()
    tab.get_by_role("button", name="controls").tap()
    tab.evaluate("viewer.choose(2)")
    tab.locator("#photo").wait_for()
    for name in ("Previous", "Next", "Stand here", "Leave out", "close the photo"):
        box = tab.get_by_role("button", name=name, exact=True).bounding_box()
        assert min(box["width"], box["height"]) >= 40, name
        assert box["x"] >= 0, name
        assert box["x"] + box["width"] <= 390, name
        assert box["y"] + box["height"] <= 844, name
    assert tab.evaluate("document.documentElement.scrollWidth") == 390


def test_a_tap_chooses(opened):
    tab = opened(390, 844, has_touch=True)
    found = [i for i in range(9) if tab.evaluate("([x, y]) => viewer.at(x, y)", list(middle_of(tab, i))) == i]
    tab.touchscreen.tap(*middle_of(tab, found[0]))
    until(tab, f"viewer.cameras.chosen === {found[0]}")


def test_the_list_of_photos_works_without_seeing(opened):
    """Every control has a name; the list chooses by keyboard alone, and status messages are announced."""
    tab = opened()
    unnamed = tab.evaluate("""() => [...document.querySelectorAll('button, input, canvas, section, summary')]
      .filter((e) => !e.matches('[aria-hidden]'))
      .filter((e) => !(e.textContent.trim() || e.getAttribute('aria-label') || e.labels?.[0]?.textContent.trim()))
      .map((e) => e.outerHTML)""")
    assert unnamed == []
    tab.locator("#cameras summary").focus()
    tab.keyboard.press("Enter")
    tab.keyboard.press("Tab")
    tab.keyboard.press("Tab")
    name = tab.evaluate("document.activeElement.textContent.trim()")
    assert name == tab.evaluate("viewer.facts.cameras[1].name")
    tab.keyboard.press("Enter")
    tab.get_by_role("heading", name=name).wait_for()
    tab.evaluate("viewer.leave()")
    tab.get_by_role("status").filter(has_text=f"{name} is left out").wait_for(state="attached")


def ask(server, path, data=None, token=True, **headers):
    """Send a request; return the status and the body."""
    if token:
        headers = {"Cookie": f"{server.cookie}={server.token}"} | headers
    request = urllib.request.Request(f"http://127.0.0.1:{server.port}{path}", data, headers)
    try:
        with urllib.request.urlopen(request, timeout=180) as answer:
            return answer.status, answer.read()
    except urllib.error.HTTPError as error:
        return error.code, error.read()


def test_photos_are_upright_small_and_only_those_of_the_capture(served, folder):
    name, path = next(iter(served.photos.items()))
    pixels = np.zeros((40, 60, 3), np.uint8)
    pixels[:, :20] = 255  # the left third; turned by 90 degrees clockwise, it is the upper third
    exif = Image.Exif()
    exif[0x0112] = 6
    Image.fromarray(pixels).save(path.with_suffix(".jpg"), exif=exif, quality=95)
    served.photos[name] = path.with_suffix(".jpg")
    status, data = ask(served, f"/thumbs/{name}?side=128")
    image = np.asarray(Image.open(io.BytesIO(data))).astype(int)
    assert (status, image.shape) == (200, (60, 40, 3))
    assert image[:15].mean() > 240
    assert image[25:].mean() < 15
    assert ask(served, f"/thumbs/{name}?side=100")[0] == 400
    for other in ("sparse/0/cameras.txt", "../egg", "%2e%2e/a", ""):
        assert ask(served, f"/thumbs/{other}?side=128")[0] == 404, other
    path.with_suffix(".jpg").write_bytes(b"no photo")
    served.photo.cache_clear()
    status, data = ask(served, f"/thumbs/{name}?side=128")
    assert status == 422
    assert data.count(b"\n") == 1


def test_only_the_page_itself_with_its_token_may_ask(served, folder):
    name = next(iter(served.photos))
    body = json.dumps({"photos": [name], "back": False}).encode()
    origin = {"Origin": f"http://127.0.0.1:{served.port}"}
    for path in ("/", "/findings", f"/thumbs/{name}?side=128"):
        assert ask(served, path, token=False)[0] == 403, path
        assert ask(served, path)[0] == 200, path
        assert ask(served, path, Host="attacker.example")[0] == 403, path
    cookie = {"Cookie": f"{served.cookie}={served.token}"}
    assert ask(served, "/left-out", body, token=False, **origin)[0] == 403
    assert ask(served, "/left-out", body, token=False, **cookie)[0] == 403  # without an Origin
    assert ask(served, "/left-out", body, token=False, **cookie, Origin="http://a.example")[0] == 403
    assert read_left_out(folder) == ()
    assert ask(served, "/findings", body, token=False, **cookie, **origin)[0] == 405
    for bad in (
        b"{",
        b"[]",
        b'{"photos": "a", "back": true}',
        b'{"photos": ["a"]}',
        b'{"photos": ["gone"], "back": false}',
    ):
        assert ask(served, "/left-out", bad, token=False, **cookie, **origin)[0] == 400, bad
    status, answer = ask(served, "/left-out", body, token=False, **cookie, **origin)
    assert (status, json.loads(answer)) == (200, {"left_out": [name]})
    assert read_left_out(folder) == (name,)


def test_the_doctor_examines_in_the_background_and_can_be_stopped(served):
    assert json.loads(ask(served, "/findings")[1]) == {"done": False, "marks": {}, "trouble": ""}
    examination = Examination(served)
    examination.stop()
    examination.run()
    assert served.marks is None
    Examination(served).run()
    assert json.loads(ask(served, "/findings")[1])["done"] is True
    served.marks, served.capture = None, served.capture / "gone"
    Examination(served).run()
    assert "gone" in json.loads(ask(served, "/findings")[1])["trouble"]


def test_axe_finds_nothing_serious(opened):
    tab = opened()
    tab.evaluate("viewer.choose(2)")
    tab.locator("#photo").wait_for()
    for summary in tab.locator("summary:visible").all():
        summary.click()
    assert grave_faults_in_all_styles(tab) == []


def test_a_page_that_is_hidden_draws_again_when_it_is_shown(opened):
    """As in a frame of a page that hides it: the canvas has no size, and its picture would be a single pixel."""
    tab = opened()
    tab.evaluate("document.documentElement.style.display = 'none'")
    resize(tab, 700, 500)
    tab.evaluate("viewer.askFrame()")
    tab.evaluate(FRAMES)
    assert tab.evaluate("viewer.canvas.width") == 900
    tab.evaluate("document.documentElement.style.display = ''")
    awaited(tab, lambda: tab.evaluate("[viewer.canvas.width, viewer.canvas.height]") == [700, 500])
    awaited(tab, lambda: pixels(tab).std() > 5)
