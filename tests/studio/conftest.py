"""A studio in the test's process, whose queue starts no jobs unless a test asks for it."""

import io

import numpy as np
import pytest
import torch
from PIL import Image
from starlette.testclient import TestClient

from gsplat_edu.io.formats import write_scene
from gsplat_edu.io.scene import Scene
from gsplat_edu.scene.gaussians import Gaussians
from gsplat_edu.server.refusal import RefusedError
from gsplat_edu.studio.app import application
from gsplat_edu.studio.state import Studio
from gsplat_edu.studio.uploads import Limits
from gsplat_edu.studio.worker import answer
from studio.pages import Visitor, served

TOKEN = "a-token"
HOST = "http://127.0.0.1:8090"


class Inline:
    """Runs the worker's tasks in this process, which has imported torch already."""

    def ask(self, task, **arguments):
        import json

        found = answer(json.dumps({"task": task, **arguments}).encode())
        if "error" in found:
            raise RefusedError(found["error"])
        return found["result"]

    def close(self):
        pass


@pytest.fixture(autouse=True, scope="session")
def _own_list_of_adopted_places(tmp_path_factory):
    """Keep tests, and servers that they start, from writing into the user's list of adopted places."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_STATE_HOME", str(tmp_path_factory.mktemp("state")))
        yield


@pytest.fixture
def studio(tmp_path, request):
    """A studio with small limits."""
    limits = getattr(request, "param", Limits(file=1 << 20, spare=0))
    made = Studio(tmp_path / "library", limits=limits)
    made.queue.at_once = 0
    made.worker = made.prober = made.painter.worker = Inline()
    yield made
    made.close()


@pytest.fixture
def page(studio):
    """A client like the studio's page, with the cookie and the Origin that browsers add."""
    with TestClient(application(studio, TOKEN), base_url=HOST) as client:
        assert client.get("/", params={"token": TOKEN}).status_code == 200
        client.headers["Origin"] = HOST
        yield client


@pytest.fixture
def jpeg():
    """Return a function that makes the bytes of a small photo."""
    return picture("JPEG")


def picture(form, size=(24, 18), **options):
    data = io.BytesIO()
    pixels = np.random.default_rng(5).integers(0, 255, (size[1], size[0], 3), dtype=np.uint8)
    Image.fromarray(pixels).save(data, format=form, **options)
    return data.getvalue()


@pytest.fixture(scope="module")
def library(tmp_path_factory):
    with served(tmp_path_factory.mktemp("studio") / "library", Inline()) as (studio, url):
        yield studio, url


@pytest.fixture
def visitor(browser, library):
    """Open the page in a tab without cookies or storage."""
    context = browser.new_context(accept_downloads=True, viewport={"width": 480, "height": 400})
    made = []

    def visit(url=library[1]):
        made.append(Visitor(context, url))
        return made[-1]

    yield visit
    faults = [fault for one in made for fault in one.faults]
    context.close()
    assert faults == []


@pytest.fixture(scope="module")
def wall_entry(library):
    """Write a wall of splats as an entry of scenes; return the entry's folder."""
    x, y = torch.meshgrid(torch.linspace(-1.5, 1.5, 16), torch.linspace(-1, 1, 11), indexing="ij")
    n = x.numel()
    folder = library[0].library.root / "scenes" / "wall"
    folder.mkdir()
    wall = Gaussians(
        torch.stack([x.ravel(), y.ravel(), torch.zeros(n)], dim=1),
        torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(n, 1),
        torch.log(torch.tensor([0.15, 0.15, 0.01])).repeat(n, 1),
        torch.rand(n, 1, 3, generator=torch.Generator().manual_seed(3)),
        torch.zeros(n, 0, 3),
        torch.full((n,), 4.0),
    )
    write_scene(folder / "wall.ply", Scene(wall))
    return folder
