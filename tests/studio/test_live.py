"""The live view of a job's training requests files only while somebody watches, and pausing it pauses the job."""

import json
import os

import pytest

from gsplat_edu.jobs import events
from gsplat_edu.jobs.process import identity
from gsplat_edu.jobs.record import Job, State
from gsplat_edu.studio import live_routes
from gsplat_edu.viewer.live_folder import LiveFolder, framed
from waiting import PATIENCE

STATE = {"state": "training", "iteration": 30, "scene": 30}


@pytest.fixture
def training(studio, page):
    """The live files of a run that the server takes for the training of a job."""
    (studio.library.root / "captures" / "a").mkdir()
    job = page.post("/api/jobs", json={"command": "train", "subject": "captures/a", "to": "r"}).json()["id"]
    # the queue does not check whether the process, which is this one, has ended
    studio.queue._look = lambda: None
    pid = os.getpid()
    running = {"state": State.RUNNING, "pid": pid, "identity": identity(pid)}
    studio.queue._jobs[job] = Job(**{**vars(studio.queue.get(job)), **running})
    run = studio.library.root / "runs" / "r"
    run.mkdir()
    (run / "config.json").touch()
    path = studio.queue.files(job).events
    path.write_text(events.line_of(events.Progress("training", 30, 100), 1.0))
    yield LiveFolder(run)
    studio.queue._jobs[job] = Job(**{**vars(studio.queue.get(job)), "state": State.DONE, "pid": None})


def test_files_are_requested_only_while_somebody_watches(page, training):
    assert not training.is_wanted()
    training.path.mkdir()
    training.write(training.state, STATE)
    training.scene.write_bytes(framed(30, 0, 0, b""))
    found = page.get("/api/runs/r/live/state").json()
    assert found["iteration"] == 30 and training.is_wanted()
    scene = page.get("/api/runs/r/live/scene?after=-1")
    assert scene.content == training.scene.read_bytes()


@pytest.fixture
def impatient(monkeypatch):
    """Requests wait for a fraction of a second."""
    monkeypatch.setattr(live_routes, "WAIT", 0.2)


@pytest.mark.usefixtures("impatient")
def test_requests_wait_for_a_new_state(page, training, monkeypatch):
    training.path.mkdir()
    assert page.get("/api/runs/r/live/state").status_code == 204
    assert page.get("/api/runs/r/live/scene?after=-1").status_code == 204
    training.write(training.state, STATE)
    version = page.get("/api/runs/r/live/state").json()["version"]
    assert page.get(f"/api/runs/r/live/state?after={version}").status_code == 204
    monkeypatch.setattr(live_routes, "WAIT", PATIENCE)
    look, looks = live_routes._new_state, []

    def later(*found):
        """Write the next state once the first look has found none."""
        looks.append(look(*found))
        if len(looks) == 1:
            training.write(training.state, {**STATE, "iteration": 31})
        return looks[-1]

    monkeypatch.setattr(live_routes, "_new_state", later)
    assert page.get(f"/api/runs/r/live/state?after={version}").json()["iteration"] == 31
    assert looks[0] is None and len(looks) == 2


def test_pausing_the_view_pauses_the_job(page, studio, training):
    training.path.mkdir()
    training.write(training.state, STATE)
    before = page.get("/api/runs/r/live/state").json()["version"]
    assert page.post("/api/runs/r/live/control", content=json.dumps({"do": "pause"})).status_code == 204
    assert training.is_paused() and studio.queue.get("000001").state is State.PAUSED
    said = page.get(f"/api/runs/r/live/state?after={before}").json()
    assert said["state"] == "paused"  # at once, before the training reports it
    assert page.post("/api/runs/r/live/control", content=json.dumps({"do": "pause"})).status_code == 409
    assert page.post("/api/jobs/000001/resume").json()["state"] == "running" and not training.is_paused()
    assert page.post("/api/runs/r/live/control", content=json.dumps({"do": "explode"})).status_code == 400
    assert page.post("/api/runs/r/live/control", content=b"{").status_code == 400


@pytest.mark.usefixtures("impatient")
def test_damaged_files_and_finished_runs_have_no_live_view(page, studio, training):
    training.path.mkdir()
    training.state.write_text("{")
    training.scene.write_bytes(b"\xff" * 40)
    assert page.get("/api/runs/r/live/state").status_code == 204
    assert page.get("/api/runs/r/live/scene").status_code == 204
    studio.queue._jobs["000001"] = Job(**{**vars(studio.queue.get("000001")), "state": State.DONE})
    for path in ("state", "scene", "page"):
        assert page.get(f"/api/runs/r/live/{path}").status_code == 409
    assert page.get("/api/runs/none/live/state").status_code == 409
    assert not (studio.library.root / "runs" / "none").exists()
