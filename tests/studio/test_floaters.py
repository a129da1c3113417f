"""The studio proposes splats to delete for its editor: one scene at a time, and only to its own page."""

import pytest
import torch

from gsplat_edu.io.formats import write_scene
from gsplat_edu.io.scene import Scene
from gsplat_edu.scene.gaussians import Gaussians
from waiting import PATIENCE, until


@pytest.fixture
def scenes(studio):
    """Write two scenes: grids of splats, with one far away."""
    for k, name in enumerate(("one", "two")):
        place = torch.arange(4.0)
        means = torch.cartesian_prod(place, place, place)
        means[63, 0] = 900.0 + k
        n = len(means)
        quats = torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(n, 1)
        scene = Gaussians(
            means, quats, torch.full((n, 3), -2.0), torch.zeros(n, 1, 3), torch.zeros(n, 0, 3), torch.ones(n)
        )
        folder = studio.library.root / "scenes" / name
        folder.mkdir()
        write_scene(folder / f"{name}.ply", Scene(scene))
    return "/api/scenes/one/floaters", "/api/scenes/two/floaters"


def ended(page, address):
    """Wait until a judgement has ended, and return its state."""
    until(lambda: page.get(address).json()["state"] != "running")
    return page.get(address).json()


def test_a_scene_is_judged_on_request_one_at_a_time_until_it_changes(page, studio, scenes):
    one, two = scenes
    assert page.get(one).json() == {"state": "idle"}
    assert page.post(one).json()["state"] == "running"
    refused = page.post(two)
    assert refused.status_code == 409 and "another scene is being judged" in refused.json()["error"]
    state = ended(page, one)
    assert state["groups"] == [{"reason": "floating: far from all other splats", "runs": [63, 1]}]
    assert page.post(two).json()["state"] == "running"
    assert page.delete(two).json() == {"state": "idle"}
    assert page.get(one).json() == state, "the result is kept"
    path = studio.library.root / "scenes" / "one" / "one.ply"
    path.write_bytes(path.read_bytes() + b" ")
    assert page.get(one).json() == {"state": "idle"}, "the result was that of another scene"
    assert page.get("/api/scenes/none/floaters").status_code == 404


@pytest.mark.usefixtures("scenes")
def test_closing_the_studio_ends_the_judgement(studio):
    running = studio.proposals.of("one", studio.library.root / "scenes" / "one" / "one.ply")
    studio.proposals.start(running)
    process = running.process
    studio.proposals.close()
    assert process.wait(PATIENCE) < 0


def test_other_pages_may_not_start_one(page, scenes):
    assert page.post(scenes[0], headers={"Origin": "http://example.org"}).status_code == 403
    assert page.get(scenes[0]).json() == {"state": "idle"}
