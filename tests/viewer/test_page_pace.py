"""On a slow computer, a page draws fewer splats while the view moves, and then the whole picture in parts."""

import pytest

from gsplat_edu.render.settings import RenderSettings

PARTS = """async () => {
  const { renderer } = viewer;
  const sizes = [];
  const drawPart = renderer.drawPart.bind(renderer);
  renderer.drawPart = (camera, settings, from, to, ...rest) => {
    sizes.push([camera.W, to - from, renderer.thinning > 0]);
    drawPart(camera, settings, from, to, ...rest);
  };
  viewer.pace.level = DETAILS.length - 1;
  const [moved, drawCoarse] = [viewer.moved.bind(viewer), viewer.drawCoarse.bind(viewer)];
  viewer.moved = (index) => {
    moved(index);
    viewer.movedAt = Infinity; // the view moves until it is drawn, however long that takes
  };
  viewer.drawCoarse = async () => {
    viewer.movedAt = -Infinity;
    await drawCoarse();
  };
  INTERRUPT
  viewer.moved(-1);
  await viewer.followed();
  delete renderer.drawPart;
  const inParts = renderer.pixels();
  const words = element("rate").textContent;
  const camera = viewer.camera();
  await viewer.sorter.sort(camera);
  renderer.draw(camera, viewer.settings);
  const atOnce = renderer.pixels();
  return {
    sizes, words, isWhole: viewer.isWhole, width: camera.W,
    equal: inParts.length === atOnce.length && inParts.every((value, i) => value === atOnce[i]),
    shown: inParts.some((value) => value > 0.1),
  };
}"""


@pytest.fixture
def slow(show, random_gaussians, camera):
    """Open a page of 15,000 splats in front of the camera."""
    gaussians = random_gaussians(15_000, 0)
    gaussians.means.mul_(0.3)
    visit = show(gaussians, [("first", camera)], RenderSettings(), width=320, height=200)
    return visit, gaussians


@pytest.mark.parametrize(
    "interrupt",
    [
        "",
        """let once = false;
        const put = viewer.pace.partTook.bind(viewer.pace);
        viewer.pace.partTook = (milliseconds) => {
          put(milliseconds);
          if (once) return;
          once = true;
          viewer.view.orbit(0.1, 0);
          viewer.moved(-1);
        };""",
    ],
    ids=["at rest", "interrupted"],
)
def test_the_whole_picture_in_parts_is_the_same_to_the_bit(slow, interrupt):
    visit, _ = slow
    found = visit.evaluate(PARTS.replace("INTERRUPT", interrupt))
    assert found["isWhole"] and found["equal"] and found["shown"] and found["words"] == ""
    coarse = [size for size in found["sizes"] if size[2]]
    whole = [size for size in found["sizes"] if not size[2]]
    assert len(coarse) == (2 if interrupt else 1), "a coarse picture comes first, once for each movement"
    assert all(width == 80 and count == 12_000 for width, count, _ in coarse), (
        "the coarse picture has a quarter of the width"
    )
    assert all(width == found["width"] == 320 for width, _, _ in whole)
    assert whole[-1][1] < 15_000 and sum(count for _, count, _ in whole) >= 15_000, (
        "the whole picture has several parts"
    )


def test_a_slow_page_draws_rarely_while_a_training_runs(slow):
    visit, _ = slow
    found = visit.evaluate(
        """async () => {
          viewer.pace.level = DETAILS.length - 1;
          viewer.pace.expect = () => {};
          viewer.isTraining = true;
          await viewer.followed();
          const during = [viewer.isWhole, viewer.renderer.width];
          viewer.isTraining = false;
          await viewer.followed();
          return [...during, viewer.isWhole, viewer.renderer.width];
        }"""
    )
    assert found == [False, 128, True, 320]
