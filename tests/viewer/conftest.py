"""Fixtures: scenes, and a browser without a network."""

from collections import defaultdict
from contextlib import ExitStack

import pytest
import torch

from gsplat_edu.edits.identity import identity_of
from gsplat_edu.io.formats import write_scene
from gsplat_edu.io.scene import Scene
from gsplat_edu.render.settings import RenderSettings
from gsplat_edu.runs.source import Source, open_source
from gsplat_edu.scene.camera import Camera, look_at
from gsplat_edu.scene.gaussians import Gaussians
from gsplat_edu.viewer import page, page_parts
from gsplat_edu.viewer.edit_page import editing_of
from gsplat_edu.viewer.edit_serve import ADDRESS, EditServer
from viewer.pages import Editor, Visit, picture_of, running
from waiting import resize


@pytest.fixture
def picture():
    """Return a function that draws a camera's picture in a tab of any page."""
    return picture_of


@pytest.fixture(scope="module")
def tabs(browser):
    """Empty tabs by their options. Opening a tab takes as long as the rest of most tests."""
    return defaultdict(list)


@pytest.fixture
def visit(browser, tabs):
    """Return a function that opens tabs. A tab that logs a complaint or requests another address fails.

    A fixture that serves a page is named before this one, so that tabs close before their server ends.
    """
    visits = []

    def make(width=320, height=200, *, fresh=False, url="", kind=Visit, **options):
        """Open a tab of this size.

        Args:
            width: Of the window, CSS px.
            height: Of the window, CSS px.
            fresh: Whether the test leaves init scripts, keys or clicks in the tab.
            url: The page of a server. Without it, the tab has no network.
            kind: The class of the page.
            options: Those of Playwright for a window.
        """
        free = None if fresh or url else tabs[repr(sorted(options.items()))]
        if free:
            tab = free.pop()
            resize(tab, width, height)
        else:
            context = browser.new_context(viewport={"width": width, "height": height}, **options)
            context.set_offline(not url)
            tab = context.new_page()
        visits.append((kind(tab, url.partition("?")[0] or "file:"), free))
        if url:
            tab.goto(url)
        return visits[-1][0]

    yield make
    for one, free in visits:
        if free is None:
            one.tab.context.close()
        else:
            one.leave()
            free.append(one.tab)
    for one, _ in visits:
        one.check()


@pytest.fixture
def show(visit, tmp_path):
    """Write a page and open it."""

    def make(gaussians, views=(), settings=None, **options):
        path = tmp_path / "scene.html"
        page.write(path, Scene(gaussians), views, settings)
        return visit(**options).open(path).ready()

    return make


@pytest.fixture
def random_gaussians():
    """Make n random Gaussians around zero with `rest` SH coefficients beyond the first."""

    def make(n, rest=15, seed=0):
        generator = torch.Generator().manual_seed(seed)

        def normal(*shape):
            return torch.randn(*shape, generator=generator)

        return Gaussians(
            means=0.6 * normal(n, 3),
            quats=normal(n, 4),
            log_scales=0.7 * normal(n, 3) - 3.2,
            sh0=normal(n, 1, 3),
            sh_rest=0.3 * normal(n, rest, 3),
            logit_opacities=2.0 * normal(n),
        )

    return make


@pytest.fixture
def camera():
    """A camera with an image that is not square and an off-centre principal point."""
    eye = (0.4, -0.6, -2.2)
    return Camera(look_at(eye, (0.1, 0.0, 0.0)), eye, fx=230.0, fy=250.0, cx=150.3, cy=108.6, H=200, W=320)


@pytest.fixture
def three_views(camera):
    """Named cameras around zero, of different sizes."""
    named = [("first", camera)]
    for name, eye, width in (("second", (2.0, -0.5, 0.3), 200), ("third <b>", (-1.0, -0.4, 2.0), 240)):
        named.append(
            (name, Camera(look_at(eye, (0.0, 0.0, 0.0)), eye, 180.0, 180.0, width / 2, 80.0, 160, width))
        )
    return named


@pytest.fixture
def edit_page(visit, tmp_path):
    """Return a function that writes a scene and its page with the editor, and opens the page."""

    def make(gaussians, cameras=(), width=900, height=700, *, origin=(0.0, 0.0, 0.0), tour=None, **options):
        """Other options are those of `visit`."""
        settings = RenderSettings(jacobian_limit=1.3, depth=False)
        source = Source(tmp_path / "scene.ply", Scene(gaussians, origin=origin), tuple(cameras), settings)
        write_scene(tmp_path / "scene.ply", source.scene)
        editing = editing_of(source, tmp_path / "scene.ply", tmp_path / "edits.json")
        html = page.html(source.scene, cameras, source.settings, "scene", (), tour, editing)
        (tmp_path / "edit.html").write_bytes(html)
        return visit(width, height, kind=Editor, **options).open(tmp_path / "edit.html").ready()

    return make


@pytest.fixture
def edit_site(tmp_path):
    """Return a function that serves a scene with the editor, which saves edits.json."""
    with ExitStack() as stack:

        def make(gaussians):
            scene, file = tmp_path / "scene.ply", tmp_path / "edits.json"
            write_scene(scene, Scene(gaussians))
            source = open_source(scene)
            policy = page_parts.policy(page_parts.EDITOR)
            server = stack.enter_context(EditServer("127.0.0.1", 0, policy, file))
            server.prepare(identity_of(source.scene), scene)
            editing = editing_of(source, scene, file, ADDRESS)
            server.page = page.html(source.scene, (), source.settings, "scene", editing=editing)
            return stack.enter_context(running(server))

        yield make
