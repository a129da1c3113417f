"""The live view's requests: states, snapshots, pictures and pauses; watching does not change a training's bits."""

import io
import json
import threading
import time

import numpy as np
import pytest
import torch
from PIL import Image

from gsplat_edu.base.errors import ArgumentError, NotEnoughMemoryError
from gsplat_edu.data.procedural import procedural_capture
from gsplat_edu.data.writers import write_colmap
from gsplat_edu.evaluate.metrics import psnr
from gsplat_edu.render.api import render
from gsplat_edu.scene.camera import Camera
from gsplat_edu.server.page_server import PageServer
from gsplat_edu.train.checkpoint import list_checkpoints
from gsplat_edu.viewer import live, snapshots
from gsplat_edu.viewer.live import picture_camera
from live_clients import (
    PATIENCE,
    STRATEGIES,
    Client,
    Training,
    camera_json,
    made_run,
    training,
    unframed,
    until,
)

ENDLESS = ("--iterations", "100000")


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    folder = tmp_path_factory.mktemp("captures") / "egg"
    write_colmap(folder, *procedural_capture(24, 6, splats=60))
    return folder


def test_the_first_scene_and_state_describe_the_same_paused_training(capture, tmp_path):
    with training(capture, tmp_path / "run", *ENDLESS) as made:
        client = Client(made.view.url)
        client.state()
        assert client.control("pause") == 204
        state = client.states(state="paused")
        header, shown = client.scene()
        trainer = made.run.trainer
        assert state["iteration"] == header["iteration"] == trainer.iteration
        assert header["count"] == state["count"] == len(trainer.gaussians)
        assert torch.equal(shown.means, trainer.gaussians.means.detach())
        assert torch.equal(shown.log_scales, trainer.gaussians.log_scales.detach())
        assert state["psnr"] == psnr(*trainer.last) and state["iterations"] == 100_000
        assert client.ask("GET", f"/scene?after={header['iteration']}")[0] == 204, "there is no newer scene"
        assert client.ask("GET", f"/state?after={state['version']}")[0] in (200, 204)


def test_pause_step_and_resume(capture, tmp_path):
    with training(capture, tmp_path / "run", *ENDLESS) as made:
        client = Client(made.view.url)
        client.state()
        client.control("pause")
        held = client.states(state="paused")["iteration"]
        for k in range(1, 4):
            client.control("step")
            client.states(state="paused", iteration=held + k)
            made.view.asked.clear()
            until(lambda: len(made.view.asked) > 2, "questions of the waiting training")
            assert made.iteration == held + k, "a step is exactly one iteration"
        client.control("resume")
        until(lambda: made.iteration > held + 50, "many more iterations")
        client.states(state="training")
        client.control("step")
        assert client.states(state="paused")["iteration"] == made.iteration > held + 50


def test_a_paused_training_continues_when_nobody_watches(capture, tmp_path):
    with training(capture, tmp_path / "run", *ENDLESS, wait=0.1) as made:
        client = Client(made.view.url)
        client.state()
        client.control("pause")
        held = client.states(state="paused")["iteration"]
        made.view.grace = 0.2
        until(lambda: made.iteration > held + 20, "more iterations")
        client.states(state="training")
        made.view.grace = PATIENCE
        client.control("pause")
        assert client.states(state="paused")["iteration"] > held, "the training can be paused again"


def test_stopping_the_program_ends_a_pause(capture, tmp_path):
    with training(capture, tmp_path / "run", *ENDLESS) as made:
        client = Client(made.view.url)
        client.control("pause")
        held = client.states(state="paused")["iteration"]
        made.stopped.set()
        made.ended()
        assert list_checkpoints(made.run.folder.checkpoints)[-1].stem == f"iteration_{held}", (
            "the paused training is saved"
        )


def test_a_pause_is_not_counted_as_training(capture, tmp_path, monkeypatch):
    """The clock jumps by an hour during the pause, which the run's time does not include."""
    clock, ahead = time.perf_counter, []
    monkeypatch.setattr(time, "perf_counter", lambda: clock() + sum(ahead))
    with training(capture, tmp_path / "run", "--iterations", "60", pressed="step", grace=1e9) as made:
        client = Client(made.view.url)
        client.states(state="paused")
        ahead.append(3600.0)
        client.control("resume")
        made.ended()
    assert 0 < made.run.seconds < 3600


def test_nothing_is_packed_unless_a_page_asks(capture, tmp_path, monkeypatch):
    made_of = []
    packed = snapshots.snapshot_of
    monkeypatch.setattr(
        snapshots, "snapshot_of", lambda trainer: made_of.append(trainer.iteration) or packed(trainer)
    )
    with training(capture, tmp_path / "run", *ENDLESS, wait=0.1) as made:
        client = Client(made.view.url)
        state = client.state()
        until(lambda: made.iteration > state["iteration"] + 50, "more iterations")
        assert made_of == [], "asking for a state packs no snapshot"
        client.scene()
        client.control("pause")
        client.states(state="paused")
        packs = len(made_of)
        until(lambda: client.ask("GET", f"/scene?after={made.iteration}")[0] == 204, "no newer scene")
        assert packs >= 1 and len(made_of) <= packs + 1, "a paused training is packed once"


def bits(run):
    tensors, numbers = run.trainer.state()
    return {name: tensor.numpy().tobytes() for name, tensor in tensors.items()}, repr(numbers)


@pytest.mark.parametrize("strategy", STRATEGIES)
def test_watching_does_not_change_the_bits_of_a_training(capture, tmp_path, strategy, monkeypatch):
    """One training runs without a page, the other with two pages, pictures, pauses and steps."""
    monkeypatch.setattr(snapshots, "SHARE", 1.0)
    words = ("--iterations", "120", "--random-background", *STRATEGIES[strategy])
    alone = made_run(capture, tmp_path / "alone", *words)
    alone.train()
    with training(capture, tmp_path / "watched", *words, pressed="step") as made:
        one, two = Client(made.view.url), Client(made.view.url)
        camera = camera_json(made.run.dataset.train[0].camera)
        held = one.states(state="paused")["iteration"]
        for _ in range(4):
            one.control("step")
            held = one.states(state="paused", iteration=held + 1)["iteration"]
            two.scene()
            assert two.ask("POST", "/picture", camera)[0] == 200
        one.control("resume")
        last = -1
        # Four scenes were sent between the steps; how many follow depends on the machine.
        while made.thread.is_alive():
            status, _, data = two.ask("GET", f"/scene?after={last}")
            if status == 200:
                last = unframed(data)[0]["iteration"]
        made.ended()
        assert bits(made.run) == bits(alone)


def test_a_picture_equals_our_own_render(capture, tmp_path, monkeypatch):
    with training(capture, tmp_path / "run", *ENDLESS) as made:
        client = Client(made.view.url)
        client.control("pause")
        client.states(state="paused")
        camera = made.run.dataset.test[0].camera
        camera = Camera(camera.R, camera.eye, 5 * camera.fx, 5 * camera.fy, 59.5, 50.0, H=100, W=120)
        status, headers, body = client.ask("POST", "/picture", camera_json(camera))
        assert (status, headers["Content-Type"]) == (200, "image/jpeg")
        shown = np.asarray(Image.open(io.BytesIO(body)))
        truth = render(made.run.trainer.gaussians, camera, settings=made.run.options.render_settings).image
        # JPEG of quality 85 is off by about three levels, 38 dB or more; another camera scores far lower.
        assert psnr(shown / 255.0, truth.detach().clamp(0, 1).numpy()) > 32 and shown.std() > 20

        def fail(gaussians, camera):
            raise NotEnoughMemoryError(
                "an image of 120x100 px: needs 9.0 GiB of memory, but 1.0 GiB are free"
            )

        monkeypatch.setattr(type(made.run.options), "renderer", property(lambda options: fail))
        status, _, body = client.ask("POST", "/picture", camera_json(camera))
        assert status == 503 and b"not drawn: an image of 120x100 px: needs 9.0 GiB" in body


GOOD = {"R": np.eye(3).tolist(), "eye": [0, 0, 0], "fx": 9.0, "fy": 9.0, "cx": 1.0, "cy": 1, "W": 4, "H": 3}


@pytest.mark.usefixtures("as_shipped")
@pytest.mark.parametrize(
    "value",
    [
        None,
        [],
        {},
        *(
            GOOD | changes
            for changes in (
                {"R": [[1, 0, 0], [0, 1, 0], [0, 0, 2]]},
                {"R": "x"},
                {"R": [[]]},
                {"eye": [0, 0, float("nan")]},
                {"eye": {}},
                {"fx": 0},
                {"fy": float("inf")},
                {"cx": None},
                {"cy": [1, 2]},
                {"W": 0},
                {"H": 10**9},
                {"W": 3.5},
                {"H": True},
            )
        ),
    ],
)
def test_an_invalid_camera_is_refused(value):
    with pytest.raises(ArgumentError):
        picture_camera(value)
    assert picture_camera(GOOD).W == 4


@pytest.mark.usefixtures("as_shipped")
def test_clients_that_send_nonsense_do_no_harm(capture, tmp_path, capfd):
    with training(capture, tmp_path / "run", *ENDLESS) as made:
        client = Client(made.view.url)
        for path, body in (
            ("/control", b""),
            ("/control", b"\xff"),
            ("/control", b"[]"),
            ("/control", b'{"do": ["pause"]}'),
            ("/control", b'{"do": "erase"}'),
            ("/picture", b"{}"),
            ("/picture", b"[" * 8000),
            ("/picture", json.dumps(GOOD | {"W": 10**12}).encode()),
        ):
            assert client.ask("POST", path, body)[0] == 400, (path, body)
        assert client.ask("POST", "/picture", b" " * 9000)[0] == 413
        assert client.ask("GET", "/../../etc/passwd")[0] == client.ask("GET", "/scene/")[0] == 404
        for method, path in (("PUT", "/control"), ("POST", "/"), ("POST", "/nothing")):
            assert client.ask(method, path, b"{}")[0] == 405, (method, path)
        assert client.ask("HEAD", "/")[::2] == (200, b"")
        for after in ("x", "-7", "9" * 40, "%D9%A3", ""):
            assert client.ask("GET", f"/state?after={after}")[0] in (200, 204)
        before = made.iteration
        until(lambda: made.iteration > before + 5, "more iterations")
    assert capfd.readouterr() == ("", ""), "the terminal stays clean"


def test_only_its_own_page_may_watch(capture, tmp_path):
    """What the guard refuses is in tests/server/test_guard.py."""
    made = Training(capture, tmp_path / "run", "--iterations", "30")
    made.view.take_state({})  # requests for a state do not wait
    with made.view:
        client = Client(made.view.url)
        for method, path in (("GET", "/state"), ("GET", "/"), ("POST", "/control"), ("POST", "/picture")):
            assert client.ask(method, path, b"{}", {"Origin": client.own["Origin"]})[0] == 403, path
            headers = client.own | {"Origin": "http://example.org"}
            assert client.ask(method, path, b"{}", headers)[0] == 403, path
        code, headers, body = client.ask("GET", f"/?token={client.token}", None, {})
        assert code == 200 and b"<html" in body[:300].lower() and client.token.encode() not in body
        assert "frame-ancestors 'none'" in headers["Content-Security-Policy"]
        assert client.ask("GET", "/state")[0] == 200


def new_threads(before):
    """Return the new threads, except the one with which the trainer reads photos."""
    return {thread for thread in set(threading.enumerate()) - before if not thread.name.startswith("photo")}


def test_everything_is_closed_after_an_error(capture, tmp_path):
    threads = set(threading.enumerate())
    made = Training(capture, tmp_path / "run", "--iterations", "30")
    port = Client(made.view.url).port
    with pytest.raises(RuntimeError), made.view:
        raise RuntimeError
    until(lambda: new_threads(threads) == set(), "the end of its threads")
    with PageServer(port=port):
        pass


def test_the_finished_scene_is_shown_until_the_last_browser_closes(capture, tmp_path):
    with training(capture, tmp_path / "run", "--iterations", "30", wait=0.1) as made:
        client = Client(made.view.url)
        client.ask("GET", "/state")
        made.ended()
        client.ask("GET", "/state")
        staying = threading.Thread(target=made.broadcast.stay, args=(lambda: made.view.watched,))
        staying.start()
        state = client.states(state="finished")
        assert (state["iteration"], state["iterations"], state["seconds_left"]) == (30, 30, None)
        assert client.scene()[0]["iteration"] == 30
        assert staying.is_alive()
        made.view.grace = 0.3
        staying.join(PATIENCE)
        assert not staying.is_alive() and not made.view.watched
        made.broadcast.stay(lambda: made.view.watched)  # without a browser, the view closes


def test_a_picture_that_comes_too_late_is_not_that_of_the_next_camera(capture, tmp_path, monkeypatch):
    run = made_run(capture, tmp_path / "run", "--iterations", "30")
    cameras = [view.camera for view in run.dataset.train[:2]]
    images = [run.options.renderer(run.trainer.gaussians, camera) for camera in cameras]
    monkeypatch.setattr(live, "PICTURE_WAIT", PATIENCE)
    with live.LiveView(run, port=0) as view:
        waits, over = view._news.wait_for, threading.Event()
        monkeypatch.setattr(
            view._news, "wait_for", lambda true, time: waits(lambda: true() or over.is_set(), time)
        )
        late = threading.Thread(target=view.picture, args=(cameras[0],))
        late.start()
        until(lambda: view.camera() is cameras[0], "the first request")
        with view._news:  # its time is over while the picture is drawn
            over.set()
            view._news.notify_all()
        late.join(PATIENCE)
        over.clear()
        found = []
        second = threading.Thread(target=lambda: found.append(view.picture(cameras[1])))
        second.start()
        until(lambda: view._wanted is cameras[1], "the second request")
        view.take_picture(images[0])
        assert view.camera() is cameras[1]
        view.take_picture(images[1])
        second.join(PATIENCE)
    assert found == [live.jpeg_of(images[1])] and found != [live.jpeg_of(images[0])]
