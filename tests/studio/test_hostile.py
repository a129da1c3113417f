"""Opening a library from somebody else starts no program, writes nothing outside of the library and opens no
connection. All checks are made from outside of the server's process.
"""

import contextlib
import json
import os
import re
import signal
import socket
import subprocess
from pathlib import Path

import pytest

from gsplat_edu.cli.main import main
from gsplat_edu.jobs.process import identity
from gsplat_edu.jobs.record import VERSION
from gsplat_edu.studio.adopted import note_adopted
from studio.conftest import Inline
from studio.pages import Visitor, served
from studio.test_server import Server
from waiting import PATIENCE, until

LONG = "x" * 5_000


def work(command, inputs, outputs=(), **options):
    """Return the work of a job as a record has it."""
    return {"command": command, "inputs": list(inputs), "outputs": list(outputs), "options": options}


def record(library, name, *, events=None, **changes):
    """Write the record of a harmless job with changes; return its folder."""
    folder = library / ".studio" / "jobs" / name
    folder.mkdir(parents=True)
    harmless = work("doctor", ["captures/box"])
    entry = {
        "version": VERSION,
        "id": name,
        "work": harmless,
        "state": "queued",
        "created": 1.0,
        "started": None,
        "ended": None,
        "attempts": 0,
        "pid": None,
        "identity": "",
        "line": "",
        "cancelled": False,
        "begun_by": "",
        "begun_at": "",
        **changes,
    }
    (folder / "job.json").write_text(json.dumps(entry))
    if events is not None:
        (folder / "events.jsonl").write_text(events)
    return folder


def snapshot(folder):
    """Return names, kinds, contents and times of a folder's files."""
    return {
        str(path): (path.lstat().st_mode, path.lstat().st_mtime_ns, path.is_file() and path.read_bytes())
        for path in sorted(folder.rglob("*"))
    }


def children(pid):
    """Return the command lines of a process's children."""
    found = []
    for place in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError):
            if int((place / "stat").read_text().rpartition(")")[2].split()[1]) == pid:
                found.append((place / "cmdline").read_bytes().replace(b"\0", b" ").decode())
    return found


def sockets(pid):
    """Return the TCP sockets of a process as (local, remote, state)."""
    held = set()
    for fd in Path(f"/proc/{pid}/fd").iterdir():
        with contextlib.suppress(OSError):
            held.add(os.readlink(fd))  # noqa: PTH115 - a name, not a path
    rows = [line.split() for table in ("tcp", "tcp6") for line in _rows(pid, table)]
    return [(row[1], row[2], row[3]) for row in rows if f"socket:[{row[9]}]" in held]


def _rows(pid, table):
    with contextlib.suppress(OSError):
        return Path(f"/proc/{pid}/net/{table}").read_text().splitlines()[1:]
    return []


@pytest.fixture
def victim():
    """A process of the same user that is not a job's."""
    process = subprocess.Popen(["sleep", "600"], start_new_session=True)
    yield process
    process.kill()
    process.wait()


def outside_of(tmp_path):
    """Make files outside that a hostile library tries to reach."""
    outside = tmp_path / "outside"
    for name in ("run/live", "thumbs", "job", "trash/secret", "exports"):
        (outside / name).mkdir(parents=True)
    for name in ("run/config.json", "run/live/pause", "thumbs/a.jpg", "events.jsonl", "trash/from.txt"):
        (outside / name).write_text("runs")
    (outside / "precious.txt").write_text("precious")
    return outside


def hostile_folders(library, outside):
    """Fill a library with links that lead out of it."""
    for name in (
        "captures/box",
        "runs/inner",
        "scenes/s",
        ".studio/uploads",
        ".studio/cache",
        ".studio/trash",
    ):
        (library / name).mkdir(parents=True)
    (library / "runs" / "inner" / "config.json").write_text('{"format": 1}')
    (library / "runs" / "inner" / "point_cloud").symlink_to(outside)
    (library / "scenes" / "s" / "s.ply").write_text("ply")
    (library / "scenes" / "s" / "exports").symlink_to(outside / "exports")
    (library / "runs" / "linked").symlink_to(outside / "run")
    (library / ".studio" / "uploads" / "x").symlink_to(outside)
    (library / ".studio" / "cache" / "thumbs").symlink_to(outside / "thumbs")
    (library / ".studio" / "trash" / "00000000000000000001").symlink_to(outside / "trash")


def forbidden_work(library, outside, victim, port):
    """Write records of work that no request may ask for."""
    old = {"version": 1, "title": "t", "subject": "runs/inner", "request": None}
    scheduler = f"tcp://127.0.0.1:{port}"
    convert = ["convert", str(library / "scenes" / "s" / "s.ply"), str(outside / "written.ply")]
    record(library, "000001", **old, argv=convert)
    blocks = [
        "train",
        str(library / "captures" / "box"),
        "--out",
        "x",
        "--blocks",
        "2",
        "--scheduler",
        scheduler,
    ]
    record(library, "000002", **old, argv=blocks)
    record(library, "000003", argv=convert)
    box, new = ["captures/box"], ["runs/new"]
    record(library, "000004", work=work("train", box, new, scheduler=scheduler))
    record(library, "000005", work=work("train", box, ["runs/../../outside/run"]))
    record(library, "000006", work=work("train", ["captures/../../outside"], new))
    record(library, "000007", work=work("train", box, [str(outside / "new")]))
    record(library, "000008", work=work("train", box, new, time_limit=f"--scheduler={scheduler}"))
    record(library, "000009", work=work("convert", ["scenes/s"], ["scenes/s/exports/s.spz"]))
    linked = work("convert", ["runs/linked"], ["runs/linked/exports/x.spz"])
    record(library, "000010", work=linked, state="interrupted", attempts=1)
    paused = work("train", box, ["runs/linked"])
    record(library, "000011", work=paused, state="paused", attempts=1, pid=victim.pid, identity="")
    (library / ".studio" / "jobs" / "000012").symlink_to(outside / "job")
    (record(library, "000013") / "events.jsonl").symlink_to(outside / "events.jsonl")
    os.mkfifo(record(library, "000014") / "output.txt")


def impossible_values(library):
    """Write records whose fields have impossible values."""
    record(library, "000015", work=work("train", ["captures/box"], [f"runs/{LONG}"]))
    record(library, "000016", line=LONG)
    record(library, "000017", created=1e400)
    record(library, "000018", pid=1, state="running")
    record(library, "000019", work={**work("doctor", ["captures/box"]), "outputs": "abc"})
    record(library, "000020", attempts=True)
    record(library, "000021", line="\x1b[2J")
    record(library, "000022", id="000023")
    record(library, "000024", work=[["doctor"]])
    record(library, "000025", work={**work("doctor", ["captures/box"]), "argv": ["demo"]})
    record(library, "000026", work=work("doctor", ["captures/box"] * 101))
    record(library, "000027", work={**work("doctor", ["captures/box"]), "options": [["resolution", 2]]})


def others_processes(library, victim):
    """Write records of allowed work that name a process which is not theirs; return their states once opened."""
    proof = identity(victim.pid)
    started = json.dumps({"event": "started", "time": 1, "pid": victim.pid, "identity": proof}) + "\n"
    record(library, "000031")
    record(library, "000032", state="running", attempts=1, pid=victim.pid, identity=proof)
    record(library, "000033", state="paused", attempts=1, pid=victim.pid, identity=proof)
    record(library, "000034", state="running", attempts=1, events=started)
    record(library, "000035", state="running", attempts=1, pid=victim.pid, identity="", cancelled=True)
    inner = work("train", ["captures/box"], ["runs/inner"])
    record(library, "000036", work=inner, state="interrupted", attempts=1)
    return {
        "000031": "held",
        **dict.fromkeys(("000032", "000033", "000034"), "interrupted"),
        "000035": "cancelled",
        "000036": "interrupted",
    }


def test_a_strangers_library_runs_nothing_until_a_click_that_shows_what(tmp_path, victim):
    library, outside = tmp_path / "library", outside_of(tmp_path)
    with socket.create_server(("127.0.0.1", 0)) as trap:
        trap.setblocking(False)
        hostile_folders(library, outside)
        forbidden_work(library, outside, victim, trap.getsockname()[1])
        impossible_values(library)
        allowed = others_processes(library, victim)
        before, entries = snapshot(outside), snapshot(library / "runs")
        server = Server(library)
        try:
            check_hostile(server, allowed, library, victim)
            with pytest.raises(BlockingIOError):
                trap.accept()
            assert snapshot(outside) == before and snapshot(library / "runs") == entries
            assert victim.poll() is None
            state = Path(f"/proc/{victim.pid}/stat").read_text().rpartition(")")[2].split()[0]
            assert state == "S"  # the process was not stopped either
            # a click runs exactly the command that was shown
            assert server.client.post("/api/jobs/000031/resume").json()["state"] == "queued"
            # until it executes its program, a forked child has the server's command line
            until(lambda: (found := children(server.process.pid)) and " studio " not in found[0])
            (child,) = children(server.process.pid)
            assert child.split(" ", 3)[3] == f"doctor {library}/captures/box --no-forecast "
            server.client.post("/api/jobs/000031/cancel")
        finally:
            server.process.send_signal(signal.SIGINT)
            server.process.wait(PATIENCE)
            server.kill()
        assert snapshot(outside) == before and victim.poll() is None


def check_hostile(server, allowed, library, victim):
    """Check the server's process, and request everything that the page offers."""
    found = server.get("jobs")
    assert {job["id"]: job["state"] for job in found["jobs"]} == allowed
    damaged = {entry["id"]: entry["line"] for entry in found["damaged"]}
    assert sorted(damaged) == [f"{number:06d}" for number in (*range(1, 23), *range(24, 28))]
    assert all("\n" not in line and len(line) < 400 for line in damaged.values()), damaged
    held = found["jobs"][0]
    assert held["command"] == f"gsplat-edu doctor {library}/captures/box --no-forecast" and held["resumable"]
    for name in damaged:
        for action in ("resume", "cancel", "pause"):
            assert server.client.post(f"/api/jobs/{name}/{action}").status_code == 404
    for name in allowed:
        assert server.client.post(f"/api/jobs/{name}/pause").status_code == 409
    # this run has a link that leads out
    assert server.client.post("/api/jobs/000036/resume").status_code == 409
    listed = server.get("library")
    assert [entry["name"] for entry in listed["runs"]] == ["inner"]
    assert any(line.startswith("runs/linked: leads out of the library") for line in listed["trouble"])
    for path in ("runs/linked", "runs/linked/scene", "runs/linked/exports"):
        assert server.client.get(f"/api/{path}").status_code == 409, path
    assert server.get("trash") == {"trash": []} and server.get("scenes/s/exports") == {"exports": []}
    for number in (1, 12, 14):
        assert server.client.delete(f"/api/jobs/{number:06d}").status_code == 200
    assert not os.path.lexists(library / ".studio" / "jobs" / "000012")  # only the link is removed
    assert children(server.process.pid) == []
    listening = [local for local, _, state in sockets(server.process.pid) if state == "0A"]
    assert [int(local.rpartition(":")[2], 16) for local in listening] == [server.port]
    connected = {local.rpartition(":")[2] for local, _, state in sockets(server.process.pid) if state == "01"}
    assert connected <= {f"{server.port:04X}"}  # only connections that clients have opened
    assert victim.poll() is None


@pytest.mark.parametrize(
    "place", ["photos", "runs", ".studio", ".studio/uploads", ".studio/jobs", ".studio/.lock"]
)
def test_a_library_whose_own_folders_lead_elsewhere_is_not_opened(tmp_path, capsys, place):
    outside = outside_of(tmp_path)
    before = snapshot(outside)
    link = tmp_path / "library" / place
    link.parent.mkdir(parents=True)
    link.symlink_to(outside / "precious.txt" if place.endswith(".lock") else outside)
    assert main(["studio", str(tmp_path / "library"), "--no-open", "--port", "0"]) == 2
    said = capsys.readouterr()
    assert re.fullmatch(r"gsplat-edu studio: FOLDER: .* is a link or .*\n", said.err) and said.out == ""
    assert snapshot(outside) == before


def test_a_link_is_followed_once_its_place_was_adopted(page, studio, tmp_path, jpeg):
    place = tmp_path / "photos of a trip"
    place.mkdir()
    (place / "a.jpg").write_bytes(jpeg)
    (studio.library.root / "photos" / "trip").symlink_to(place)
    listed = page.get("/api/library").json()
    assert listed["photos"] == [] and len(listed["trouble"]) == 1
    assert page.post("/api/jobs", json={"command": "sfm", "subject": "photos/trip"}).status_code == 409
    answer = page.post("/api/adopt", json={"kind": "photos", "path": str(place), "name": "trip"})
    assert answer.status_code == 200 and answer.json()["adopted"] == str(place)
    assert page.get("/api/library").json()["trouble"] == []
    assert page.post("/api/jobs", json={"command": "sfm", "subject": "photos/trip"}).status_code == 200


def test_the_list_of_adopted_places_is_the_users_and_may_be_damaged(tmp_path, monkeypatch):
    from gsplat_edu.studio.library import Library

    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    library, place = tmp_path / "library", tmp_path / "place"
    place.mkdir()
    Library(library).adopt("photos", place, "trip")
    assert [path.name for path in Library(library).entries("photos")] == ["trip"]
    (tmp_path / "copy").mkdir()
    (tmp_path / "copy" / "photos").mkdir()
    (tmp_path / "copy" / "photos" / "trip").symlink_to(place)
    assert Library(tmp_path / "copy").entries("photos") == []  # adopted for another library
    (tmp_path / "state" / "gsplat-edu" / "adopted.json").write_text("[" * 100_000)
    assert Library(library).entries("photos") == []
    note_adopted(library, place)
    assert [path.name for path in Library(library).entries("photos")] == ["trip"]


def test_the_page_shows_what_a_held_job_will_run_and_removes_damaged_ones(browser, tmp_path):
    library = tmp_path / "library"
    (library / "captures" / "box").mkdir(parents=True)
    record(library, "000001")
    record(library, "000002", work=work("demo", []))
    with served(library, Inline()) as (studio, url):
        context = browser.new_context()
        person = Visitor(context, url)
        tab = person.tab
        tab.goto(f"{url.partition('?')[0]}#/jobs")
        card = tab.get_by_role("article", name="doctor of box")
        card.get_by_text("waits for you").wait_for()
        assert person.command("doctor of box") == f"gsplat-edu doctor {library}/captures/box --no-forecast"
        broken = tab.get_by_role("list", name="damaged jobs").get_by_role("listitem")
        assert "job 000002: is damaged (command: is 'demo'" in broken.inner_text()
        broken.get_by_role("button", name="Remove from the list").click()
        broken.wait_for(state="detached")
        assert not (library / ".studio" / "jobs" / "000002").exists()
        tab.get_by_role("button", name="Undo", exact=True).click()
        broken.wait_for()
        broken.get_by_role("button", name="Remove from the list").click()
        broken.wait_for(state="detached")
        card.get_by_role("button", name="Remove from the list").click()
        card.wait_for(state="detached")
        tab.get_by_role("button", name="Undo", exact=True).click()
        card.get_by_text("waits for you").wait_for()
        studio.queue.at_once = 0
        card.get_by_role("button", name="Start").click()
        card.get_by_text("waiting", exact=True).wait_for()
        assert person.faults == []
        context.close()
