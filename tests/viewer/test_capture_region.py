"""The region of interest on the page of a capture: drawn, moved, resized, saved, removed, by pointer and by keys."""

import json

import numpy as np
import pytest

from accessibility import grave_faults_in_all_styles
from gestures import drag
from gsplat_edu.data.region import REGION, read_region, write_region
from gsplat_edu.scene.region import Region
from viewer.handles import until
from viewer.test_capture_page import ask, folder, opened, served, view_of  # noqa: F401

SHAPE = "viewer.region.shape"


def drawing(tab):
    tab.get_by_role("button", name="draw a box").click()
    until(tab, "viewer.region.drawing")
    return tab.evaluate(SHAPE)


def seen(tab, point):
    """Return where a point of the scene is in the window, CSS px."""
    camera = view_of(tab)
    u, v, _ = camera.project(camera.world_to_cam(np.array(point)))
    return float(u) + 0.5, float(v) + 0.5


def test_a_box_is_drawn_around_the_subject_moved_saved_and_removed(opened, folder):  # noqa: F811
    tab = opened(1200, 800)
    camera = view_of(tab)
    box = drawing(tab)
    assert tab.get_by_role("region", name="box").is_visible()
    x, y = seen(tab, box["center"])
    drag(tab, (x, y), (x + 30, y - 20))  # the handle's middle
    moved = tab.evaluate(SHAPE)
    assert np.allclose(seen(tab, moved["center"]), (x + 30, y - 20), atol=0.5)
    assert moved["half"] == box["half"] and moved["rotation"] == box["rotation"]
    assert np.allclose(view_of(tab).R, camera.R)  # the drag did not orbit
    tab.get_by_role("button", name="save the box").click()
    until(tab, "!viewer.region.drawing")
    saved = read_region(folder)
    assert np.allclose(saved.center, moved["center"]) and np.allclose(saved.rotation, moved["rotation"])
    tab.reload()
    until(tab, "Boolean(window.viewer?.isWhole && viewer.region.saved)")
    assert np.allclose(tab.evaluate("viewer.region.saved.center"), moved["center"])
    until(tab, "!viewer.region.overlay.canvas.hidden")  # its lines, once the next picture is drawn
    tab.get_by_role("button", name="remove the box").click()
    until(tab, "viewer.region.saved === null")
    assert not (folder / REGION).exists()
    until(tab, "viewer.region.overlay.canvas.hidden")


def test_a_side_is_dragged_and_a_drag_elsewhere_orbits(opened):  # noqa: F811
    tab = opened(1200, 800)
    box = drawing(tab)
    places = tab.evaluate(f"boxHandles({SHAPE}).map(({{ point }}) => point)")
    free = """([x, y]) => {
      const { gizmo } = viewer.region;
      return !gizmo.partAt(viewer.camera(), viewer.region.pointOf(viewer.camera(), x, y), 12);
    }"""
    side = next(i for i, point in enumerate(places) if tab.evaluate(free, list(seen(tab, point))))
    at, middle = np.array(seen(tab, places[side])), np.array(seen(tab, box["center"]))
    away = (at - middle) / np.linalg.norm(at - middle)
    drag(tab, at, at + 40 * away)
    now = tab.evaluate(SHAPE)
    grown = np.array(now["half"]) - box["half"]
    assert grown[side // 2] > 0 and np.count_nonzero(np.abs(grown) > 1e-9) == 1
    other = tab.evaluate(f"boxHandles({SHAPE}).map(({{ point }}) => point)")[side ^ 1]
    assert np.allclose(other, places[side ^ 1])
    before = view_of(tab)
    drag(tab, (1000, 700), (940, 680))
    assert not np.allclose(view_of(tab).R, before.R) and tab.evaluate(SHAPE) == now


def test_keys_alone_draw_a_box(opened, folder):  # noqa: F811
    tab = opened()
    tab.get_by_role("button", name="draw a box").focus()
    tab.keyboard.press("Enter")
    until(tab, "viewer.region.drawing")
    box = tab.evaluate(SHAPE)
    tab.get_by_role("button", name="turn y").focus()
    tab.keyboard.press("Enter")
    tab.keyboard.press("ArrowRight")
    turned = tab.evaluate(SHAPE)
    assert not np.allclose(turned["rotation"], box["rotation"]) and turned["center"] == box["center"]
    tab.keyboard.press("Escape")  # lets the part go
    assert tab.evaluate("viewer.region.gizmo.chosen") is None
    field = tab.get_by_role("group", name="half of the box's size").get_by_label("x")
    field.fill("0.25")
    assert tab.evaluate(SHAPE)["half"][0] == 0.25
    field.fill("-1")
    assert tab.evaluate(SHAPE)["half"][0] == 0.25
    tab.get_by_role("button", name="save the box").focus()
    tab.keyboard.press("Enter")
    until(tab, "!viewer.region.drawing")
    assert read_region(folder).half[0] == 0.25
    tab.get_by_role("button", name="change the box").focus()
    tab.keyboard.press("Enter")
    tab.locator("#canvas").focus()
    tab.keyboard.press("Escape")
    assert not tab.evaluate("viewer.region.drawing")
    assert read_region(folder).half[0] == 0.25


def test_on_a_phone_the_box_stays_in_sight_and_nothing_is_grave(opened):  # noqa: F811
    tab = opened(390, 844, has_touch=True, is_mobile=True)
    tab.get_by_role("button", name="controls").tap()
    tab.get_by_role("button", name="draw a box").tap()
    until(tab, "viewer.region.drawing && viewer.isWhole")
    panel = tab.get_by_role("region", name="box").bounding_box()
    x, y = seen(tab, tab.evaluate(SHAPE)["center"])
    assert 0 < x < 390 and 60 < y < panel["y"]
    assert panel["x"] >= 0 and panel["x"] + panel["width"] <= 390
    for button in tab.get_by_role("region", name="box").get_by_role("button").all():
        assert button.bounding_box()["height"] >= 40
    assert grave_faults_in_all_styles(tab) == []


@pytest.mark.parametrize(
    "given",
    [b"{}", b'{"region": 3}', b'{"region": {"center": [0, 0, 0]}}', b'{"region": null, "a": 1}', b"["],
)
def test_a_request_that_is_no_box_is_refused(served, folder, given):  # noqa: F811
    write_region(folder, Region(np.zeros(3), np.eye(3), np.ones(3)))
    sent = {
        "Cookie": f"{served.cookie}={served.token}",
        "Origin": f"http://127.0.0.1:{served.port}",
    }
    assert ask(served, "/region", given, token=False, **sent)[0] == 400
    assert ask(served, "/region", b'{"region": null}', token=False, Cookie=sent["Cookie"])[0] == 403
    assert json.loads(ask(served, "/region")[1])["region"]["half"] == [1.0, 1.0, 1.0]
    (folder / REGION).write_text("{")
    status, said = ask(served, "/region")
    assert status == 422 and b"is not an object" not in said and b"is not JSON" in said
