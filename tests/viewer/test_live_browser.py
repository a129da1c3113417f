"""The live view from outside: the whole command, a real browser and Ctrl-C."""

import io
import math
import re
import signal
import subprocess
import sys
import threading
from contextlib import contextmanager
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image
from safetensors import safe_open

pytest.importorskip("viser", reason="viser is not installed")

from gsplat_edu import quat_to_R
from gsplat_edu.data.procedural import procedural_capture
from gsplat_edu.data.writers import write_colmap
from gsplat_edu.train.checkpoint import list_checkpoints
from gsplat_edu.viewer.live import browser_camera
from live_clients import GROWING, PATIENCE, STRATEGIES, Client, Training, training, until

COMMAND = [sys.executable, "-c", "import sys; from gsplat_edu.cli.main import main; sys.exit(main())"]

TEN_FRAMES_PER_SECOND = """
requestAnimationFrame = (draw) => setTimeout(() => draw(performance.now()), 100);
cancelAnimationFrame = clearTimeout;
"""
"""viser draws all the time. Without a graphics processor, sixty frames per second leave nothing for the training."""


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    folder = tmp_path_factory.mktemp("captures") / "egg"
    write_colmap(folder, *procedural_capture(48, 10, splats=100))
    return folder


class Tab:
    """A real browser that views a training. It records complaints and requested URLs."""

    def __init__(self, browser, url):
        self.complaints, self.requested = [], []
        self.page = browser.new_page(viewport={"width": 700, "height": 500})
        self.page.add_init_script(TEN_FRAMES_PER_SECOND)
        self.page.set_default_timeout(1e3 * PATIENCE)
        self.page.on("console", self._note)
        self.page.on("pageerror", lambda error: self.complaints.append(str(error)))
        self.page.on("request", lambda request: self.requested.append(request.url))
        self.page.on("websocket", lambda socket: self.requested.append(socket.url.replace("ws:", "http:")))
        self.page.goto(url)

    def _note(self, message):
        if message.type == "error":
            self.complaints.append(message.text)

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.page.close()

    def press(self, label):
        self.page.get_by_role("button", name=label, exact=True).click()

    def says(self, pattern):
        """Wait for words in the panel; return the number among them."""
        self.page.get_by_text(re.compile(pattern)).first.wait_for()
        found = re.search(pattern, self.page.inner_text("body"))
        return found and int(found[1].replace(",", ""))

    def picture(self):
        """Return the screen, (H, W, 3), without the panel on the right and the notice on the left."""
        shown = Image.open(io.BytesIO(self.page.screenshot()))
        return np.asarray(shown.convert("RGB"), dtype=float)[150:, :350]


def objects_are_drawn_where_our_camera_sees_them(capture, tmp_path, browser):
    """Compare three balls that the browser itself draws with `browser_camera`: axes, signs, centre and scale."""
    window, where = 700, {0: (120, 220, 2.5), 1: (310, 420, 3.2), 2: (560, 330, 4.0)}  # column, row, depth
    with (
        training(capture, tmp_path / "run", "--iterations", "100000") as made,
        Tab(browser, made.view.url) as tab,
    ):
        tab.says(r"iteration ([\d,]+) of")
        made.stopped.set()
        made.ended()  # the server still runs, but draws no more pictures
        (client,) = made.view._server.get_clients().values()
        seen, start = client.camera, made.run.dataset.train[0].camera
        until(lambda: np.allclose(seen.position, start.eye, atol=1e-6), "the first training view")
        # The cameras are level, so the browser's up direction equals theirs.
        np.testing.assert_allclose(quat_to_R(seen.wxyz).T, start.R, atol=1e-3)
        np.testing.assert_allclose(seen.fov, 2 * math.atan(start.H / 2 / start.fy), atol=1e-6)
        canvas = (seen.image_width, seen.image_height)
        camera = browser_camera(seen.wxyz, seen.position, seen.fov, canvas, 10**6)
        scale = window / camera.W  # the browser may draw fewer pixels than its window has
        for channel, (column, row, z) in where.items():
            u, v = (column + 0.5) / scale - 0.5, (row + 0.5) / scale - 0.5
            place = camera.eye + camera.R.T @ (
                z * np.array([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, 1])
            )
            color = tuple(np.eye(3)[channel])
            client.scene.add_icosphere(f"/ball{channel}", 0.03, color=color, position=tuple(place))
        client.scene.set_background_image(np.zeros((2, 2, 3), np.uint8))

        top = 180  # the notice ends above

        def middle(channel):
            """Return column and row of the centre of one colour, beside the panel and below the notice."""
            shown = np.asarray(Image.open(io.BytesIO(tab.page.screenshot())).convert("RGB"), dtype=float)[
                top:
            ]
            ball = shown[..., channel] > 40 + 1.5 * np.delete(shown, channel, axis=2).max(axis=2)
            ball[: 300 - top, 350:] = False
            return None if ball.sum() < 20 else np.argwhere(ball).mean(axis=0)[::-1] + np.array([0, top])

        for channel, (column, row, _) in where.items():
            until(lambda channel=channel: middle(channel) is not None, "the ball")
            # The radius is 6 to 9 px; light from above moves the centre of the coloured pixels by a part of it.
            np.testing.assert_allclose(middle(channel), (column, row), atol=3)
        # The red ball is put in front of and below a camera from the list, so it appears below the window's centre.
        chosen, below = made.run.dataset.test[0].camera, 130  # px
        place = chosen.eye + chosen.R.T @ (2.5 * np.array([0, below / scale / camera.fy, 1]))
        client.scene.add_icosphere("/ball0", 0.03, color=(1.0, 0.0, 0.0), position=tuple(place))
        made.view._move(client, chosen, None)
        expected = np.array([camera.W / 2 * scale, camera.H / 2 * scale + below])
        until(
            lambda: (found := middle(0)) is not None and np.abs(found - expected).max() < 3,
            "the chosen camera",
        )
    assert tab.complaints == []


@contextmanager
def commanded(capture, out, *words):
    """Run the command with a view in a separate process; yield the process and the URL it printed."""
    command = [*COMMAND, "train", str(capture), "--out", str(out), "--view", "--view-port", "0", *words]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    try:
        watchdog = threading.Timer(5 * PATIENCE, process.kill)  # no pipe may block forever
        watchdog.start()
        while not (
            found := re.fullmatch(
                r"live view: (http://127\.0\.0\.1:\d+/\?token=[\w-]{22})\n", process.stdout.readline()
            )
        ):
            assert process.poll() is None, process.stderr.read()
        yield process, found[1]
    finally:
        watchdog.cancel()
        process.kill()
        process.communicate()


def bits(path):
    """Return a checkpoint's tensors and other values, without its clock."""
    with safe_open(path, framework="np") as file:
        tensors = {name: file.get_tensor(name).tobytes() for name in sorted(file.keys())}
        return tensors, file.metadata()["state"]


def a_user_watches_pauses_steps_and_ends_a_training(capture, tmp_path, browser):
    """Command, browser and Ctrl-C together give the same bits as a training without a view."""
    out, words = tmp_path / "run", ["--iterations", "100000", *GROWING, *STRATEGIES["adc"]]
    with commanded(capture, out, *words) as (process, url), Tab(browser, url) as tab:
        tab.says(r"iteration ([\d,]+) of 100,000")
        until(lambda: tab.picture().std() > 20, "a picture")
        tab.press("Pause")
        held = tab.says(r"paused\s+iteration ([\d,]+) of")
        for k in (1, 2):
            tab.press("Step")
            until(lambda k=k: tab.says(r"paused\s+iteration ([\d,]+) of") == held + k, "one more iteration")
        before = tab.picture()
        tab.page.mouse.move(200, 400)
        tab.page.mouse.down()
        tab.page.mouse.move(330, 380, steps=5)
        tab.page.mouse.up()
        until(lambda: np.abs(tab.picture() - before).mean() > 10, "the scene from another side")
        tab.press("Resume")
        until(lambda: (tab.says(r"iteration ([\d,]+) of") or 0) > held + 50, "many more iterations")
        tab.press("Pause")
        held = tab.says(r"paused\s+iteration ([\d,]+) of")
        process.send_signal(signal.SIGINT)
        printed, complaints = process.communicate(timeout=PATIENCE)
        assert process.returncode == 130
        assert f"interrupted after {held} iterations" in complaints and complaints.count("\n") == 1
        assert "viser" not in printed and "Websocket" not in printed
        errors = [text for text in tab.complaints if "WebSocket" not in text]  # the server has stopped by now
        assert errors == []
        own = url.partition("?")[0]
        requested = [
            one if one.startswith("blob:") else f"{one}/" for one in tab.requested
        ]  # a socket's URL has no slash
        assert [one for one in requested if not one.startswith((own, f"blob:{own}"))] == [], (
            "nothing else is requested"
        )
    alone = Training(capture, tmp_path / "alone", *words)
    with alone.view:
        pass
    alone.run.train(lambda: alone.run.trainer.iteration == held)
    watched, unwatched = (list_checkpoints(one / "checkpoints")[-1] for one in (out, tmp_path / "alone"))
    assert watched.name == unwatched.name == f"iteration_{held}.safetensors"
    assert bits(watched) == bits(unwatched)


@pytest.mark.own_process
@pytest.mark.sliced(1)
@pytest.mark.parametrize(
    "claim",
    [objects_are_drawn_where_our_camera_sees_them, a_user_watches_pauses_steps_and_ends_a_training],
)
def test_in_a_real_browser(capture, tmp_path, browser, claim):
    """Each commit checks one claim: viser's page alone takes the browser many seconds."""
    claim(capture, tmp_path, browser)


@pytest.mark.own_process
def test_after_the_training_the_view_stays_until_ctrl_c_and_exits_with_0(capture, tmp_path):
    words = ["--iterations", "600", "--view-host", "0.0.0.0", *GROWING, *STRATEGIES["adc"]]
    with commanded(capture, tmp_path / "run", *words) as (process, url):
        # Read here: `communicate` does not return what the pipe's reader has buffered behind the URL.
        warning = process.stdout.readline()
        assert warning.startswith(
            "warning: listening on 0.0.0.0: anyone who can reach this computer and has the URL sees the training"
        )
        with Client(SimpleNamespace(url=url)) as client:
            client.move()
            client.says(r"\*\*finished\*\*\s+iteration 600 of 600")
            assert (tmp_path / "run" / "metrics.json").exists() and process.poll() is None
            process.send_signal(signal.SIGINT)
            printed, complaints = process.communicate(timeout=PATIENCE)
        assert (process.returncode, complaints) == (0, "")
        assert printed.endswith("the live view stays open until its last browser is closed, or Ctrl-C\n")


@pytest.mark.own_process
def test_without_a_view_viser_is_not_imported(capture, tmp_path):
    code = "import sys; from gsplat_edu.cli.main import main; main(sys.argv[1:]); sys.exit('viser' in sys.modules)"
    command = [
        sys.executable,
        "-c",
        code,
        "train",
        str(capture),
        "--out",
        str(tmp_path / "run"),
        "--iterations",
        "2",
    ]
    subprocess.run(command, check=True, timeout=PATIENCE, capture_output=True)
