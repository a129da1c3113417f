"""What a page shows at first, in windows of any shape: nothing that matters is cropped or lies under the panel."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from accessibility import contrast, numbers
from gsplat_edu.io.scene import Scene
from gsplat_edu.render.settings import RenderSettings
from gsplat_edu.runs.source import Source
from gsplat_edu.scene.camera import Camera, look_at
from gsplat_edu.scene.gaussians import Gaussians
from gsplat_edu.viewer import page
from gsplat_edu.viewer.edit_page import editing_of
from gsplat_edu.viewer.export import write
from gsplat_edu.viewer.page_start import Start

DESKTOP, PHONE = (1440, 900), (390, 844)
UP = np.array([0.0, -1.0, 0.0])

EDGES = """[...document.querySelectorAll('#tools :is(button, select)')].filter((one) => one.checkVisibility()).map(
(one) => {
  const sheet = one.closest('#tools, #help, #edit');
  const { borderTopWidth, borderTopColor, backgroundColor } = getComputedStyle(one);
  const edge = parseFloat(borderTopWidth) ? borderTopColor : backgroundColor;
  return [one.id, edge, getComputedStyle(sheet).backgroundColor];
})"""


def figure(random_gaussians):
    """A body of 1.6 units with a head of 50 splats above it, and nothing else."""
    body = random_gaussians(1500)
    spread = np.random.default_rng(4).uniform(-1.0, 1.0, (1500, 3)) * (0.3, 0.75, 0.2) + (0.0, 0.05, 0.0)
    head = np.random.default_rng(5).uniform(-1.0, 1.0, (50, 3)) * (0.1, 0.12, 0.1) + (0.0, -0.85, 0.0)
    body.means.copy_(torch.tensor(np.concatenate([head, spread[50:]]), dtype=torch.float32))
    body.logit_opacities.fill_(4.0)
    return body, head


def around(W, H, focal):
    """Twelve cameras around zero."""
    views = []
    for angle in np.linspace(0, 2 * np.pi, 12, endpoint=False):
        eye = (3 * np.sin(angle), 0.0, -3 * np.cos(angle))
        camera = Camera(look_at(eye, (0, 0, 0)), eye, focal, focal, (W - 1) / 2, (H - 1) / 2, H, W)
        views.append((f"{angle:.2f}", camera))
    return views


def on_the_screen(seen, points):
    """Return columns and rows of points in the window, CSS px."""
    camera = seen.camera()
    u, v, _ = camera.project(camera.world_to_cam(points))
    return u, v


def test_no_head_is_cut_off_in_a_wide_window(visit, tmp_path, random_gaussians):
    body, head = figure(random_gaussians)
    page.write(tmp_path / "figure.html", Scene(body), around(640, 480, 700.0))
    seen = visit(*DESKTOP).open(tmp_path / "figure.html").ready()
    _, rows = on_the_screen(seen, head)
    assert rows.min() > 0, f"the head begins {-rows.min():.0f} px above the window"


def test_the_editors_box_starts_around_the_subject_and_not_around_a_large_floor(random_gaussians, tmp_path):
    body, _ = figure(random_gaussians)
    floor = random_gaussians(4000)
    floor.means.copy_(
        torch.tensor(np.random.default_rng(6).uniform(-40.0, 40.0, (4000, 3)) * (1, 0, 1) + (0, 3, 0))
    )
    floor.logit_opacities.fill_(4.0)
    scene = Scene(Gaussians.concatenated([body, floor]))
    source = Source(tmp_path / "scene.ply", scene, tuple(around(640, 480, 300.0)), RenderSettings())
    box = editing_of(source, tmp_path / "scene.ply", tmp_path / "edits.json").facts["subject"]
    low, high = (np.array(box["center"]) + sign * np.abs(box["rotation"]) @ box["half"] for sign in (-1, 1))
    assert (low < body.means.numpy().min(0) + 0.1).all() and (high > body.means.numpy().max(0) - 0.1).all()
    assert (high - low < 2.5 * np.array([0.6, 1.8, 0.4])).all()
    bare = replace(source, cameras=())
    assert editing_of(bare, tmp_path / "scene.ply", tmp_path / "edits.json").facts["subject"] is None


@pytest.mark.parametrize(("W", "H"), [(640, 480), (480, 640), (900, 300)])
def test_a_cover_shows_the_whole_subject_in_the_middle(random_gaussians, W, H):
    """Photos of each shape, whose upper edge cuts the head, or which see the body as a narrow strip."""
    body, head = figure(random_gaussians)
    views = around(W, H, 1.5 * H)
    camera = page.cover_view(Scene(body), views, {"0.00"}, None, (512, 384))
    assert (camera.W, camera.H) == (512, 384)
    for points in (head, body.means.double().numpy()):
        u, v, z = camera.project(camera.world_to_cam(points))
        assert (z > 0).all() and u.min() > 0 and u.max() < 511 and v.min() > 0 and v.max() < 383
    assert not np.allclose(camera.eye, views[0][1].eye), "it was held out"
    chosen = Start(views[5][1], np.zeros(3), UP, -1)
    assert np.allclose(page.cover_view(Scene(body), views, set(), chosen, (512, 384)).eye, views[5][1].eye)


def test_no_head_is_cut_off_on_a_phone_and_the_picture_stays_when_the_controls_open(
    visit, tmp_path, random_gaussians
):
    body, head = figure(random_gaussians)
    (tmp_path / "figure.html").write_bytes(page.html(Scene(body), around(480, 640, 940.0)))
    seen = visit(*PHONE).open(tmp_path / "figure.html").ready()
    columns, rows = on_the_screen(seen, head)
    assert rows.min() > 0 and columns.min() > 0 and columns.max() < PHONE[0]
    before = rows.min()
    seen.open_controls()
    assert on_the_screen(seen, head)[1].min() == before


def test_a_phone_shows_the_ear_at_the_side_of_the_photo(visit, tmp_path, random_gaussians):
    """Portrait photos, and few splats near their left edge, which do not count for the subject."""
    body, _ = figure(random_gaussians)
    ear = np.random.default_rng(7).uniform(-0.02, 0.02, (20, 3)) + np.array([-0.66, 0.3, 0.0])
    body.means[-20:] = torch.tensor(ear, dtype=torch.float32)
    views = around(480, 800, 1000.0)
    u, _, _ = views[0][1].project(views[0][1].world_to_cam(ear))
    assert u.min() > 0 and u.max() < 0.1 * 480, "it is in the photo, and far from its middle"
    (tmp_path / "figure.html").write_bytes(page.html(Scene(body), views))
    seen = visit(*PHONE).open(tmp_path / "figure.html").ready()
    columns, rows = on_the_screen(seen, ear)
    assert columns.min() > 0 and columns.max() < PHONE[0] and rows.min() > 0 and rows.max() < PHONE[1]
    camera = seen.camera()
    scale = camera.fx / views[0][1].fx
    assert scale == pytest.approx(PHONE[0] / 480), "the whole width of the photo, and no more"


@pytest.mark.parametrize("size", [DESKTOP, PHONE])
def test_the_poster_lies_where_the_first_picture_shows_the_same(visit, tmp_path, random_gaussians, size):
    body, _ = figure(random_gaussians)
    source = Source(tmp_path / "body.ply", Scene(body), tuple(around(480, 640, 800.0)), RenderSettings())
    write(tmp_path / "body.html", source)
    seen = visit(*size).open(tmp_path / "body.html").ready()
    start = page.usual_start(source.scene, source.cameras, source.held_out).camera
    camera, box = (
        seen.camera(),
        seen.tab.evaluate("document.getElementById('poster').getBoundingClientRect()"),
    )
    scale = camera.fx / start.fx
    assert (box["width"], box["height"]) == pytest.approx((scale * start.W, scale * start.H), abs=0.2)
    for edge, principal, place in ((box["x"], start.cx, camera.cx), (box["y"], start.cy, camera.cy)):
        assert edge + scale * (principal + 0.5) == pytest.approx(place + 0.5, abs=1.0)


@pytest.mark.parametrize("size", [DESKTOP, PHONE, (844, 390)])
def test_a_saved_view_keeps_its_content_in_a_window_of_any_shape(visit, tmp_path, random_gaussians, size):
    """The view is chosen by hand: two heaps, one of which few cameras of the capture see."""
    gaussians = random_gaussians(200)
    heaps = np.random.default_rng(6).uniform(-0.15, 0.15, (200, 3))
    heaps[:, 0] += np.where(np.arange(200) % 2, 0.9, -0.9)
    gaussians.means.copy_(torch.tensor(heaps, dtype=torch.float32))
    gaussians.logit_opacities.fill_(4.0)
    eye = (0.0, 0.0, -3.0)
    chosen = Camera(look_at(eye, (0, 0, 0)), eye, 400.0, 400.0, 159.5, 119.5, 240, 320)
    tour = page.Tour(start=Start(chosen, np.zeros(3), UP, -1), views=[("both heaps", chosen)])
    page.write(tmp_path / "heaps.html", Scene(gaussians), around(640, 480, 2000.0), tour=tour)
    seen = visit(*size).open(tmp_path / "heaps.html").ready()
    for go in ("0", "viewer.goTo(3)", "viewer.goTo(0)", "viewer.reset()"):
        seen.evaluate(go)
        if go == "viewer.goTo(3)":
            continue
        columns, rows = on_the_screen(seen, heaps)
        assert columns.min() > 0 and columns.max() < size[0], f"{columns.min():.0f} to {columns.max():.0f}"
        assert rows.min() > 0 and rows.max() < size[1]
        assert columns.max() - columns.min() > 0.4 * min(size), "and is not small"


@pytest.mark.parametrize("scheme", ["dark", "light"])
@pytest.mark.parametrize("scene", [0, 255])
def test_buttons_are_seen_over_a_scene_of_any_brightness(
    visit, tmp_path, random_gaussians, three_views, scheme, scene
):
    (tmp_path / "a.html").write_bytes(page.html(Scene(random_gaussians(9)), three_views))
    seen = visit(640, 480, color_scheme=scheme).open(tmp_path / "a.html").ready().open_controls()
    seen.tab.click("#path summary")
    found = seen.evaluate(EDGES)
    assert len(found) >= 5
    for name, edge, sheet in found:
        (*color, opacity), (*line, _) = numbers(sheet), numbers(edge)
        ratio = contrast(line, opacity * np.array(color) + (1 - opacity) * scene)
        assert ratio >= 3, f"{name or 'a button'}: contrast {ratio:.2f} of its edge with the panel"
