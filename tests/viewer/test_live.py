"""The live view: cameras, WebSocket clients, and trainings, whose results it leaves bit-identical."""

import math
import threading
import time

import msgspec
import numpy as np
import pytest

pytest.importorskip("viser", reason="viser is not installed")
import rich
import websockets.asyncio.server

from gsplat_edu import quat_to_R
from gsplat_edu.data.procedural import procedural_capture
from gsplat_edu.data.writers import write_colmap
from gsplat_edu.errors import ArgumentError, NotEnoughMemoryError
from gsplat_edu.evaluate.metrics import psnr
from gsplat_edu.render.api import render
from gsplat_edu.train.checkpoint import list_checkpoints
from gsplat_edu.viewer import live
from gsplat_edu.viewer.live import browser_camera
from gsplat_edu.viewer.serve import PageServer
from live_clients import CANVAS, LEVEL, PATIENCE, POSE, STRATEGIES, Client, Training, training, until


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    folder = tmp_path_factory.mktemp("captures") / "egg"
    write_colmap(folder, *procedural_capture(48, 10, splats=100))
    return folder


def test_a_level_camera_has_right_and_down_in_place():
    """It sees half the field of view up and down, and more to the sides by the browser's aspect ratio."""
    camera = browser_camera(LEVEL, (1.0, 2.0, 3.0), math.radians(90), (200, 100), 800)
    assert (camera.W, camera.H) == (200, 100), "no more pixels than the browser has"
    u, v, z = camera.project(camera.world_to_cam([[1 + 2 * 5.0, 2 + 5.0, 3 + 5.0], [1 - 10.0, 2 - 5.0, 8.0]]))
    np.testing.assert_allclose(u, [199.5, -0.5], atol=1e-9)  # the outer edges of the first and last pixels
    np.testing.assert_allclose(v, [99.5, -0.5], atol=1e-9)
    np.testing.assert_allclose(z, 5.0)


def test_a_turned_camera_looks_along_the_third_axis_of_its_rotation():
    wxyz = (0.5, -0.1, 0.7, 0.2)
    camera = browser_camera(wxyz, (0, 0, 0), 1.0, CANVAS, 60)
    np.testing.assert_allclose(camera.world_to_cam(4.0 * quat_to_R(wxyz)[:, 2]), [0, 0, 4.0], atol=1e-12)
    np.testing.assert_allclose(camera.world_to_cam(quat_to_R(wxyz)[:, 1]), [0, 1.0, 0], atol=1e-12)


def test_fewer_pixels_show_the_same_view():
    wide = browser_camera(LEVEL, (0, 0, 0), 0.7, (1000, 333), 1000)
    small = browser_camera(LEVEL, (0, 0, 0), 0.7, (1000, 333), 101)
    assert (small.W, small.H) == (101, 34)
    for point in ([0.3, 0.1, 1.0], [-0.5, -0.2, 2.0]):
        (u, v, _), (a, b, _) = wide.project(point), small.project(point)
        np.testing.assert_allclose(((u + 0.5) / 1000, (v + 0.5) / 333), ((a + 0.5) / 101, (b + 0.5) / 34))


BAD_CAMERAS = (
    {"wxyz": (0.0, 0.0, 0.0, 0.0)},
    {"wxyz": (math.nan, 0.0, 0.0, 1.0)},
    {"position": (math.inf, 0.0, 0.0)},
    {"fov": 0.0},
    {"fov": -1.0},
    {"fov": math.pi},
    {"fov": math.nan},
    {"image_height": 0},
    {"image_width": -5},
    {"image_width": 1, "image_height": 10**9},
    {"image_width": 10**9, "image_height": 1},
)


@pytest.mark.usefixtures("as_shipped")
@pytest.mark.parametrize("changes", BAD_CAMERAS)
def test_an_invalid_camera_is_refused(changes):
    pose = {**POSE, **changes}
    canvas = (pose["image_width"], pose["image_height"])
    with pytest.raises(ArgumentError):
        browser_camera(pose["wxyz"], pose["position"], pose["fov"], canvas, 800)


def test_a_picture_equals_our_own_render_from_the_clients_camera(capture, tmp_path):
    with training(capture, tmp_path / "run", "--iterations", "100000") as made, Client(made.view) as client:
        client.move()
        client.press("Pause")
        assert client.paused_at() == made.iteration
        for turn in (LEVEL, (0.99, 0.05, -0.1, 0.03)):
            client.move(wxyz=turn)
            picture = client.picture(width=120)  # a narrower one is drawn while the camera moves
            camera = browser_camera(turn, POSE["position"], POSE["fov"], CANVAS, 120)
            truth = render(
                made.run.trainer.gaussians, camera, settings=made.run.options.render_settings
            ).image
            # JPEG of quality 85 is off by about three levels, which is 38 dB or more; another camera scores far lower.
            assert psnr(picture / 255.0, truth.detach().clamp(0, 1).numpy()) > 32
            assert picture.std() > 20, "the picture is not blank"


def test_while_the_camera_moves_pictures_are_smaller(capture, tmp_path):
    with training(capture, tmp_path / "run", "--iterations", "100000") as made, Client(made.view) as client:
        client.move()
        client.press("Pause")
        client.paused_at()
        until(lambda: client.listened().pictures, "a picture of the camera at rest")
        client.pictures.clear()
        client.move(position=(0.0, 0.0, -4.0))
        widths = until(
            lambda: len(client.listened().pictures) >= 2 and [p.shape for p in client.pictures],
            "two pictures",
        )
        assert widths == [(32, 48, 3), (80, 120, 3)], "0.4 of the width first"
        time.sleep(2 * live.STILL_EVERY)
        assert len(client.listened().pictures) == 2, "while paused and at rest, nothing is drawn"


def test_the_panel_says_why_a_picture_is_missing(capture, tmp_path, monkeypatch):
    with training(capture, tmp_path / "run", "--iterations", "100000") as made, Client(made.view) as client:
        client.move()
        client.press("Pause")
        client.paused_at()
        right = made.view._render

        def fail(gaussians, camera):
            raise NotEnoughMemoryError("an image of 120x80 px: needs 9.0 GiB of memory, but 1.0 GiB are free")

        monkeypatch.setattr(made.view, "_render", fail)
        client.move(position=(0.0, 0.1, -4.0))
        client.says("`not drawn: an image of 120x80 px: needs 9.0 GiB of memory, but 1.0 GiB are free`")
        monkeypatch.setattr(made.view, "_render", right)
        client.move(position=(0.0, 0.2, -4.0))
        until(lambda: "not drawn" not in client.listened().text, "a panel without the failure")
        assert "**paused**" in client.text


def test_pause_step_and_resume(capture, tmp_path):
    with training(capture, tmp_path / "run", "--iterations", "100000") as made, Client(made.view) as client:
        client.move()
        client.press("Pause")
        held = client.paused_at()
        assert made.iteration == held
        for k in range(1, 4):
            client.press("Step")
            until(lambda k=k: client.listened().paused_at() == held + k, "one more iteration")
            time.sleep(3 * live.POLL)
            assert made.iteration == held + k, "exactly one"
        client.press("Resume")
        until(lambda: made.iteration > held + 50, "many more iterations")
        client.says(r"\*\*training\*\*")
        assert "Pause" in client.listened().buttons


def test_step_pauses_a_running_training(capture, tmp_path):
    with training(capture, tmp_path / "run", "--iterations", "100000") as made, Client(made.view) as client:
        client.move()
        client.press("Step")
        assert client.paused_at() == made.iteration > 0


def test_a_paused_training_continues_when_nobody_watches(capture, tmp_path, monkeypatch):
    monkeypatch.setattr(live, "GRACE", 0.2)
    with training(capture, tmp_path / "run", "--iterations", "100000") as made:
        with Client(made.view) as client:
            client.move()
            client.press("Pause")
            held = client.paused_at()
        until(lambda: made.iteration > held + 20, "more iterations")
        with Client(made.view) as another:
            another.move()
            another.press("Pause")  # the button must say Pause again
            another.paused_at()


def test_stopping_the_program_ends_a_pause(capture, tmp_path):
    with training(capture, tmp_path / "run", "--iterations", "100000") as made, Client(made.view) as client:
        client.move()
        client.press("Pause")
        held = client.paused_at()
        made.stopped.set()
        made.ended()
        assert made.iteration == held
        (checkpoint,) = list_checkpoints(made.run.folder.checkpoints)[-1:]
        assert checkpoint.stem == f"iteration_{held}", "the training so far is saved"


def test_a_pause_is_not_counted_as_training(capture, tmp_path, monkeypatch):
    """The clock jumps by an hour during the pause; the run's own time must be less."""
    clock, ahead = time.perf_counter, []
    monkeypatch.setattr(time, "perf_counter", lambda: clock() + sum(ahead))
    with training(capture, tmp_path / "run", "--iterations", "60") as made, Client(made.view) as client:
        client.move()
        client.press("Step")
        client.paused_at()
        ahead.append(3600.0)
        client.press("Resume")
        made.ended()
    assert 0 < made.run.seconds < 3600


def trained(out, capture, *words, watch=None):
    """Train while `watch` runs; return the state without its clock, and the scene's bytes."""
    with training(capture, out, "--iterations", "200", "--random-background", *words) as made:
        if watch is not None:
            watch(made)
        made.ended()
        tensors, numbers = made.run.trainer.state()
        made.run.finish(lambda split, score: made.view.update("evaluating"))
    scene = out / "point_cloud" / "iteration_200" / "point_cloud.ply"
    bits = {name: tensor.numpy().tobytes() for name, tensor in tensors.items()}
    return bits, repr(numbers), scene.read_bytes()


@pytest.mark.sliced(1)
@pytest.mark.parametrize("strategy", STRATEGIES)
def test_watching_does_not_change_the_bits_of_a_training(capture, tmp_path, strategy):
    """One training runs alone, the other with two moving cameras, pauses and steps."""
    seen = []

    def watch(made):
        with Client(made.view) as one, Client(made.view) as two:
            one.move()
            one.press("Step")
            for k in range(12):
                held = one.paused_at()
                one.press("Step")
                until(lambda held=held: one.listened().paused_at() > held, "a step")
                two.move(position=(0.05 * k, 0.0, -3.0), wxyz=(1.0, 0.0, 0.02 * k, 0.0), image_width=300)
            one.press("Resume")
            while made.thread.is_alive():
                for client in (one, two):
                    client.move(position=(0.3 * math.sin(len(seen)), 0.0, -3.0))
                    seen.extend(client.listened().pictures)
                    client.pictures.clear()

    words = STRATEGIES[strategy]
    alone = trained(tmp_path / "alone", capture, *words)
    assert trained(tmp_path / "watched", capture, *words, watch=watch) == alone
    assert len(seen) > 10, "it was watched"


@pytest.mark.usefixtures("as_shipped")
def test_clients_that_send_nonsense_do_no_harm(capture, tmp_path, capfd):
    with training(capture, tmp_path / "run", "--iterations", "100000") as made:
        for nonsense in (b"", b"\xff", msgspec.msgpack.encode({"type": "None"}), msgspec.msgpack.encode(7)):
            with Client(made.view) as client:
                client.socket.send(nonsense)
        with Client(made.view) as client:
            for changes in BAD_CAMERAS:
                client.move(**changes)
                before = made.iteration
                until(lambda before=before: made.iteration > before + 5, "more iterations")
            client.move()
            assert client.picture().shape[2] == 3, "a valid camera is drawn again"
            slider = made.view._width._impl.uuid
            for width in (10**12, -1, math.inf, math.nan):
                client.send("GuiUpdateMessage", uuid=slider, updates={"value": width})
                assert client.picture().shape[1] <= 120
    assert capfd.readouterr() == ("", ""), "the terminal stays clean"


def test_a_client_cannot_open_a_tunnel(capture, tmp_path, capfd):
    with training(capture, tmp_path / "run", "--iterations", "100000") as made, Client(made.view) as client:
        client.move()
        client.send("ShareUrlRequest")
        client.picture()
        client.picture()
        assert client.shared == [] and made.view._server._share_tunnel is None
        assert made.view._server.request_share_url() is None


def test_the_camera_list_and_the_way_back(capture, tmp_path):
    with training(capture, tmp_path / "run", "--iterations", "100000") as made, Client(made.view) as client:
        dataset = made.run.dataset
        views = sorted([*dataset.train, *dataset.test], key=lambda view: view.name)
        held_out = {view.name for view in dataset.test}
        assert client.options("Camera") == [
            f"{view.name} (held out)" if view.name in held_out else view.name for view in views
        ]
        client.move()
        client.picture()
        for name, view in ((client.options("Camera")[0], views[0]), (views[3].name, views[3])):
            client.moved.clear()
            client.choose("Camera", name)
            camera = view.camera
            until(lambda: "SetCameraLookAtMessage" in client.listened().moved, "the camera")
            position = client.moved["SetCameraPositionMessage"]["position"]
            np.testing.assert_allclose(position, camera.eye, atol=1e-6)
            ahead = np.subtract(client.moved["SetCameraLookAtMessage"]["look_at"], position)
            np.testing.assert_allclose(ahead / np.linalg.norm(ahead), camera.R[2], atol=1e-6)
        client.moved.clear()
        client.press("Reset view")
        until(lambda: "SetCameraPositionMessage" in client.listened().moved, "the start")
        start = dataset.train[0].camera
        np.testing.assert_allclose(client.moved["SetCameraPositionMessage"]["position"], start.eye, atol=1e-6)


def new_threads(before):
    """Return the new threads, except the trainer's own that reads photos."""
    return {thread for thread in set(threading.enumerate()) - before if not thread.name.startswith("photo")}


def test_everything_is_closed_and_restored(capture, tmp_path, capfd):
    threads, serve = set(threading.enumerate()), websockets.asyncio.server.serve
    with training(capture, tmp_path / "run", "--iterations", "30") as made:
        assert websockets.asyncio.server.serve is serve
        port = made.view._server.get_port()
        with Client(made.view) as client:
            client.move()
            made.ended()
    assert not rich.get_console().quiet
    assert capfd.readouterr() == ("", ""), "viser's banner stays off the terminal"
    until(lambda: new_threads(threads) == set(), "the end of its threads")
    with PageServer(b"", port=port):
        pass


def test_everything_is_closed_after_an_error(capture, tmp_path):
    threads = set(threading.enumerate())
    made = Training(capture, tmp_path / "run", "--iterations", "30")
    with pytest.raises(RuntimeError), made.view:
        raise RuntimeError
    until(lambda: new_threads(threads) == set(), "the end of its threads")


def test_the_finished_scene_is_shown_until_the_last_browser_closes(capture, tmp_path, monkeypatch):
    monkeypatch.setattr(live, "GRACE", 0.3)
    with training(capture, tmp_path / "run", "--iterations", "300") as made:
        with Client(made.view) as client:
            client.move()
            until(lambda: made.view.watched, "a browser that is connected")
            made.ended()
            assert made.view.watched
            staying = threading.Thread(target=made.view.stay)
            staying.start()
            client.says(r"\*\*finished\*\*\s+iteration 300 of 300")
            client.move(position=(0.0, 0.0, -4.0))
            assert client.picture(width=120).std() > 10, "the finished scene is still drawn"
            assert staying.is_alive()
        staying.join(PATIENCE)
        assert not staying.is_alive() and not made.view.watched
        again = threading.Thread(target=made.view.stay)
        again.start()
        again.join(PATIENCE)
        assert not again.is_alive(), "without a browser it does not stay open"
