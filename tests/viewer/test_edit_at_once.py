"""In the editor, a selection shows in the next picture, also while a slow computer still completes the last one."""

import pytest
import torch

from gsplat_edu.scene.gaussians import Gaussians

CLOUD = 16_000
"""More splats than a slow page draws of a scene at first."""

SMALLEST = 178
"""The index of a splat to which `sorted_splats.js` gives a late place in its samples."""

SELECTED = """async ({ operation, look }) => {
  viewer.pace.level = DETAILS.length - 1;
  viewer.pace.took = viewer.pace.expect = () => {};
  editor.look.choose(look);
  await viewer.followed();
  const pictures = [];
  const { put, pace } = viewer;
  const isMarked = (red, blue) => red > 0.3 && red > blue + 0.1; // the wall is dark blue
  viewer.put = (camera) => {
    put(camera);
    const { gl, thinning } = viewer.renderer;
    const { width, height } = viewer.canvas;
    const bytes = new Uint8Array(4 * width * height);
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.readPixels(0, 0, width, height, gl.RGBA, gl.UNSIGNED_BYTE, bytes);
    let marked = 0;
    for (let i = 0; i < bytes.length; i += 4) marked += isMarked(bytes[i] / 255, bytes[i + 2] / 255);
    pictures.push({ coarse: thinning > 0, splats: viewer.renderer.count, marked });
  };
  const { partTook } = pace;
  let parts = 0;
  pace.partTook = (milliseconds) => {
    partTook.call(pace, milliseconds);
    if (++parts > 1) return;
    editor.perform(operation); // while the page completes its picture
    viewer.movedAt = -Infinity; // and comes to it late
  };
  viewer.moved(-1);
  await viewer.followed();
  return { pictures, whole: viewer.isWhole, selected: editor.history.counts().selected };
}"""


@pytest.fixture
def cloud(edit_page, camera):
    """Open the editor of a wall of large blue splats, with a small one in front that a sample leaves out."""
    generator = torch.Generator().manual_seed(0)
    means = 2.0 * torch.rand(CLOUD, 3, generator=generator) - 1.0
    means[:, 2] = 0.1 * means[:, 2]
    log_scales = torch.full((CLOUD, 3), -2.0)
    means[SMALLEST], log_scales[SMALLEST] = torch.tensor([0.1, 0.0, -0.3]), -3.6
    sh0 = torch.tensor([-1.5, -1.5, -0.7]).repeat(CLOUD, 1, 1)
    turns = torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(CLOUD, 1)
    logits = torch.full((CLOUD,), 1.0)
    logits[SMALLEST] = 6.0
    scene = Gaussians(means, turns, log_scales, sh0, torch.zeros(CLOUD, 0, 3), logits)
    return edit_page(scene, [("first", camera)], width=480, height=360)


SMALL = {"op": "select", "how": "replace", "by": "sphere", "center": [0.1, 0, -0.3], "radius": 0.05}

MANY = {"op": "select", "how": "replace", "by": "sphere", "center": [0, 0, 0], "radius": 0.5}

ALL = {"op": "select", "how": "replace", "by": "all"}


@pytest.mark.parametrize(
    ("operation", "look"),
    [
        pytest.param(SMALL, "tint", marks=pytest.mark.soak),
        pytest.param(MANY, "tint", marks=pytest.mark.soak),
        (ALL, "tint"),
        (SMALL, "centres"),
        (MANY, "outline"),
    ],
    ids=["one", "many", "all", "one by its centre", "many by their outline"],
)
def test_a_selection_shows_before_the_picture_is_whole(cloud, operation, look):
    found = cloud.evaluate(SELECTED, {"operation": operation, "look": look})
    before, *coarse, whole = found["pictures"]
    assert (
        found["whole"]
        and found["selected"] == {"sphere": found["selected"], "all": CLOUD}[operation["by"]] > 0
    )
    assert before["coarse"] and before["marked"] == 0
    assert len(coarse) == 1 and coarse[0]["coarse"] and coarse[0]["splats"] < CLOUD and not whole["coarse"]
    # as much is marked as in the end, but for the coarse picture's blur
    assert 0 < 0.3 * whole["marked"] < coarse[0]["marked"] < 3.0 * whole["marked"], found


def test_a_sample_leaves_out_the_small_splat_unless_it_is_selected(cloud):
    drawn = """async ({ operations, splat }) => {
      for (const operation of operations) editor.perform(operation);
      await viewer.settled();
      await viewer.sorter.sort(viewer.camera(), 12000);
      return new Uint32Array(viewer.sorter.order, 0, viewer.renderer.count).includes(splat);
    }"""
    assert not cloud.evaluate(drawn, {"operations": [], "splat": SMALLEST})
    assert cloud.evaluate(drawn, {"operations": [SMALL], "splat": SMALLEST})
    assert not cloud.evaluate(drawn, {"operations": [{"op": "deselect"}], "splat": SMALLEST})
