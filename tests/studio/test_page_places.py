"""Where the photos of a capture were taken, on its screen: cameras in a frame, findings as colours, photos left out."""

import json
import re

import pytest

from data.pose_programs import CAMERAS, write_nvm, write_opensfm
from gsplat_edu.data.chosen_poses import CHOSEN
from gsplat_edu.data.left_out import LEFT_OUT, read_left_out, write_left_out
from gsplat_edu.data.procedural import procedural_capture
from gsplat_edu.data.writers import write_colmap, write_transforms
from gsplat_edu.scene.views import View
from studio.pages import capture_frame, go
from waiting import awaited, resize, until_in

STYLES = "viewer.cameras.list.map((_, i) => [...viewer.cameras.styles.slice(8 * viewer.cameras.firsts[i]).slice(0, 3)])"
"""Colour of each camera's lines."""


@pytest.fixture(scope="module")
def dimmed(library):
    """A capture of 15 photos, some of which are darker by a stop; a sixteenth place is empty."""
    views, points, colors = procedural_capture(96, 16, splats=400)
    views = [
        View(view.camera, view.read().image // (2 if i % 3 == 0 else 1), name=view.name)
        for i, view in enumerate(views)
    ]
    folder = library[0].library.root / "captures" / "dimmed"
    write_colmap(folder, views, points, colors)
    return folder


def test_cameras_are_shown_with_their_photos(visitor, dimmed):
    tab = go(visitor().tab, "captures/dimmed")
    section, frame = tab.get_by_role("region", name="cameras"), capture_frame(tab, "dimmed")
    assert section.get_by_role("heading", name="Where the photos were taken").is_visible()
    assert frame.evaluate("viewer.cameras.list.length") == 16
    frame.evaluate("viewer.choose(4)")
    until_in(tab, frame, "document.getElementById('photo').naturalWidth === 96")
    assert frame.evaluate("viewer.renderer.gl.getError()") == 0
    assert frame.locator("#doctor").is_hidden()  # the studio's own part of the screen asks the doctor


def test_findings_color_the_cameras(visitor, library, dimmed):
    tab = go(visitor().tab, "captures/dimmed")
    part = tab.get_by_role("region", name="doctor")
    frame = capture_frame(tab, "dimmed")
    before = frame.evaluate(STYLES)
    assert len({tuple(color) for color in before}) == 1
    part.get_by_role("button", name=re.compile("^Examine")).click()
    part.locator(".findings li").first.wait_for()
    until_in(tab, frame, "viewer.cameras.list.some(({ marks }) => marks.includes('exposure'))")
    marked = frame.evaluate("viewer.cameras.list.map(({ marks }) => marks.length > 0)")
    found = json.loads(tab.evaluate("fetch('/api/captures/dimmed/findings').then((answer) => answer.text())"))
    named = {name for finding in found["findings"] for name in finding["images"]}
    assert {f"view_{i:03d}.png" for i, is_marked in enumerate(marked) if is_marked} == {
        name for name in named if " and " not in name
    }
    after = frame.evaluate(STYLES)
    assert [color != before[0] for color in after] == marked
    # a page that opens later has the colours as well
    tab.reload()
    frame = capture_frame(tab, "dimmed")
    until_in(tab, frame, "viewer.cameras.list.some(({ marks }) => marks.includes('exposure'))")
    assert frame.evaluate(STYLES) == after


def test_a_photo_is_left_out_in_the_frame_and_taken_back_in_the_gallery(visitor, dimmed):
    tab = go(visitor().tab, "captures/dimmed")
    resize(tab, 900, 900)  # the whole frame is in view
    gallery = tab.get_by_role("region", name="photos")
    gallery.locator(".thumbs li").first.wait_for()
    frame = capture_frame(tab, "dimmed")
    frame.evaluate("viewer.choose(2)")
    frame.locator("#leave").click()
    item = gallery.locator(".thumbs li.left-out")
    item.wait_for()
    assert "view_002.png" in item.inner_text()
    assert read_left_out(dimmed) == ("images/view_002.png",)
    assert frame.evaluate(STYLES)[2] != frame.evaluate(STYLES)[1]
    item.get_by_role("button", name=re.compile("^Use again")).click()
    item.wait_for(state="detached")
    until_in(tab, frame, "!viewer.cameras.list[2].left_out")
    assert not (dimmed / LEFT_OUT).exists()
    assert frame.locator("#leave").inner_text() == "Leave out"


def test_the_page_follows_the_capture(page, studio, tmp_path):
    """It is made again after a photo was left out, and names no capture outside of the library."""
    views, points, colors = procedural_capture(48, 6)
    folder = studio.library.root / "captures" / "six"
    write_colmap(folder, views, points, colors)
    answer = page.get("/api/captures/six/page")
    assert answer.status_code == 200
    assert "frame-ancestors 'self'" in answer.headers["Content-Security-Policy"]
    assert '"left_out":true' not in answer.text
    cached = list((studio.library.hidden("cache") / "pages").glob("*.html"))
    assert page.get("/api/captures/six/page").text == answer.text
    assert list((studio.library.hidden("cache") / "pages").glob("*.html")) == cached
    write_left_out(folder, ["images/view_001.png"])
    assert page.get("/api/captures/six/page").text.count('"left_out":true') == 1
    for name in ("gone", "..", "%2e%2e"):
        assert page.get(f"/api/captures/{name}/page").status_code in (400, 404), name
    (studio.library.root / "captures" / "none").mkdir()
    refused = page.get("/api/captures/none/page")
    assert refused.status_code == 400
    assert "is not a capture" in refused.json()["error"]


def test_whose_poses_are_read_is_chosen_where_several_programs_left_some(visitor, library):
    folder = library[0].library.root / "captures" / "both"
    write_opensfm(folder)
    tab = go(visitor().tab, "captures/both")
    tab.get_by_text("Poses of OpenSfM: 6 of 6 photos").wait_for()
    select = tab.get_by_label("Cameras from")
    assert select.is_hidden()  # there is nothing to choose
    write_nvm(folder, CAMERAS[:4])
    tab.reload()
    select.wait_for()
    assert select.input_value() == ""
    frame = capture_frame(tab, "both")
    until_in(tab, frame, "viewer.cameras.list.length === 6")
    select.select_option("VisualSFM")
    tab.get_by_text("Poses of VisualSFM: 4 of 6 photos").wait_for()
    assert (folder / CHOSEN).read_text() == "any name.nvm\n"
    awaited(tab, lambda: capture_frame(tab, "both").evaluate("viewer.cameras.list.length") == 4)
    tab.reload()
    tab.get_by_label("Cameras from").wait_for()
    assert tab.get_by_label("Cameras from").input_value() == "any name.nvm"
    (folder / "any name.nvm").unlink()
    tab.reload()
    tab.get_by_text("The cameras that were chosen are gone. Choose others.").wait_for()
    select.select_option("the file that train reads by itself")
    tab.get_by_text("Poses of OpenSfM: 6 of 6 photos").wait_for()
    assert select.is_hidden() and not (folder / CHOSEN).exists()


def test_a_colmap_model_is_chosen_before_a_transforms_json(visitor, library):
    """The list names programs; a path is only in an option's tooltip."""
    folder = library[0].library.root / "captures" / "two"
    views, points, colors = procedural_capture(48, 6)
    write_transforms(folder, views)
    write_colmap(folder, views[:4], points, colors)
    tab = go(visitor().tab, "captures/two")
    select = tab.get_by_label("Cameras from")
    select.wait_for()
    assert select.locator("option").all_inner_texts()[1:] == ["transforms.json", "COLMAP"]
    until_in(tab, capture_frame(tab, "two"), "viewer.cameras.list.length === 6")
    select.select_option("COLMAP")
    awaited(tab, lambda: capture_frame(tab, "two").evaluate("viewer.cameras.list.length") == 4)
    assert (folder / CHOSEN).read_text() == "sparse/0/images.bin\n"
    write_colmap(folder / "colmap", views[:5], points, colors)
    tab.reload()
    select.locator("option").nth(3).wait_for(state="attached")
    assert select.locator("option").all_inner_texts()[2:] == ["COLMAP (1 of 2)", "COLMAP (2 of 2)"]
    assert select.input_value() == "sparse/0/images.bin"


def test_models_of_colmap_can_be_chosen(page, studio):
    folder = studio.library.root / "captures" / "two"
    views, points, colors = procedural_capture(48, 6)
    write_transforms(folder, views)
    write_colmap(folder, views[:4], points, colors)
    address = "/api/captures/two/poses"
    files = [
        {"file": "transforms.json", "program": "transforms.json"},
        {"file": "sparse/0/images.bin", "program": "COLMAP"},
    ]
    assert page.get(address).json() == {"files": files, "chosen": None, "lost": False}
    assert page.post(address, json={"file": "sparse/0/images.bin"}).status_code == 200
    assert page.get(address).json()["chosen"] == "sparse/0/images.bin"
    assert "using the poses of transforms.json" not in page.get("/api/captures/two/notes").text
    for wrong in ("sparse/0", "sparse/0/cameras.bin", "sparse/1/images.bin"):
        assert page.post(address, json={"file": wrong}).status_code == 400
    (folder / "transforms.json").unlink()
    assert page.post(address, json={"file": ""}).status_code == 200
    assert page.get(address).json() == {"files": [], "chosen": None, "lost": False}


def test_only_files_with_poses_can_be_chosen(page, studio):
    folder = studio.library.root / "captures" / "both"
    write_opensfm(folder)
    address = "/api/captures/both/poses"
    assert page.get(address).json() == {"files": [], "chosen": None, "lost": False}
    write_nvm(folder, CAMERAS[:4])
    files = [
        {"file": "any name.nvm", "program": "VisualSFM"},
        {"file": "reconstruction.json", "program": "OpenSfM"},
    ]
    assert page.get(address).json() == {"files": files, "chosen": None, "lost": False}
    for wrong in ("images/shot_0.png", "../x", "/etc/passwd"):
        refused = page.post(address, json={"file": wrong})
        assert refused.status_code == 400 and "is no file with poses" in refused.json()["error"]
    assert page.post(address, json={"file": "reconstruction.json"}).status_code == 200
    assert page.get(address).json() == {"files": files, "chosen": "reconstruction.json", "lost": False}
    (folder / "any name.nvm").unlink()
    (folder / CHOSEN).write_text("any name.nvm")
    assert page.get(address).json() == {"files": files[1:], "chosen": None, "lost": True}
    assert page.post(address, json={"file": ""}).status_code == 200
    assert page.get(address).json()["chosen"] is None and not (folder / CHOSEN).exists()
