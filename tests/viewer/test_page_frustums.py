"""The capture's cameras over a finished scene: their outlines lie where the cameras are."""

import numpy as np
import pytest

from gsplat_edu.io.scene import Scene
from gsplat_edu.scene.camera import Camera
from gsplat_edu.viewer import page
from viewer.handles import until


@pytest.fixture
def shown(visit, tmp_path, random_gaussians, three_views):
    """A page with three cameras, the second of a held-out photo."""
    path = tmp_path / "scene.html"
    page.write(path, Scene(random_gaussians(50)), three_views, held_out={"second"})
    return visit().open(path).ready()


def corners_of(camera, depth):
    """Return the corners of an image at a camera depth, world units."""
    u = np.array([-0.5, camera.W - 0.5, camera.W - 0.5, -0.5])
    v = np.array([-0.5, -0.5, camera.H - 0.5, camera.H - 0.5])
    local = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones(4)], axis=1) * depth
    return camera.eye + local @ camera.R


def test_outlines_lie_where_the_cameras_are(shown, three_views):
    tab = shown.tab
    view = Camera.looking_at((0.3, -3.0, -7.0), (0, 0, 0), 400, 400, 300, 400)
    described = {
        "R": view.R.tolist(),
        "eye": view.eye.tolist(),
        **{k: getattr(view, k) for k in ("fx", "fy", "cx", "cy", "W", "H")},
    }
    depth = tab.evaluate("viewer.frustums.depth")
    assert depth > 0
    for index, (_, camera) in enumerate(three_views):
        found = tab.evaluate(
            """([index, shown]) => viewer.frustums.lines(viewer.frustums.list[index])
                .map((line) => viewer.frustums.seen(line, shown))""",
            [index, described],
        )
        corners = corners_of(camera, depth)
        expected = []
        for i in range(4):
            for ends in ((camera.eye, corners[i]), (corners[i], corners[(i + 1) % 4])):
                u, v, _ = view.project(view.world_to_cam(np.stack(ends)))
                expected.append([u[0], v[0], u[1], v[1]])
        # facts keep the numbers of cameras as JSON: no rounding but that of the last digit
        assert np.allclose(found, expected, rtol=0, atol=1e-6)
    # a line that begins behind the eye is cut in front of it, and one that lies behind is not drawn
    behind = [(view.eye - 2 * view.R[2]).tolist(), (view.eye + 4 * view.R[2]).tolist()]
    cut = tab.evaluate("([line, shown]) => viewer.frustums.seen(line, shown)", [behind, described])
    assert np.allclose(cut, [view.cx, view.cy] * 2, atol=1e-6)
    gone = [(view.eye - 2 * view.R[2]).tolist(), (view.eye - view.R[2]).tolist()]
    assert tab.evaluate("([line, shown]) => viewer.frustums.seen(line, shown)", [gone, described]) is None


def test_a_box_shows_and_hides_the_outlines(shown):
    tab = shown.tab
    drawn = """() => {
        const canvas = document.getElementById("frustums");
        if (canvas.hidden) return 0;
        const blank = document.createElement("canvas");
        [blank.width, blank.height] = [canvas.width, canvas.height];
        return canvas.toDataURL() === blank.toDataURL() ? 0 : 1;
    }"""
    assert tab.evaluate(drawn) == 0
    tab.click("#fold")
    tab.locator("#cameras summary").click()
    box = tab.get_by_label("show in the scene")
    box.check()
    until(tab, f"({drawn})()")
    assert "held out: dashed" in tab.locator("#cameras").inner_text()
    # the picture moves, and the outlines with it
    before = tab.evaluate("document.getElementById('frustums').toDataURL()")
    tab.locator("#canvas").focus()
    tab.keyboard.press("ArrowLeft")
    until(tab, f"document.getElementById('frustums').toDataURL() !== {before!r}")
    box.uncheck()
    assert tab.evaluate(drawn) == 0
