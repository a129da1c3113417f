"""The live view in a browser, and the command until Ctrl-C."""

import io
import re
import signal

import numpy as np
import pytest
from PIL import Image

from gestures import drag
from gsplat_edu.data.procedural import procedural_capture
from gsplat_edu.data.writers import write_colmap
from gsplat_edu.evaluate.metrics import psnr
from gsplat_edu.render.api import render
from gsplat_edu.viewer.live_folder import LiveFolder, header_of
from live_clients import GROWING, PATIENCE, Client, training, until
from processes import Program

COMMAND = "import sys; from gsplat_edu.cli.main import main; sys.exit(main())"
NO_WEBGL2 = """
const before = HTMLCanvasElement.prototype.getContext;
HTMLCanvasElement.prototype.getContext = function (kind, ...more) {
  return kind === "webgl2" ? null : before.call(this, kind, ...more);
};
"""


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    folder = tmp_path_factory.mktemp("captures") / "egg"
    write_colmap(folder, *procedural_capture(24, 6, splats=60))
    return folder


class Tab:
    """A tab that watches a training. It records complaints and requested URLs."""

    def __init__(self, browser, url, script=None):
        self.complaints, self.requested = [], []
        self.page = browser.new_page(viewport={"width": 640, "height": 300})
        if script:
            self.page.add_init_script(script)
        self.page.set_default_timeout(1e3 * PATIENCE)
        self.page.on("console", lambda message: self.complaints.append(f"{message.type}: {message.text}"))
        self.page.on("pageerror", lambda error: self.complaints.append(str(error)))
        self.page.on("request", lambda request: self.requested.append(request.url))
        self.page.goto(url)

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.page.close()

    def press(self, label):
        self.page.get_by_role("button", name=label, exact=True).click()

    def says(self, pattern):
        """Wait for a text in the panel, whether its controls are open or not; return the number in it."""
        found = until(lambda: re.search(pattern, self.page.text_content("#panel")), pattern)
        return int(found[1].replace(",", ""))

    def picture(self):
        """Return the screen right of the panel, (H, W, 3)."""
        shown = Image.open(
            io.BytesIO(self.page.screenshot(clip={"x": 380, "y": 0, "width": 260, "height": 300}))
        )
        return np.asarray(shown.convert("RGB"), dtype=float)


def test_a_page_shows_and_pauses_a_training_and_may_be_closed(capture, tmp_path, browser, picture):
    with training(capture, tmp_path / "run", "--iterations", "100000", grace=1.0) as made:
        with Tab(browser, made.view.url) as tab:
            tab.page.wait_for_selector("#message", state="hidden")
            first = tab.says(r"splats after ([\d,]+) iteration")
            begun = tab.picture()
            assert begun.std() > 5, "the picture is not blank"
            tab.press("Pause")
            held = tab.says(r"paused, iteration ([\d,]+) of 100,000")
            tab.press("Step")
            tab.says(rf"paused, iteration ({held + 1:,}) of")
            tab.says(rf"splats after ({held + 1:,}) iterations")
            assert made.iteration == held + 1 > first
            assert np.abs(tab.picture() - begun).mean() > 0.05, "the picture changes with the training"
            trainer, camera = made.run.trainer, made.run.dataset.test[0].camera
            truth = render(trainer.gaussians, camera, settings=made.run.options.render_settings).image
            assert psnr(picture(tab.page, camera), truth.detach().numpy()) > 50, (
                "the picture equals our renderer's"
            )
            assert tab.page.locator("#curves svg").evaluate_all("all => all.every((one) => one.ariaLabel)")
            assert "token" not in tab.page.url
            tab.page.reload()  # the cookie is enough
            tab.says(rf"paused, iteration ({held + 1:,}) of")
            tab.press("Resume")
            until(lambda: made.iteration > held + 20, "more iterations")
            tab.press("Pause")
            held = tab.says(r"paused, iteration ([\d,]+) of 100,000")
            assert tab.complaints == []
            own = made.view.url.partition("?")[0]
            assert [url for url in tab.requested if not url.startswith((own, f"blob:{own}"))] == []
        until(lambda: made.iteration > held + 20, "more iterations without the page")


def test_a_press_on_pause_pauses_although_another_page_does_meanwhile(capture, tmp_path, browser):
    """Its button says "Resume" before it is released."""
    with (
        training(capture, tmp_path / "run", "--iterations", "100000") as made,
        Tab(browser, made.view.url) as tab,
    ):
        tab.says(r"training, iteration ([\d,]+) of")
        tab.page.get_by_role("button", name="Pause", exact=True).hover()
        tab.page.mouse.down()
        client = Client(made.view.url)
        client.control("pause")
        held = client.states(state="paused")["iteration"]
        tab.says(r"paused, iteration ([\d,]+) of")
        with tab.page.expect_response(re.compile("/control")):
            tab.page.mouse.up()
        tab.says(r"paused, iteration ([\d,]+) of")
        assert client.states(state="paused")["iteration"] == made.iteration == held


def test_without_webgl2_the_page_shows_our_own_renders(capture, tmp_path, browser):
    with (
        training(capture, tmp_path / "run", "--iterations", "100000") as made,
        Tab(browser, made.view.url, NO_WEBGL2) as tab,
    ):
        tab.press("Pause")
        tab.says(r"paused, iteration ([\d,]+) of")
        assert "no WebGL2, so the training's computer draws" in tab.page.inner_text("#live")
        until(lambda: tab.picture().std() > 5, "a picture")
        before = tab.picture()
        drag(tab.page, (400, 250), (520, 230))
        until(lambda: np.abs(tab.picture() - before).mean() > 2, "the scene from another side")
        assert tab.complaints == [] and made.view.newer_scene(-2) == b"", "no snapshot was packed"


def output(folder):
    """Return what the program in this folder has printed so far."""
    path = folder / "stdout.txt"
    return path.read_text() if path.exists() else ""


def test_after_the_training_the_view_stays_until_ctrl_c_and_exits_with_0(capture, tmp_path):
    """The test watches the command by the requests of a page and by files."""
    out = tmp_path / "run"
    words = ["train", capture, "--out", out, "--view", "--view-port", 0, "--view-host", "0.0.0.0", *GROWING]
    program = Program(COMMAND, [*words, "--iterations", 60], tmp_path)
    try:
        url = until(
            lambda: re.search(r"http://127\.0\.0\.1:\d+/\?token=[\w-]{22}\n", output(tmp_path)), "the URL"
        )[0]
        client, files = Client(url.strip()), LiveFolder(out)
        seen = until(
            lambda: (files.ask(), client.ask("GET", "/state"), files.read_state())[2], "a state in a file"
        )
        assert seen["iterations"] == 60 and 0 <= header_of(files.scene)["iteration"] <= 60
        client.states(state="finished", iteration=60)
        assert (out / "metrics.json").exists() and program.runs
        assert client.scene()[0]["iteration"] == 60
        program.send(signal.SIGINT)
        code, printed, complaints = program.ended(PATIENCE)
    finally:
        if program.runs:
            program.send(signal.SIGKILL)
    assert (code, complaints) == (0, "")
    assert (
        "warning: listening on 0.0.0.0: anyone who can reach this computer and has the URL sees the training"
        in printed
    )
    assert printed.endswith("the live view stays open until its last browser is closed, or Ctrl-C\n")
    assert sorted(path.name for path in files.path.iterdir()) == ["wanted"], "temporary files are removed"
