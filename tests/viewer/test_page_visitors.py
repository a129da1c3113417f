"""A page that was exported is for visitors: they see named views and numbered photos, no names of files."""

import json
import re

import numpy as np
import pytest

from gsplat_edu.io.scene import Scene
from gsplat_edu.paths.keyframes import Keyframe, KeyframePath
from gsplat_edu.viewer import page


@pytest.fixture
def shared(visit, tmp_path, random_gaussians, three_views):
    """An exported page with a named view and a camera path."""
    keys = tuple(Keyframe(camera.eye, camera.R, 50.0) for _, camera in three_views)
    tour = page.Tour(KeyframePath(keys, False), views=[("The <front> door", three_views[2][1])])
    files = [(f"IMG_{i}.jpg", camera) for i, (_, camera) in enumerate(three_views)]
    path = tmp_path / "scene.html"
    page.write(path, Scene(random_gaussians(60)), files, held_out={"IMG_1.jpg"}, tour=tour)
    return visit(640, 480, fresh=True).open(path).ready(), path


def test_visitors_see_named_views_and_no_file_names(shared, three_views):
    seen, path = shared
    assert b"IMG_" not in path.read_bytes()
    assert seen.tab.inner_text("#views summary") == "Views (1)"
    assert seen.tab.locator("#views button").all_inner_texts() == ["The <front> door"]
    assert seen.tab.inner_text("#cameras summary") == "Photos (3)"
    seen.tab.click("#cameras summary")
    assert seen.tab.locator("#cameras button").all_inner_texts() == ["photo 1", "photo 2 held out", "photo 3"]
    seen.tab.get_by_role("button", name="The <front> door").click()
    np.testing.assert_array_equal(seen.camera().eye, three_views[2][1].eye)
    assert seen.tab.locator("#views [aria-current=true]").count() == 1


def test_visitors_remove_only_the_keys_that_they_saved(shared):
    seen, _ = shared
    seen.tab.click("#path summary")
    assert seen.tab.locator("#path li").count() == 3
    assert seen.tab.get_by_role("button", name=re.compile("^remove view")).count() == 0
    seen.tab.click("#save-view")
    removes = seen.tab.get_by_role("button", name=re.compile("^remove view"))
    assert [one.get_attribute("aria-label") for one in removes.all()] == ["remove view 4"]
    removes.click()
    assert seen.tab.locator("#path li").count() == 3


def test_the_owners_page_keeps_the_names(tmp_path, random_gaussians, three_views):
    text = page.html(Scene(random_gaussians(9)), three_views).decode()
    facts = json.loads(text.split('id="facts">')[1].split("</script>")[0])
    assert [camera["name"] for camera in facts["cameras"]] == ["first", "second", "third <b>"]
    assert "shared" not in facts
