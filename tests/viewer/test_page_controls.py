"""Mouse, finger and key controls of a page in a browser."""

import time

import numpy as np
import pytest
import torch

import gestures
from accessibility import numbers
from gsplat_edu.io.scene import Scene
from gsplat_edu.scene.camera import Camera, look_at
from gsplat_edu.scene.gaussians import Gaussians
from gsplat_edu.viewer import page
from viewer.handles import until
from waiting import FRAMES, awaited, resize

SIZE = (640, 400)
MIDDLE = (130, 180)  # left of the controls


@pytest.fixture
def tour(show, random_gaussians, three_views):
    """Open a small page with three cameras, and its controls."""
    size = {"width": SIZE[0], "height": SIZE[1]}
    return show(random_gaussians(60), three_views, **size, has_touch=True, fresh=True).open_controls()


def pivot(visit):
    return np.array(visit.evaluate("viewer.view.centre()"))


def drag(visit, dx, dy, button="left"):
    """Drag beside the controls; return the camera afterwards."""
    gestures.drag(visit.tab, MIDDLE, (MIDDLE[0] + dx, MIDDLE[1] + dy), button=button)
    return visit.camera()


def touch(visit, before, after):
    """Put fingers down, move and lift them; positions are (right, down) from `MIDDLE`."""
    session = visit.tab.context.new_cdp_session(visit.tab)
    for kind, places in (("touchStart", before), ("touchMove", after), ("touchEnd", ())):
        gestures.touch(session, kind, *((MIDDLE[0] + x, MIDDLE[1] + y) for x, y in places))
    session.detach()
    return visit.camera()


def wheel(visit, amount):
    """Turn the wheel; wait until the view has moved. Playwright does not wait for that."""
    eye = visit.camera().eye.tolist()
    visit.tab.mouse.wheel(0, amount)
    until(visit.tab, f"viewer.view.camera.eye.some((x, i) => x !== {eye}[i])")


def test_a_mouse_orbits_pans_zooms_and_looks_around(tour):
    before, centre = tour.camera(), pivot(tour)
    after = drag(tour, 50, 20)
    np.testing.assert_allclose(pivot(tour), centre, atol=1e-9)
    distance = np.linalg.norm(before.eye - centre)
    assert np.linalg.norm(after.eye - centre) == pytest.approx(distance)
    moved = before.R @ (after.eye - before.eye)
    # the scene follows the pointer right and down, so the camera moves left and up
    assert moved[0] < -0.2 and moved[1] < -0.1
    # the cameras surround the scene, so a drag across the longer side, 640 px, is half a turn
    angles = np.pi / 640 * np.array([50, 20])
    between = np.arccos(after.R[2] @ before.R[2])
    assert max(angles) * 0.9 < between < np.hypot(*angles)

    tour.press("r")
    for button, shift in (("right", False), ("middle", False), ("left", True)):
        before, centre = tour.camera(), pivot(tour)
        if shift:
            tour.tab.keyboard.down("Shift")
        after = drag(tour, 40, -30, button)
        tour.tab.keyboard.up("Shift")
        np.testing.assert_array_equal(after.R, before.R)
        # the point ahead stays under the pointer
        was, is_now = (np.array(one.project(one.world_to_cam(centre))[:2]) for one in (before, after))
        np.testing.assert_allclose(is_now - was, (40, -30), atol=1e-6)

    tour.press("r")
    centre = pivot(tour)
    distances = []
    for amount in (0, -300, 800):
        tour.tab.mouse.move(*MIDDLE)
        if amount:
            wheel(tour, amount)
        distances.append(np.linalg.norm(tour.camera().eye - centre))
        np.testing.assert_allclose(pivot(tour), centre, atol=1e-9)
    assert distances[1] < distances[0] < distances[2]

    tour.press("r")
    before = tour.camera()
    tour.press("f")
    assert tour.tab.get_attribute("#fly", "aria-pressed") == "true"
    after = drag(tour, 40, 10)
    np.testing.assert_array_equal(after.eye, before.eye)
    assert before.R[0] @ after.R[2] > 0.1 and before.R[1] @ after.R[2] > 0.05, (
        "the view rotates right and down"
    )
    wheel(tour, -200)
    assert after.R[2] @ (tour.camera().eye - after.eye) > 0.1, "the wheel moves forward"
    tour.tab.click("#fly")
    assert tour.tab.get_attribute("#fly", "aria-pressed") == "false"
    assert not np.array_equal(drag(tour, 40, 10).eye, after.eye)


KEYS = {"w": (2, 1), "s": (2, -1), "a": (0, -1), "d": (0, 1), "q": (1, 1), "e": (1, -1)}


def test_keys_move_along_the_cameras_axes_while_they_are_held_and_show_help(tour):
    for key, (axis, sign) in KEYS.items():
        before = tour.camera()
        tour.tab.keyboard.down(key)
        tour.tab.wait_for_selector("#rate:has-text('frames/s')")
        awaited(tour.tab, lambda before=before: np.linalg.norm(tour.camera().eye - before.eye) > 0.02)
        tour.tab.keyboard.up(key)
        after = tour.camera()
        steps = sign * (before.R @ (after.eye - before.eye))
        assert steps[axis] > 0.01, key
        np.testing.assert_allclose(np.delete(steps, axis), 0, atol=1e-9)
        np.testing.assert_array_equal(after.R, before.R)
        tour.tab.wait_for_selector("#rate:empty", state="attached")
        np.testing.assert_array_equal(tour.camera().eye, after.eye)

    tour.tab.keyboard.down("w")
    tour.evaluate("dispatchEvent(new Event('blur'))")
    tour.evaluate(FRAMES)
    before = tour.camera()
    tour.evaluate(FRAMES)
    np.testing.assert_array_equal(tour.camera().eye, before.eye)

    assert tour.tab.is_hidden("#help")
    tour.press("h")
    assert tour.tab.is_visible("#help")
    tour.tab.click("#help-button")
    assert tour.tab.is_hidden("#help")

    tour.tab.wait_for_selector("#rate:empty", state="attached")
    text = tour.open_controls().tab.inner_text("#tools")
    assert "Shine" in text and "harmonics" not in text and "rest" not in text
    assert tour.tab.locator("#degree option").all_inner_texts() == ["off", "1 of 3", "2 of 3", "full"]


def stands_at(visit, camera: Camera):
    here = visit.camera()
    return np.array_equal(here.R, camera.R) and np.array_equal(here.eye, camera.eye)


def test_the_captures_cameras_and_the_way_back_to_the_start(tour, three_views, camera):
    def marked():
        return tour.tab.locator("#cameras button[aria-current=true]").all_inner_texts()

    first, second, third = (camera for _, camera in three_views)
    assert stands_at(tour, first)
    tour.tab.click("#cameras summary")
    assert tour.tab.locator("#cameras button").all_inner_texts() == ["photo 1", "photo 2", "photo 3"]
    assert marked() == ["photo 1"]
    tour.tab.click("text='photo 2'")
    assert stands_at(tour, second) and marked() == ["photo 2"]
    # Enlarged 2.5 times, the 200 x 160 image fills the window's height; at most a fifth of it may be cropped.
    assert tour.camera().fx == pytest.approx(1.25 * 2.5 * second.fx)
    tour.press("ArrowRight")
    assert stands_at(tour, third)
    tour.press("ArrowRight")
    assert stands_at(tour, first)
    tour.press("ArrowLeft")
    assert stands_at(tour, third)
    drag(tour, 10, 0)
    assert marked() == []
    tour.press("ArrowRight")
    assert stands_at(tour, first)
    drag(tour, 10, 0)
    tour.press("ArrowLeft")
    assert stands_at(tour, third)

    tour.press("r")
    for reset in (lambda: tour.press("r"), lambda: tour.tab.click("#reset")):
        drag(tour, 30, 30)
        assert not stands_at(tour, three_views[0][1])
        reset()
        assert stands_at(tour, three_views[0][1])

    tour.press("r")
    far = Camera(np.eye(3), (0.0, 0.0, -9.0), 50.0, 60.0, 20.0, 30.0, 50, 70)
    assert tour.picture(far).shape == (50, 70, 3)
    assert (tour.camera().W, tour.camera().H) == (70, 50)
    drag(tour, 5, 0)
    assert (tour.camera().W, tour.camera().H) == SIZE


def test_a_narrow_window_shows_the_subject_and_is_filled_by_it(visit, tmp_path, random_gaussians):
    """Twelve cameras surround a ball; each photo shows the ball on the left, and a wall on the right."""
    ball = random_gaussians(300)
    ball.means.mul_(0.35 / 0.6)
    ball.logit_opacities.fill_(3.0)
    views = []
    for angle in np.linspace(0, 2 * np.pi, 12, endpoint=False):
        eye = (4 * np.sin(angle), -0.5, -4 * np.cos(angle))
        views.append(
            (f"{angle:.2f}", Camera(look_at(eye, (0, 0, 0)), eye, 300.0, 300.0, 80.0, 120.0, H=240, W=400))
        )
    (tmp_path / "ball.html").write_bytes(page.html(Scene(ball), views))
    seen = visit(390, 844).open(tmp_path / "ball.html").ready()
    inner = ball.means.double().numpy()
    inner = inner[np.linalg.norm(inner, axis=1) < 0.6]
    for index in (None, 3, 8):
        if index is not None:
            seen.evaluate(f"viewer.goTo({index})")
        shown = seen.camera()
        u, v, _ = shown.project(shown.world_to_cam(inner))
        assert u.min() > 0 and u.max() < 390 and v.min() > 0 and v.max() < 844, "the whole ball is in view"
        # beside it, as much of the wall as fits: the window shows half more than the photo's height
        assert u.max() - u.min() > 0.4 * 390, "the ball fills the window"
        assert abs(u.max() + u.min() - 390) < 0.2 * 390, "the ball is in the middle"
        # the whole height of the photo is in view, so that its middle is the window's, and the ball is a little above
        assert abs(v.max() + v.min() - 844) < 0.15 * 844


@pytest.mark.parametrize("scheme", ["dark", "light"])
def test_the_page_fits_a_phone_and_is_dark_in_both_themes(
    visit, tmp_path, random_gaussians, three_views, scheme
):
    (tmp_path / "a.html").write_bytes(page.html(Scene(random_gaussians(9)), three_views))
    seen = visit(390, 844, color_scheme=scheme, has_touch=True).open(tmp_path / "a.html").ready()
    assert not seen.tab.is_visible("#tools"), "the controls are closed at first"
    seen.open_controls()
    resize(seen.tab, 844, 390)
    resize(seen.tab, 390, 844)
    seen.tab.evaluate(FRAMES)
    assert seen.tab.is_visible("#tools"), "the user has opened it"
    ground = seen.evaluate("getComputedStyle(document.body).backgroundColor")
    assert sum(numbers(ground)[:3]) < 100
    for name in ("cameras", "path"):
        seen.tab.click(f"#{name} summary")
    boxes = seen.evaluate(
        "[...document.querySelectorAll('button, select, summary')].filter((one) => one.checkVisibility())"
        ".map((one) => one.getBoundingClientRect())"
        ".map(({ left, right, height, width }) => [left, right, height, width])"
    )
    assert len(boxes) > 8
    for left, right, height, width in boxes:
        assert height >= 40 and width >= 40 and left >= 0 and right <= 390
    assert seen.evaluate("document.documentElement.scrollWidth") == 390


def test_held_out_cameras_are_marked_and_none_is_the_start(visit, tmp_path, random_gaussians, three_views):
    page.write(tmp_path / "a.html", Scene(random_gaussians(9)), three_views, held_out={"first"})
    seen = visit(640, 480).open(tmp_path / "a.html").ready().open_controls()
    seen.tab.click("#cameras summary")
    names = seen.tab.locator("#cameras button").all_inner_texts()
    assert names == ["photo 1 held out", "photo 2", "photo 3"]
    assert seen.tab.locator("#cameras button[aria-current=true]").all_inner_texts() == ["photo 2"]
    assert stands_at(seen, three_views[1][1])
    seen.press("ArrowLeft")
    assert stands_at(seen, three_views[0][1])
    seen.press("r")
    assert stands_at(seen, three_views[1][1])


def on_the_screen(visit, point):
    camera = visit.camera()
    return np.array(camera.project(camera.world_to_cam(point))[:2])


@pytest.fixture
def wall(show):
    """A near ball at the right, in front of a far wall of balls; a wrong click would hit the wall."""
    x, y = np.meshgrid(np.linspace(-4, 4, 15), np.linspace(-3, 3, 11))
    means = np.stack([x.ravel(), y.ravel(), np.full(x.size, 6.0)], axis=1)
    means = np.concatenate([means, [[0.8, 0.3, 2.0]]])
    count = len(means)
    gaussians = Gaussians(
        means=torch.tensor(means, dtype=torch.float32),
        quats=torch.tensor([[1.0, 0, 0, 0]]).repeat(count, 1),
        log_scales=torch.tensor([[-1.0] * 3] * (count - 1) + [[-2.5] * 3]),
        sh0=torch.zeros(count, 1, 3),
        sh_rest=torch.zeros(count, 0, 3),
        logit_opacities=torch.full((count,), 3.0),
    )
    view = ("a", Camera(np.eye(3), (0.0, 0.0, 0.0), 250.0, 250.0, 160.0, 100.0, 200, 320))
    return show(gaussians, [view], width=SIZE[0], height=SIZE[1], has_touch=True, fresh=True)


def click_twice(visit, by, x, y, pause):
    """Click or tap twice, `pause` seconds apart by the times of the events, also on a slow computer."""
    session = visit.tab.context.new_cdp_session(visit.tab)
    start = time.time()
    for moment in (start, start + pause):
        for pressed in (True, False):
            at = {"timestamp": moment + (0.0 if pressed else 0.05)}
            if by == "mouse":
                kind = {
                    "type": "mousePressed" if pressed else "mouseReleased",
                    "button": "left",
                    "clickCount": 1,
                }
                session.send("Input.dispatchMouseEvent", {**kind, **at, "x": x, "y": y})
            else:
                places = [{"x": x, "y": y, "id": 0}] if pressed else []
                kind = {"type": "touchStart" if pressed else "touchEnd", "touchPoints": places}
                session.send("Input.dispatchTouchEvent", {**kind, **at})
    session.detach()
    end = start + pause + 0.5
    awaited(
        visit.tab, lambda: time.time() > end, "the time of the last event, which later ones must not precede"
    )


@pytest.mark.parametrize("by", ["mouse", "finger"])
def test_a_double_click_or_tap_sets_the_pivot_on_the_surface_there(wall, by):
    before = wall.camera()
    column, row = on_the_screen(wall, (0.8, 0.3, 2.0)) + 0.5
    click_twice(wall, by, column, row, pause=0.3)
    until(wall.tab, "element('point').style.left !== ''")
    found = pivot(wall)
    # the ball's sigma is 0.08, and half of its opacity is reached at or before its centre
    np.testing.assert_allclose(found, (0.8, 0.3, 2.0), atol=0.1)
    np.testing.assert_array_equal(wall.camera().eye, before.eye)
    np.testing.assert_array_equal(wall.camera().R, before.R)
    after = drag(wall, 0, 30)
    np.testing.assert_allclose(pivot(wall), found)
    assert not np.array_equal(after.R, before.R)
    # the point keeps its place in the window, because the view orbits about it
    np.testing.assert_allclose(on_the_screen(wall, found) + 0.5, (column, row), atol=1)
    wall.tab.wait_for_selector("#point", state="hidden")
    wall.press("r")
    assert np.linalg.norm(pivot(wall) - found) > 0.5, "the start view restores its pivot"


def test_one_click_or_two_distant_clicks_do_not_set_the_pivot(wall):
    before = pivot(wall)
    wall.tab.mouse.click(450, 250)
    wall.tab.mouse.click(300, 250)
    for by in ("mouse", "finger"):
        click_twice(wall, by, 450, 250, pause=0.6)
    drag(wall, 20, 0)
    drag(wall, -20, 0)
    np.testing.assert_allclose(pivot(wall), before)


@pytest.mark.parametrize(
    ("options", "shown"), [({}, "mouse"), ({"has_touch": True, "is_mobile": True}, "touch")]
)
def test_the_help_matches_the_visitors_device(show, random_gaussians, options, shown):
    seen = show(random_gaussians(9), width=390, height=600, fresh=True, **options)
    seen.tab.click("#help-button")
    visible = seen.tab.locator("#help tr:visible")
    assert visible.count() > 3
    assert {row.get_attribute("class") for row in visible.all()} == {shown}
    text = seen.tab.inner_text("#help")
    assert ("double tap" in text, "W A S D" in text) == (shown == "touch", shown == "mouse")


def test_fingers_orbit_pan_and_pinch(tour):
    before, centre = tour.camera(), pivot(tour)
    after = touch(tour, [(0, 0)], [(60, 0)])
    np.testing.assert_allclose(pivot(tour), centre, atol=1e-9)
    assert (before.R @ (after.eye - before.eye))[0] < -0.2

    tour.press("r")
    before, centre = tour.camera(), pivot(tour)
    panned = touch(tour, [(-20, 0), (20, 0)], [(-20, 30), (20, 30)])
    np.testing.assert_allclose(panned.R, before.R, atol=1e-12)
    distance = np.linalg.norm(before.eye - centre)
    assert np.linalg.norm(panned.eye - pivot(tour)) == pytest.approx(distance, rel=0.1)
    assert (before.R @ (panned.eye - before.eye))[1] < -0.1
    pinched = touch(tour, [(-20, 0), (20, 0)], [(-40, 0), (40, 0)])
    # the fingers are twice as far apart, so the scene between them appears twice as large
    assert np.linalg.norm(pinched.eye - pivot(tour)) == pytest.approx(distance / 2, rel=0.15)


def orbits(seen, *keys):
    """Press keys; return whether the camera moved on a sphere around the pivot."""
    eye, pivot = seen.camera().eye, np.array(seen.evaluate("viewer.view.focus"))
    for key in keys:
        seen.press(key)
    moved = seen.camera().eye
    same = np.linalg.norm(moved - pivot) == pytest.approx(np.linalg.norm(eye - pivot))
    return same and np.linalg.norm(moved - eye) > 0.01 * np.linalg.norm(eye - pivot)


def test_arrows_orbit_with_shift_and_without_cameras_to_step_through(show, random_gaussians, three_views):
    alone = show(random_gaussians(30))
    assert orbits(alone, "ArrowRight") and orbits(alone, "ArrowDown") and orbits(alone, "Shift+ArrowLeft")
    seen = show(random_gaussians(30), three_views)
    assert orbits(seen, "Shift+ArrowRight") and orbits(seen, "ArrowUp")
    seen.press("ArrowRight")
    assert any(stands_at(seen, camera) for _, camera in three_views), "as before: the next camera"
    seen.open_controls().tab.focus("#degree")
    assert not orbits(seen, "ArrowDown"), "the panel keeps its keys"
