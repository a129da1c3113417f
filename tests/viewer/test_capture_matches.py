"""A capture's page shows the matched points of a photo, in space and on it, and the photos that share them."""

import numpy as np

from gsplat_edu.data.reader import CaptureReader
from gsplat_edu.data.sparse_depth import tracked_points
from gsplat_edu.viewer import capture_matches
from gsplat_edu.viewer.capture_data import capture_facts
from viewer.captures import measured, ring
from viewer.handles import until
from viewer.test_capture_page import folder, opened, served

__all__ = ["folder", "opened", "served"]

MATCHED = """() => {
  const { matches, matchPanel } = viewer;
  const [from, to] = matchPanel.pairsOf(matchPanel.chosen);
  const rows = [...matches.rows.subarray(from, to)];
  return {
    points: rows.map((row) => [...matches.positions.subarray(3 * row, 3 * row + 3)]),
    places: rows.map((_, k) => [...matches.places.subarray(2 * (from + k), 2 * (from + k) + 2)].map((x) => x / 65535)),
    drawn: viewer.renderer.matchedCount,
  };
}"""

DOTS = """() => {
  const canvas = document.getElementById("dots");
  if (canvas.hidden) return false;
  const copy = new OffscreenCanvas(canvas.width, canvas.height).getContext("2d"); // a canvas that is read often warns
  copy.drawImage(canvas, 0, 0);
  return copy.getImageData(0, 0, canvas.width, canvas.height).data.some(Boolean);
}"""


def test_the_chosen_photo_shows_its_matched_points_and_who_shares_them(opened, folder):
    tab = opened()
    name = tab.evaluate("viewer.cameras.list[2].name")
    tab.evaluate("viewer.choose(2)")
    photo, panel = tab.locator("#photo"), tab.locator("#chosen").bounding_box()
    photo.wait_for()
    box = photo.bounding_box()
    assert panel["x"] <= box["x"] and box["x"] + box["width"] <= panel["x"] + panel["width"]
    tracked = tracked_points(folder, most_error=np.inf, least_views=1)
    found = tab.evaluate(MATCHED)
    mine = tracked.seen[name]
    assert found["drawn"] == len(mine) > 20
    np.testing.assert_allclose(
        np.sort(found["points"], axis=0), np.sort(tracked.points[mine], axis=0), rtol=1e-6
    )
    frame = next(frame for frame in CaptureReader(folder).placed().frames if frame.name == name)
    at = (np.array(found["points"]) - frame.eye) @ frame.R.T
    lens = frame.lens
    u = (lens.fx * at[:, 0] / at[:, 2] + lens.cx + 0.5) / lens.W
    v = (lens.fy * at[:, 1] / at[:, 2] + lens.cy + 0.5) / lens.H
    np.testing.assert_allclose(found["places"], np.stack([u, v], axis=1), atol=1 / 65535)
    common = {other: len(np.intersect1d(mine, rows)) for other, rows in tracked.seen.items() if other != name}
    most = max(common, key=common.get)
    first = tab.locator("#sharing button").first
    assert first.inner_text().split() == [most, str(common[most])]
    assert (
        tab.locator("#sharing-with")
        .inner_text()
        .startswith(f"Shares points with {sum(map(bool, common.values()))}")
    )
    until(tab, f"({DOTS})()")  # once the photo is decoded
    tab.locator("#canvas").press("m")
    assert not tab.evaluate(DOTS) and tab.evaluate("viewer.renderer.matchedCount") == 0
    first.click()
    assert tab.locator("#chosen h2").inner_text() == most
    tab.get_by_label("show the matched points").check()
    assert tab.evaluate("viewer.renderer.matchedCount") == len(tracked.seen[most])


def test_tracks_that_were_computed_from_the_poses_are_no_matches(tmp_path):
    ring(tmp_path)
    found = capture_facts(CaptureReader(tmp_path), "ring")
    assert found.facts["matches"] is None and found.matches == b""
    measured(tmp_path)
    found = capture_facts(CaptureReader(tmp_path), "ring")
    assert sum(found.facts["matches"]["pairs"]) > 100 and not found.facts["matches"]["thinned"]


def test_many_matches_are_those_of_some_points(tmp_path, monkeypatch):
    ring(tmp_path)
    measured(tmp_path)
    whole = capture_facts(CaptureReader(tmp_path), "ring").facts["matches"]
    monkeypatch.setattr(capture_matches, "MOST_PAIRS", sum(whole["pairs"]) // 3)
    found = capture_facts(CaptureReader(tmp_path), "ring")
    some = found.facts["matches"]
    assert some["thinned"] and 0 < sum(some["pairs"]) <= sum(whole["pairs"]) // 3
    assert len(found.matches) == 12 * some["points"] + 8 * sum(some["pairs"])
