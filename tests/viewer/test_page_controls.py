"""Mouse, fingers and keys of a page, in a real browser."""

import numpy as np
import pytest

from gsplat_edu.camera import Camera

SIZE = (640, 400)
MIDDLE = (400, 250)  # beside the panel


@pytest.fixture
def tour(show, random_gaussians, three_views):
    """A small page with three cameras, opened."""
    return show(random_gaussians(60), three_views, width=SIZE[0], height=SIZE[1], has_touch=True)


def pivot(visit):
    return np.array(visit.tab.evaluate("viewer.view.centre()"))


def drag(visit, dx, dy, button="left", steps=3):
    mouse = visit.tab.mouse
    mouse.move(*MIDDLE)
    mouse.down(button=button)
    mouse.move(MIDDLE[0] + dx, MIDDLE[1] + dy, steps=steps)
    mouse.up(button=button)
    return visit.camera()


def touch(visit, before, after):
    """Put fingers down, move them and lift them; each is (right, down) of the middle."""
    session = visit.tab.context.new_cdp_session(visit.tab)
    for kind, places in (("touchStart", before), ("touchMove", after), ("touchEnd", ())):
        fingers = [{"x": MIDDLE[0] + x, "y": MIDDLE[1] + y, "id": i} for i, (x, y) in enumerate(places)]
        session.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": fingers})
    session.detach()
    visit.tab.wait_for_timeout(100)
    return visit.camera()


def test_a_drag_orbits_about_the_point_ahead(tour):
    before, centre = tour.camera(), pivot(tour)
    after = drag(tour, 50, 20)
    np.testing.assert_allclose(pivot(tour), centre, atol=1e-9)
    distance = np.linalg.norm(before.eye - centre)
    assert np.linalg.norm(after.eye - centre) == pytest.approx(distance)
    moved = before.R @ (after.eye - before.eye)
    # what is in front goes with the pointer, right and down: the camera goes left and up
    assert moved[0] < -0.2 and moved[1] < -0.1
    # half a turn for a drag across the shorter side, 400 px
    angles = np.pi / 400 * np.array([50, 20])
    between = np.arccos(after.R[2] @ before.R[2])
    assert max(angles) * 0.9 < between < np.hypot(*angles)


def test_no_drag_turns_the_world_over(tour):
    for dy in (90, 90, 90, -90, -90, -90, -90, -90, -90):
        after = drag(tour, 3, dy, steps=12)
        assert -after.R[1] @ tour.tab.evaluate("viewer.view.up") > 0


def test_a_right_drag_pans(tour):
    for button, shift in (("right", False), ("middle", False), ("left", True)):
        before, centre = tour.camera(), pivot(tour)
        if shift:
            tour.tab.keyboard.down("Shift")
        after = drag(tour, 40, -30, button)
        np.testing.assert_array_equal(after.R, before.R)
        # the point ahead stays under the pointer
        was, is_now = (np.array(one.project(one.world_to_cam(centre))[:2]) for one in (before, after))
        np.testing.assert_allclose(is_now - was, (40, -30), atol=1e-6)


def test_the_wheel_goes_nearer_and_farther(tour):
    centre = pivot(tour)
    distances = []
    for amount in (0, -300, 800):
        tour.tab.mouse.move(*MIDDLE)
        tour.tab.mouse.wheel(0, amount)
        tour.tab.wait_for_timeout(100)
        distances.append(np.linalg.norm(tour.camera().eye - centre))
        np.testing.assert_allclose(pivot(tour), centre, atol=1e-9)
    assert distances[1] < distances[0] < distances[2]


KEYS = {"w": (2, 1), "s": (2, -1), "a": (0, -1), "d": (0, 1), "q": (1, 1), "e": (1, -1)}


def test_keys_move_along_the_cameras_axes_while_they_are_held(tour):
    for key, (axis, sign) in KEYS.items():
        before = tour.camera()
        tour.tab.keyboard.down(key)
        tour.tab.wait_for_selector("#rate:has-text('frames/s')")
        tour.tab.wait_for_timeout(100)
        tour.tab.keyboard.up(key)
        after = tour.camera()
        steps = sign * (before.R @ (after.eye - before.eye))
        assert steps[axis] > 0.01, key
        np.testing.assert_allclose(np.delete(steps, axis), 0, atol=1e-9)
        np.testing.assert_array_equal(after.R, before.R)
        tour.tab.wait_for_selector("#rate:has-text('at rest')")
        np.testing.assert_array_equal(tour.camera().eye, after.eye)


def test_a_key_let_go_elsewhere_does_not_move_on(tour):
    tour.tab.keyboard.down("w")
    tour.tab.evaluate("dispatchEvent(new Event('blur'))")
    tour.tab.wait_for_timeout(60)
    before = tour.camera()
    tour.tab.wait_for_timeout(100)
    np.testing.assert_array_equal(tour.camera().eye, before.eye)


def test_flying_a_drag_looks_around(tour):
    before = tour.camera()
    tour.tab.keyboard.press("f")
    assert tour.tab.get_attribute("#fly", "aria-pressed") == "true"
    after = drag(tour, 40, 10)
    np.testing.assert_array_equal(after.eye, before.eye)
    assert before.R[0] @ after.R[2] > 0.1 and before.R[1] @ after.R[2] > 0.05, "to the right and down"
    tour.tab.mouse.wheel(0, -200)
    tour.tab.wait_for_timeout(100)
    assert after.R[2] @ (tour.camera().eye - after.eye) > 0.1, "forward"
    tour.tab.click("#fly")
    assert tour.tab.get_attribute("#fly", "aria-pressed") == "false"
    assert not np.array_equal(drag(tour, 40, 10).eye, after.eye)


def stands_at(visit, camera: Camera):
    here = visit.camera()
    return np.array_equal(here.R, camera.R) and np.array_equal(here.eye, camera.eye)


def test_the_captures_cameras(tour, three_views):
    def marked():
        return tour.tab.locator("#cameras button[aria-current=true]").all_inner_texts()

    first, second, third = (camera for _, camera in three_views)
    assert stands_at(tour, first)
    tour.tab.click("summary")
    assert tour.tab.locator("#cameras button").all_inner_texts() == ["first", "second", "third <b>"]
    assert marked() == ["first"]
    tour.tab.click("text='second'")
    assert stands_at(tour, second) and marked() == ["second"]
    # its image, 200 x 160, fills the height of the window
    assert tour.camera().fx == pytest.approx(second.fx * SIZE[1] / 160)
    tour.tab.keyboard.press("ArrowRight")
    assert stands_at(tour, third)
    tour.tab.keyboard.press("ArrowRight")
    assert stands_at(tour, first)
    tour.tab.keyboard.press("ArrowLeft")
    assert stands_at(tour, third)
    drag(tour, 10, 0)
    assert marked() == []
    tour.tab.keyboard.press("ArrowRight")
    assert stands_at(tour, first)
    drag(tour, 10, 0)
    tour.tab.keyboard.press("ArrowLeft")
    assert stands_at(tour, third)


def test_back_to_the_start(tour, three_views):
    for reset in (lambda: tour.tab.keyboard.press("r"), lambda: tour.tab.click("#reset")):
        drag(tour, 30, 30)
        assert not stands_at(tour, three_views[0][1])
        reset()
        assert stands_at(tour, three_views[0][1])


def test_help_is_there_when_it_is_asked_for(tour):
    assert tour.tab.is_hidden("#help")
    tour.tab.keyboard.press("h")
    assert tour.tab.is_visible("#help")
    tour.tab.click("#help-button")
    assert tour.tab.is_hidden("#help")


def test_one_finger_orbits(tour):
    before, centre = tour.camera(), pivot(tour)
    after = touch(tour, [(0, 0)], [(60, 0)])
    np.testing.assert_allclose(pivot(tour), centre, atol=1e-9)
    assert (before.R @ (after.eye - before.eye))[0] < -0.2


def test_two_fingers_pan_and_pinch(tour):
    before, centre = tour.camera(), pivot(tour)
    panned = touch(tour, [(-20, 0), (20, 0)], [(-20, 30), (20, 30)])
    np.testing.assert_allclose(panned.R, before.R, atol=1e-12)
    distance = np.linalg.norm(before.eye - centre)
    assert np.linalg.norm(panned.eye - pivot(tour)) == pytest.approx(distance, rel=0.1)
    assert (before.R @ (panned.eye - before.eye))[1] < -0.1

    pinched = touch(tour, [(-20, 0), (20, 0)], [(-40, 0), (40, 0)])
    # the fingers are twice as far apart: what is between them too
    assert np.linalg.norm(pinched.eye - pivot(tour)) == pytest.approx(distance / 2, rel=0.15)


def test_a_program_sets_the_camera_until_somebody_moves(tour, camera):
    far = Camera(np.eye(3), (0.0, 0.0, -9.0), 50.0, 60.0, 20.0, 30.0, 50, 70)
    assert tour.picture(far).shape == (50, 70, 3)
    assert (tour.camera().W, tour.camera().H) == (70, 50)
    drag(tour, 5, 0)
    assert (tour.camera().W, tour.camera().H) == SIZE
