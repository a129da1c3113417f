"""In the editor, the mesh beside the splats follows the handle while it is dragged."""

import json

import numpy as np

from gsplat_edu.scene.mesh import Mesh
from viewer.handles import Scale, shape, until
from viewer.test_page_mesh import PART, TURN, ball, drawn, editor_of

PLACED = "JSON.stringify(viewer.meshes.placed)"


def test_a_mesh_follows_the_handle_while_all_splats_are_dragged(visit, tmp_path, random_gaussians):
    """Before the button is released, the mesh is where the move will leave it; with a part, it stays."""
    mesh = Mesh(ball().vertices.astype(np.float32).astype(np.float64), ball().faces, ball().colors)
    shown, _ = editor_of(visit, tmp_path, random_gaussians(60), mesh)
    tab = shown.tab
    tab.evaluate(
        """(turn) => {
          editor.perform({ op: "select", how: "replace", by: "sphere", center: [0.2, 0.1, 0], radius: 0.4 });
          editor.perform({ op: "delete" });
          editor.perform({ op: "select", how: "replace", by: "all" });
          editor.perform({ op: "move", rotation: turn, translation: [0.1, 0, 0], center: [0, 0.2, 0] });
          editor.tools.choose("move");
        }""",
        TURN,
    )
    opened, start = tab.evaluate(PLACED), Scale(shown).place(shape(shown)["center"])
    tab.mouse.move(*start)
    tab.mouse.down()
    tab.mouse.move(start[0] + 60, start[1] + 35, steps=3)
    until(tab, f"{PLACED} !== {json.dumps(opened)}")
    dragged = json.loads(tab.evaluate(PLACED))
    assert np.abs(np.array(dragged["t"]) - json.loads(opened)["t"]).max() > 0.1
    tab.mouse.up()
    released = json.loads(tab.evaluate(PLACED))
    for name in ("R", "t"):
        np.testing.assert_allclose(dragged[name], released[name], atol=1e-12)
    before = drawn(shown)
    tab.evaluate("(angles) => editor.tools.gizmo.panel.setAngles(angles)", [0.3, -0.4, 0.1])
    turned, picture = json.loads(tab.evaluate(PLACED)), drawn(shown)
    assert (picture != before).mean() > 0.05
    assert tab.evaluate("editor.mover.moved")
    tab.locator("[data-do=move]").click()
    done = json.loads(tab.evaluate(PLACED))
    for name in ("R", "t"):
        np.testing.assert_allclose(turned[name], done[name], atol=1e-12)
    np.testing.assert_allclose(drawn(shown), picture, atol=2)
    # the mesh stays while a part is dragged
    tab.evaluate("(region) => editor.perform(region)", PART[0])
    tab.evaluate("editor.tools.gizmo.take({ ...editor.tools.shape, center: [0, 0, 0] })")
    assert json.loads(tab.evaluate(PLACED)) == done
    assert tab.evaluate("editor.mover.moved") and shown.tab.locator("#mesh-stays").is_hidden()
