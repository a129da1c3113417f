"""A browser draws the page that a server of this computer sends."""

import io

import numpy as np
import pytest
from PIL import Image

from gsplat_edu.io.scene import Scene
from gsplat_edu.render.settings import RenderSettings
from gsplat_edu.server.page_server import PageServer
from gsplat_edu.viewer import page, page_parts
from viewer.pages import running

ORANGE = (1.0, 0.5, 0.0)


@pytest.fixture
def server(random_gaussians):
    with PageServer(page_parts.policy()) as made, running(made):
        made.page = page.html(Scene(random_gaussians(300)), settings=RenderSettings(background=ORANGE))
        yield made


def test_a_browser_draws_the_page_without_complaint(server, visit):
    view = visit(320, 240, url=server.url).ready()
    answer = view.tab.reload()
    assert answer.headers["content-security-policy"] == f"{page_parts.policy()}; frame-ancestors 'none'"
    view.ready()
    picture = np.asarray(Image.open(io.BytesIO(view.tab.screenshot())).convert("RGB"), dtype=float)
    orange = np.abs(picture - 255.0 * np.array(ORANGE)).max(axis=2) < 3
    assert 0.1 < orange.mean() < 0.95 and picture[~orange].std() > 20
