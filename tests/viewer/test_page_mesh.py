"""The page draws a mesh beside its splats as a ray caster does, and finds its surface exactly."""

import base64
import json
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gestures import drag
from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.cli.main import main
from gsplat_edu.edits.document import parse_edits
from gsplat_edu.edits.identity import identity_of
from gsplat_edu.io.edit import IDENTITY, Similarity
from gsplat_edu.io.formats import write_scene
from gsplat_edu.io.mesh_files import read_mesh, write_mesh
from gsplat_edu.io.scene import Scene
from gsplat_edu.runs.source import Source, file_settings, open_source
from gsplat_edu.scene.camera import Camera, look_at
from gsplat_edu.scene.mesh import Mesh, Texture
from gsplat_edu.viewer import page, page_mesh
from gsplat_edu.viewer.edit_page import editing_of
from gsplat_edu.viewer.edited import edited_meshes
from gsplat_edu.viewer.page_mesh import Meshes, open_meshes
from viewer.pages import described

BACKGROUND = (0.2, 0.5, 0.8)

VIEW = Camera(
    look_at((0.4, -0.9, -2.6), (0.0, 0.0, 0.0)), (0.4, -0.9, -2.6), 190.0, 210.0, 88.3, 61.6, 120, 180
)
"""The image is not square, and the principal point is off its centre."""

PIXELS = """async (camera) => {
  await viewer.setCamera(camera);
  return btoa(String.fromCharCode(...viewer.meshes.pixels(camera)));
}"""


def ball(rings=9, around=14):
    """A closed ellipsoid with a dent, whose colours vary smoothly."""
    polar, azimuth = np.linspace(0, np.pi, rings), np.linspace(0, 2 * np.pi, around, endpoint=False)
    grid = [(np.sin(p) * np.cos(a), -np.cos(p), np.sin(p) * np.sin(a)) for p in polar[1:-1] for a in azimuth]
    vertices = np.array([(0.0, -1.0, 0.0), *grid, (0.0, 1.0, 0.0)]) * (0.9, 0.6, 0.7)
    vertices[len(vertices) // 2] *= 0.3
    faces, last = [], len(vertices) - 1
    for j in range(around):
        k = (j + 1) % around
        faces += [(0, 1 + j, 1 + k), (last, last - around + k, last - around + j)]
        for i in range(rings - 3):
            a, b = 1 + i * around + j, 1 + i * around + k
            faces += [(a, a + around, b), (b, a + around, b + around)]
    colors = (0.5 + 0.45 * np.sin(3 * vertices)).astype(np.float32)
    return Mesh(vertices, np.array(faces), colors)


def painted_ball():
    """The ball under a texture of a ramp and a wave; each face shows a triangle of its own."""
    mesh, size = ball(), 64
    x, y = np.meshgrid(np.arange(size), np.arange(size))
    image = np.stack([4 * x, 4 * y, 127 + 100 * np.sin(x / 9) * np.cos(y / 7)], axis=2).astype(np.uint8)
    uvs = np.random.default_rng(4).uniform(0.02, 0.98, (len(mesh.faces), 3, 2)).astype(np.float32)
    return Mesh(mesh.vertices, mesh.faces, None, Texture(image, uvs))


def cast(mesh, origins, directions):
    """Return for each ray the nearest face (-1 for none), its distance and its barycentric coordinates, in float64."""
    a, b, c = np.moveaxis(mesh.corners, 1, 0)
    e, f, s = b - a, c - a, origins[:, None] - a
    p = np.cross(directions[:, None], f)
    det = (e * p).sum(-1)
    with np.errstate(divide="ignore", invalid="ignore"):
        u = (s * p).sum(-1) / det
        q = np.cross(s, e)
        v = (directions[:, None] * q).sum(-1) / det
        t = (f * q).sum(-1) / det
    t = np.where((u >= 0) & (v >= 0) & (u + v <= 1) & (t > 0.05), t, np.inf)
    face = t.argmin(axis=1)
    rows = np.arange(len(t))
    weights = np.stack([1 - u - v, u, v], axis=2)[rows, face]
    distance = t[rows, face]
    return np.where(np.isfinite(distance), face, -1), distance, weights


def rays(camera, columns, rows):
    """Return directions with depth 1 through places of the image, in the world's axes."""
    x, y = (columns - camera.cx) / camera.fx, (rows - camera.cy) / camera.fy
    return np.stack([x, y, np.ones_like(x)], axis=1) @ camera.R


def colors_at(mesh, face, weights, directions):
    """Return the colours of hits, (N, 3) in 0 to 255."""
    if mesh.texture is not None:
        image = mesh.texture.image.astype(np.float64)
        size = np.array(image.shape[1::-1])
        place = (weights[:, :, None] * mesh.texture.uvs[face]).sum(1) * size - 0.5
        low = np.floor(place).astype(int)
        part = place - low

        def texel(dx, dy):
            x, y = (np.clip(low[:, i] + d, 0, size[i] - 1) for i, d in ((0, dx), (1, dy)))
            return image[y, x]

        top = texel(0, 0) * (1 - part[:, :1]) + texel(1, 0) * part[:, :1]
        bottom = texel(0, 1) * (1 - part[:, :1]) + texel(1, 1) * part[:, :1]
        return top * (1 - part[:, 1:]) + bottom * part[:, 1:]
    if mesh.colors is not None:
        return 255 * (weights[:, :, None] * mesh.colors[mesh.faces[face]]).sum(1)
    normals = mesh.face_normals()[face]
    facing = (
        abs((normals * directions).sum(1))
        / np.linalg.norm(normals, axis=1)
        / np.linalg.norm(directions, axis=1)
    )
    return 255 * (0.3 + 0.7 * facing)[:, None] * np.array([0.75, 0.74, 0.72])


def written(tmp_path, random_gaussians, meshes, views=()):
    path = tmp_path / "scene.html"
    settings = file_settings(Scene(random_gaussians(20)))
    settings = type(settings)(**{**settings.__dict__, "background": BACKGROUND})
    page.write(path, Scene(random_gaussians(20)), views, settings, tour=page.Tour(meshes=meshes))
    return path


@pytest.fixture
def opened(visit, tmp_path, random_gaussians):
    """Open a page with a surface and perhaps a collider."""

    def make(surface, collider=None, **options):
        path = written(tmp_path, random_gaussians, Meshes(surface, collider), [("view", VIEW)])
        return visit(**options).open(path).ready()

    return make


def drawn(seen, camera=VIEW):
    data = base64.b64decode(seen.evaluate(PIXELS, described(camera)))
    return np.frombuffer(data, np.uint8).reshape(camera.H, camera.W, 3)


def uncolored():
    return Mesh(ball().vertices, ball().faces)


@pytest.mark.parametrize(("make", "steps"), [(ball, 1.6), (painted_ball, 2.6), (uncolored, 1.1)])
def test_a_glb_is_drawn_as_a_ray_caster_draws_it(opened, tmp_path, make, steps):
    """Pixels whose corners and centre see one face are compared: `steps` of 1/255 cover the rounding of the colours
    given (1/2) and of the picture (1/2), float32, and 8 bits of the fraction of a texel, whose neighbours differ by up
    to 12. Pixels with no face at these places show the background exactly; the rest are the silhouette and edges, which
    mix several samples."""
    write_mesh(tmp_path / "ball.glb", make())
    mesh = read_mesh(tmp_path / "ball.glb")
    picture = drawn(opened(mesh)).reshape(-1, 3).astype(np.float64)
    rows, columns = np.indices((VIEW.H, VIEW.W)).reshape(2, -1).astype(np.float64)
    faces = []
    for dx, dy in ((0, 0), (-0.5, -0.5), (0.5, -0.5), (-0.5, 0.5), (0.5, 0.5)):
        directions = rays(VIEW, columns + dx, rows + dy)
        face, _, weights = cast(mesh, np.broadcast_to(VIEW.eye, directions.shape), directions)
        if not faces:
            expected = colors_at(mesh, face, weights, directions)
        faces.append(face)
    one = np.logical_and.reduce([face == faces[0] for face in faces])
    inside, outside = one & (faces[0] >= 0), one & (faces[0] < 0)
    assert inside.mean() > 0.1
    assert outside.mean() > 0.3
    assert abs(picture[inside] - expected[inside]).max() <= steps
    assert (picture[outside] == np.rint(255 * np.array(BACKGROUND))).all()
    # the silhouette is where the ray caster has it, to a pixel
    silhouette = (abs(picture - 255 * np.array(BACKGROUND)) > 1).any(axis=1)
    never = np.logical_and.reduce([face < 0 for face in faces])
    always = np.logical_and.reduce([face >= 0 for face in faces])
    assert not silhouette[never].any()
    assert silhouette[always].mean() > 0.995  # a colour may be that of the background


@pytest.mark.parametrize("make", [ball, painted_ball, uncolored])
def test_the_back_of_a_face_is_darker(opened, make):
    front, mesh = drawn(opened(make())).astype(np.float64), make()
    texture = mesh.texture and Texture(mesh.texture.image, mesh.texture.uvs[:, ::-1])
    back = drawn(opened(Mesh(mesh.vertices, mesh.faces[:, ::-1], mesh.colors, texture)))
    rows, columns = np.indices((VIEW.H, VIEW.W)).reshape(2, -1).astype(np.float64)
    inside = np.ones((VIEW.H, VIEW.W), bool)  # pixels whose corners all see the mesh
    for dx, dy in ((-0.5, -0.5), (0.5, -0.5), (-0.5, 0.5), (0.5, 0.5)):
        directions = rays(VIEW, columns + dx, rows + dy)
        face, _, _ = cast(mesh, np.broadcast_to(VIEW.eye, directions.shape), directions)
        inside &= (face >= 0).reshape(inside.shape)
    assert inside.sum() > 1000
    # samples and their mean are rounded to 1/255: the front's twice, and the back's twice
    assert abs(back - 0.4 * front)[inside].max() <= 1.4 + 1e-9


def test_the_line_has_splats_on_its_left_and_the_mesh_on_its_right(opened):
    seen = opened(ball(), width=320, height=240)
    tab = seen.tab
    shown = "document.getElementById('mesh-line').getBoundingClientRect()"
    tab.evaluate("camera => viewer.setCamera(camera)", described(VIEW))
    canvas = """() => {
      const gl = viewer.renderer.gl;
      viewer.put(viewer.camera());
      const bytes = new Uint8Array(4 * gl.canvas.width * gl.canvas.height);
      gl.bindFramebuffer(gl.FRAMEBUFFER, null);
      gl.readPixels(0, 0, gl.canvas.width, gl.canvas.height, gl.RGBA, gl.UNSIGNED_BYTE, bytes);
      return btoa(String.fromCharCode(...bytes));
    }"""

    def screen():
        data = np.frombuffer(base64.b64decode(tab.evaluate(canvas)), np.uint8)
        return data.reshape(VIEW.H, VIEW.W, 4)[::-1, :, :3].astype(int)

    splats = np.rint(255 * seen.picture(VIEW).clip(0, 1)).astype(int)
    mesh = drawn(seen).astype(int)
    for share in (0.5, 0.25, 1.0, 0.0):
        tab.evaluate("share => viewer.meshes.split(share)", share)
        cut, found = round(share * VIEW.W), screen()
        assert abs(found[:, :cut] - splats[:, :cut]).max(initial=0) <= 1
        assert (found[:, cut:] == mesh[:, cut:]).all()
    # by keyboard, and by dragging the line
    seen.open_controls()
    slider = tab.get_by_role("slider")
    slider.focus()
    tab.keyboard.press("ArrowRight")
    assert slider.get_attribute("aria-valuetext") == "splats 1 %, mesh 99 %"
    box = tab.evaluate(f"() => ({{ x: {shown}.x, y: {shown}.y, width: {shown}.width }})")
    drag(tab, (box["x"] + box["width"] / 2, 200), (240, 200))
    assert tab.evaluate("viewer.meshes.share") == pytest.approx(0.75)
    assert tab.evaluate(f"{shown}.x + 22") == pytest.approx(240)


def test_wireframe_and_collider(opened):
    collider = Mesh(1.1 * ball(5, 6).vertices, ball(5, 6).faces)
    seen = opened(ball(), collider, width=320, height=240)
    tab = seen.tab
    surface = drawn(seen).astype(int)
    seen.open_controls()
    tab.select_option("#mesh-style", "edges")
    edges = drawn(seen).astype(int)
    darker = (edges < surface - 20).any(axis=2)
    assert 0.02 < darker.mean() < 0.5
    # at the silhouette, the offset of faces may show one behind
    assert (edges <= surface + 1).all(axis=2).mean() > 0.99
    tab.select_option("#mesh-style", "wireframe")
    wires = drawn(seen).astype(int)
    background = np.rint(255 * np.array(BACKGROUND))
    lines = (abs(wires - background) > 20).any(axis=2)
    assert (lines & darker).sum() > 0.8 * lines.sum()  # the same edges, without the faces
    # the collider is over both sides, and one may hide it
    alpha = """() => {
      const { gl, above } = viewer.meshes;
      const bytes = new Uint8Array(4 * above.width * above.height);
      gl.bindFramebuffer(gl.FRAMEBUFFER, above.resolved);
      gl.readPixels(0, 0, above.width, above.height, gl.RGBA, gl.UNSIGNED_BYTE, bytes);
      return btoa(String.fromCharCode(...bytes));
    }"""
    data = np.frombuffer(base64.b64decode(tab.evaluate(alpha)), np.uint8).reshape(VIEW.H, VIEW.W, 4)[::-1]
    rows, columns = np.indices((VIEW.H, VIEW.W)).reshape(2, -1).astype(np.float64)
    directions = rays(VIEW, columns, rows)
    face, _, _ = cast(collider, np.broadcast_to(VIEW.eye, directions.shape), directions)
    hit = (face >= 0).reshape(VIEW.H, VIEW.W)
    assert ((data[..., 3] > 0) == hit).mean() > 0.97  # apart from the pixels at the silhouette
    assert np.median(data[hit][:, 3]) == round(255 * 0.3)
    assert tab.locator("#mesh-collider").is_checked()
    tab.evaluate("document.getElementById('mesh-collider').click()")
    assert not tab.evaluate("viewer.meshes.showsCollider")


def test_measuring_snaps_to_the_mesh(visit, tmp_path, random_gaussians):
    """Two clicks on the mesh give the points that the ray caster finds; beside it, the splats decide."""
    mesh = Mesh(ball().vertices.astype(np.float32).astype(np.float64), ball().faces)
    scene = Scene(random_gaussians(40))
    source = Source(tmp_path / "scene.ply", scene, (("view", VIEW),), file_settings(scene))
    editing = editing_of(source, tmp_path / "scene.ply", tmp_path / "edits.json")
    tour = page.Tour(meshes=Meshes(mesh))
    html = page.html(scene, source.cameras, source.settings, "scene", (), tour, editing)
    (tmp_path / "edit.html").write_bytes(html)
    tab = visit(width=1200, height=600).open(tmp_path / "edit.html").ready().tab
    tab.wait_for_selector("#edit-side")
    assert tab.evaluate("viewer.meshes.share") == 1  # the picture to edit is that of the splats
    tab.evaluate("document.querySelector('[data-tool=measure]').click()")
    tab.evaluate("() => { viewer.goTo(0); return viewer.settled(); }")
    camera = Camera(**{k: v for k, v in tab.evaluate("viewer.camera()").items() if k in described(VIEW)})
    center = camera.world_to_cam(np.array([[0.1, -0.1, 0.0], [-0.2, 0.15, 0.1]]))
    clicks = np.rint(center[:, :2] / center[:, 2:] * (camera.fx, camera.fy) + (camera.cx, camera.cy))
    for column, row in clicks:
        tab.mouse.click(column + 0.5, row + 0.5)
    found = np.array(tab.evaluate("editor.tools.points"))
    seen = tab.evaluate("([x, y]) => editor.tools.pointOf(viewer.camera(), x, y)", (clicks[0] + 0.5).tolist())
    assert (seen["u"], seen["v"]) == tuple(clicks[0])
    directions = rays(camera, *clicks.T)
    face, depth, _ = cast(mesh, np.broadcast_to(camera.eye, directions.shape), directions)
    assert (face >= 0).all()
    expected = camera.eye + depth[:, None] * directions
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-12)
    assert (found.astype(np.float32) == expected.astype(np.float32)).all()


def test_meshes_follow_the_origin_the_unit_and_moves_of_the_scene(tmp_path, random_gaussians):
    mesh = ball()
    write_mesh(tmp_path / "a.glb", mesh, "cm")
    scene = Scene(random_gaussians(3), unit="cm", origin=(100.0, 0.0, -5.0))
    source = Source(tmp_path / "a.ply", scene, (), file_settings(scene))
    found = open_meshes(tmp_path / "a.glb", tmp_path / "a.glb", source)
    np.testing.assert_allclose(found.surface.vertices, mesh.vertices - [100.0, 0.0, -5.0], atol=1e-6)
    assert found.collider is not None
    turn = Similarity(np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]), 2.0, np.array([1.0, 2, 3])).after(
        IDENTITY
    )
    moved = found.moved(turn).surface.vertices
    np.testing.assert_allclose(moved, 2 * found.surface.vertices @ turn.R.T + [1, 2, 3], atol=1e-12)
    assert open_meshes(None, None, source) is None


TURN = Rotation.from_rotvec((0.4, -0.3, 0.9)).as_matrix().tolist()

WHOLE = [
    {"op": "select", "how": "replace", "by": "sphere", "center": [0.2, 0.1, 0.0], "radius": 0.4},
    {"op": "delete"},
    {"op": "invert"},
    {"op": "move", "rotation": TURN, "translation": [0.3, -0.1, 0.2], "center": [0.5, 0.5, -0.5]},
    {"op": "move", "rotation": TURN, "translation": [0.0, 0.05, 0.0], "center": [0.0, 0.0, 0.0]},
]
"""Moves all splats that are left, twice."""

PART = [
    {"op": "select", "how": "replace", "by": "sphere", "center": [0.0, 0.0, 0.0], "radius": 0.7},
    {"op": "move", "rotation": TURN, "translation": [1.0, 0.0, 0.0], "center": [0.0, 0.0, 0.0]},
]


def editor_of(visit, tmp_path, gaussians, mesh):
    """Open the editor with a mesh beside the splats; return the page and the source."""
    scene = Scene(gaussians)
    source = Source(tmp_path / "scene.ply", scene, (("view", VIEW),), file_settings(scene))
    editing = editing_of(source, tmp_path / "scene.ply", tmp_path / "edits.json")
    tour, settings = page.Tour(meshes=Meshes(mesh, mesh)), replace(source.settings, background=BACKGROUND)
    html = page.html(scene, source.cameras, settings, "scene", (), tour, editing)
    (tmp_path / "edit.html").write_bytes(html)
    shown = visit(width=1400, height=900).open(tmp_path / "edit.html").ready()
    shown.tab.wait_for_selector("#edit-side")
    return shown, source


def test_a_mesh_follows_a_move_of_all_splats(visit, opened, tmp_path, random_gaussians):
    """The editor draws it where an exported page has it, finds its surface there, and undo takes it back."""
    mesh = Mesh(ball().vertices.astype(np.float32).astype(np.float64), ball().faces, ball().colors)
    shown, source = editor_of(visit, tmp_path, random_gaussians(60), mesh)
    tab, note = shown.tab, shown.tab.locator("#mesh-stays")
    before = drawn(shown)
    tab.evaluate("(operations) => operations.forEach((operation) => editor.perform(operation))", WHOLE)
    edits = parse_edits(tab.evaluate("editor.text()").encode(), "e.json")
    moved = edited_meshes(Meshes(mesh, mesh), source, edits)
    assert not moved.stays and note.is_hidden()
    assert np.abs(moved.surface.vertices - mesh.vertices).max() > 0.3
    after = drawn(shown)
    exported = drawn(opened(moved.surface)).astype(int)
    on_mesh = (np.abs(exported - 255 * np.array(BACKGROUND)) > 2).any(axis=2)
    assert on_mesh.sum() > 1000 and (after != before)[on_mesh].mean() > 0.1
    assert np.quantile(np.abs(after.astype(int) - exported), 0.99) <= 2  # but for the edges of faces
    x, y, z = VIEW.world_to_cam(moved.surface.vertices.mean(axis=0)[None])[0]
    column, row = float(VIEW.fx * x / z + VIEW.cx), float(VIEW.fy * y / z + VIEW.cy)
    directions = rays(VIEW, np.array([column]), np.array([row]))
    _, depth, _ = cast(moved.surface, np.array(VIEW.eye)[None], directions)
    found = tab.evaluate(
        "([camera, u, v]) => viewer.meshes.depthAt(camera, u, v)", [described(VIEW), column, row]
    )
    assert found == pytest.approx(depth[0], abs=1e-5)
    # afterwards a part is moved alone: the mesh stays where the whole was
    tab.evaluate("(operations) => operations.forEach((operation) => editor.perform(operation))", PART)
    assert note.is_visible() and (drawn(shown) == after).all()
    edits = parse_edits(tab.evaluate("editor.text()").encode(), "e.json")
    apart = edited_meshes(Meshes(mesh), source, edits)
    assert apart.stays and (apart.surface.vertices == moved.surface.vertices).all()
    assert opened(apart.surface).tab.locator("#mesh-stays").is_hidden()
    path = written(tmp_path, random_gaussians, apart)
    assert visit().open(path).ready().tab.locator("#mesh-stays").is_visible()
    tab.evaluate("(count) => { for (let i = 0; i < count; ++i) editor.undo(); }", len(WHOLE) + len(PART))
    assert note.is_hidden() and (drawn(shown) == before).all()


def test_convert_moves_the_mesh_and_says_where_it_stays(tmp_path, random_gaussians, capsys):
    write_scene(tmp_path / "a.ply", Scene(random_gaussians(30)))
    write_mesh(tmp_path / "a.glb", ball())
    source = open_source(tmp_path / "a.ply")
    for operations, line in ((WHOLE, False), (PART, True)):
        scene = {
            "count": 30,
            "sha256": identity_of(source.scene).sha256,
            "origin": [0, 0, 0],
        }
        edits = {"format": "gsplat_edu edits", "version": 1, "scene": scene, "operations": operations}
        (tmp_path / "e.json").write_text(json.dumps(edits))
        words = ["convert", tmp_path / "a.ply", tmp_path / "a.html", "--edits", tmp_path / "e.json"]
        assert main([*map(str, words), "--surface", str(tmp_path / "a.glb")]) == 0
        assert ("the mesh shows them where they were" in capsys.readouterr().out) is line


def test_too_many_triangles_and_a_collider_alone_are_refused(tmp_path, random_gaussians, monkeypatch):
    write_mesh(tmp_path / "a.glb", ball())
    scene = Scene(random_gaussians(3))
    source = Source(tmp_path / "a.ply", scene, (), file_settings(scene))
    with pytest.raises(ArgumentError, match="add --surface"):
        open_meshes(None, tmp_path / "a.glb", source)
    monkeypatch.setattr(page_mesh, "PAGE_FACES", 300)
    with pytest.raises(ArgumentError, match="holds at most 300 triangles, but this makes"):
        open_meshes(tmp_path / "a.glb", tmp_path / "a.glb", source)


def test_a_page_with_a_mesh_reads_back_as_its_scene(tmp_path, random_gaussians):
    plain = written(tmp_path, random_gaussians, None).read_bytes()
    path = written(tmp_path, random_gaussians, Meshes(painted_ball()))
    assert len(path.read_bytes()) > len(plain)
    assert (page.read(path).gaussians.means == random_gaussians(20).means).all()
    assert b'"meshes"' not in plain
