"""A mesh is made, shown beside the splats and downloaded in the studio's page."""

import re
import shutil

import numpy as np
import pytest

from gsplat_edu.io.mesh_files import read_mesh, write_mesh
from gsplat_edu.scene.mesh import Mesh
from studio.pages import go
from waiting import until_in


def viewer_frame(tab):
    """Return the frame with the page that shows the mesh, once its address has arrived."""
    frame = tab.locator("section[aria-label=mesh] iframe").element_handle().content_frame()
    frame.wait_for_url(re.compile("surface="), wait_until="commit")
    return frame


def test_a_mesh_is_made_shown_beside_the_splats_and_downloaded(visitor, library, wall_entry):
    person = visitor()
    tab = person.tab
    go(tab, "scenes/wall/share")
    section = tab.get_by_role("region", name="mesh")
    assert not section.get_by_role("button", name="Show beside the splats").is_visible()
    assert not section.get_by_text("texture of the photos").is_visible()  # a scene has no photos
    section.locator("summary", has_text="More").click()
    tab.get_by_label("Edge of a voxel").fill("0.1")
    tab.get_by_role("button", name="Make a mesh").click()
    show = section.get_by_role("button", name="Show beside the splats")
    show.wait_for()
    command = person.command("mesh of wall")
    assert re.search(
        r"^gsplat-edu mesh \S*/wall\.ply \S*/scenes/wall/exports/wall\.mesh\.glb --voxel 0\.1$", command
    )

    # a collider, here of another program, is shown as well
    corners = np.array([[-1.5, -1, 0], [1.5, -1, 0], [0, 1, 0.2]])
    write_mesh(wall_entry / "exports" / "wall.collider.glb", Mesh(corners, np.array([[0, 1, 2]])))
    tab.reload()  # the mesh and its job are still there
    show.wait_for()
    section.get_by_role("article", name="mesh of wall").wait_for()
    show.click()
    frame = viewer_frame(tab)
    until_in(tab, frame, "window.viewer?.meshes && document.getElementById('message').hidden")
    mesh = read_mesh(wall_entry / "exports" / "wall.mesh.glb")
    assert 50 < len(mesh.faces) < 50_000
    assert frame.evaluate("viewer.meshes.surface.faces.length") == mesh.faces.size
    assert frame.evaluate("viewer.meshes.collider.faces.length") == 3
    until_in(tab, frame, "document.getElementById('mesh-line').checkVisibility()")

    item = tab.locator(".exports li", has_text="wall.mesh.glb")
    with tab.expect_download() as download:
        item.get_by_role("link", name="Download").click()
    assert download.value.suggested_filename == "wall.mesh.glb"
    stored = (wall_entry / "exports" / "wall.mesh.glb").read_bytes()
    assert download.value.path().read_bytes() == stored


def test_a_removed_mesh_is_undone_at_once_or_from_the_trash(visitor, library, wall_entry):
    exports = wall_entry / "exports"
    shutil.rmtree(exports, ignore_errors=True)  # of another test of this library
    exports.mkdir()
    mesh = exports / "wall.mesh.glb"
    mesh.write_bytes(b"eight minutes")
    tab = visitor().tab
    go(tab, "scenes/wall/share")
    listed = tab.locator(".exports li", has_text="wall.mesh.glb")
    away = listed.get_by_role("button", name="Move to the trash")
    away.click()
    listed.wait_for(state="detached")
    assert not mesh.exists()
    tab.get_by_role("button", name="Undo", exact=True).click()
    listed.wait_for()
    assert mesh.read_bytes() == b"eight minutes"
    assert not tab.get_by_text("wall.mesh.glb is in the trash").is_visible()

    away.click()
    go(tab, "trash")
    tab.get_by_text("wall.mesh.glb, a file of scenes/wall").wait_for()
    clear = tab.get_by_role("button", name="Empty the trash").bounding_box()
    assert clear["width"] < tab.viewport_size["width"] / 2
    tab.get_by_role("button", name="Restore").click()
    tab.get_by_text("The trash is empty.").wait_for()
    assert mesh.read_bytes() == b"eight minutes"


def test_the_open_trash_shows_what_another_tab_removes_and_restores(visitor, library, wall_entry):
    exports = wall_entry / "exports"
    shutil.rmtree(exports, ignore_errors=True)  # of another test of this library
    exports.mkdir()
    (exports / "wall.mesh.glb").write_bytes(b"eight minutes")
    watching, tab = visitor().tab, visitor().tab
    go(watching, "trash")
    row = watching.get_by_text("wall.mesh.glb, a file of scenes/wall")
    watching.get_by_role("heading", name="Trash").wait_for()
    assert not row.is_visible()
    go(tab, "scenes/wall/share")
    tab.locator(".exports li", has_text="wall.mesh.glb").get_by_role(
        "button", name="Move to the trash"
    ).click()
    row.wait_for()
    tab.get_by_role("button", name="Undo", exact=True).click()
    row.wait_for(state="detached")


def test_an_exported_page_carries_the_mesh_on_request(visitor, library, wall_entry):
    exports = wall_entry / "exports"
    shutil.rmtree(exports, ignore_errors=True)  # of another test of this library
    exports.mkdir()
    person = visitor()
    tab = person.tab
    go(tab, "scenes/wall/share")
    tab.get_by_label("Title and name of the file").fill("plain")
    box = tab.get_by_label("show the mesh")
    tab.get_by_role("button", name="Export").click()
    listed = tab.locator(".exports li")
    listed.filter(has_text="plain.html").wait_for()
    assert not box.is_visible()  # there is no mesh
    assert not page_has(tab, exports / "plain.html", "viewer.meshes")

    corners = np.array([[-1.5, -1, 0], [1.5, -1, 0], [0, 1, 0.2], [0, 1, 1]])
    faces = np.array([[0, 1, 2], [0, 1, 3]])
    write_mesh(exports / "wall.mesh.glb", Mesh(corners, faces))
    write_mesh(exports / "wall.collider.glb", Mesh(corners, faces[:1]))
    size = sum((exports / f"wall.{name}.glb").stat().st_size for name in ("mesh", "collider"))
    tab.reload()
    box.wait_for()
    said = tab.locator("label.check", has=box).text_content()
    assert re.search(r"show the mesh and the collider beside the splats \(about ([\d.]+) kB more\)", said), (
        said
    )
    assert float(re.search(r"([\d.]+) kB", said)[1]) == pytest.approx(size / 1000, rel=0.06)
    tab.get_by_label("SPZ").first.check()
    assert not box.is_visible()  # only a page shows a mesh
    tab.get_by_label("HTML page").check()
    box.check()
    tab.get_by_label("Title and name of the file").fill("both")
    go(tab, "scenes/wall")
    go(tab, "scenes/wall/share")
    assert tab.get_by_label("Title and name of the file").input_value() == "both", "it is remembered"
    box.check()
    tab.get_by_role("button", name="Export").click()
    listed.filter(has_text="both.html").wait_for()
    command = person.command("export of both.html")
    assert "--surface" in command and command.split()[-1] == "--verify"
    assert page_has(tab, exports / "both.html", "viewer.meshes.surface.faces.length === 6")
    assert page_has(tab, exports / "both.html", "viewer.meshes.collider.faces.length === 3")


def page_has(tab, path, what):
    """Open an exported page and return whether an expression is true there."""
    other = tab.context.new_page()
    other.goto(path.as_uri())
    other.wait_for_selector("#message", state="hidden")
    found = other.evaluate(f"Boolean({what})")
    other.close()
    return found


def test_a_page_shows_only_exported_meshes(page, studio, tmp_path):
    """The address can name no other file."""
    folder = studio.library.root / "scenes" / "toy"
    (folder / "exports").mkdir(parents=True)
    (folder / "toy.ply").write_bytes(b"ply")
    (folder / "exports" / "toy.spz").write_bytes(b"spz")
    for name in ("gone.mesh.glb", "toy.spz", "../toy.ply", "%2e%2e%2ftoy.ply", "/etc/passwd"):
        answer = page.get(f"/api/scenes/toy/page?surface={name}")
        assert answer.status_code in (400, 404), name
        assert answer.json()["error"].count("\n") == 0
