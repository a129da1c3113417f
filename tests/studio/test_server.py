"""The server in a process of its own, with sockets, trainings, and kill -9."""

import contextlib
import io
import json
import os
import re
import signal
import socket
import subprocess
import sys
import threading
import zipfile
from pathlib import Path

import httpx2
import pytest

from gsplat_edu.data.procedural import procedural_capture
from gsplat_edu.data.writers import write_colmap
from gsplat_edu.server.serving import REQUEST_SECONDS
from processes import Program
from waiting import HERE, PATIENCE, until

HELD = """
import sys
from pathlib import Path
from gsplat_edu.cli.main import main

if sys.argv[1] == "train":
    sys.path.append({tests!r})
    from gsplat_edu.runs.training import CaptureRun
    from waiting import until
    train = CaptureRun.train

    def held(run, stop, callbacks=()):
        def wait(trainer, event):
            until(lambda: trainer.iteration < 390 or Path({goes_on!r}).exists() or stop())
        return train(run, stop, [*callbacks, wait])

    CaptureRun.train = held
sys.exit(main())
"""
"""The program of a job, whose training does not pass its 390th iteration before a file exists."""

HOLDS = """
import functools, sys
from gsplat_edu.jobs import queue
queue.JobQueue = functools.partial(queue.JobQueue, program=(sys.executable, "-c", {held!r}))
from gsplat_edu.cli.main import main
sys.exit(main())
"""
"""The program of a server whose jobs run another program."""


class Server:
    """`gsplat-edu studio` on a folder.

    Args:
        folder: The folder.
        words: More options.
        program: What Python runs.
    """

    def __init__(self, folder, *words, program=("-m", "gsplat_edu")):
        begin = [sys.executable, *program, "studio", str(folder)]
        command = [*begin, "--port", "0", "--no-open", *words]
        self.process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        line = self.process.stdout.readline()
        self.url, self.token = re.fullmatch(r"(http://127\.0\.0\.1:\d+/)\?token=(\S+) .*\n", line).groups()
        self.port = int(self.url.split(":")[2].strip("/"))
        self.client = httpx2.Client(
            base_url=self.url, headers={"Authorization": f"Bearer {self.token}"}, timeout=PATIENCE
        )

    def get(self, path):
        return self.client.get(f"/api/{path}").json()

    def start(self, **request):
        answer = self.client.post("/api/jobs", json=request)
        assert answer.status_code == 200, answer.text
        return answer.json()["id"]

    def reached(self, job, *states):
        def found():
            one = self.get(f"jobs/{job}")
            assert one["state"] in states or one["state"] not in ("failed", "interrupted"), one
            return one["state"] in states and one

        return until(found)

    def kill(self):
        self.process.kill()
        self.process.wait()
        self.process.stdout.close()
        self.client.close()


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    """A capture as a folder, and as the bytes of a zip file."""
    folder = tmp_path_factory.mktemp("capture") / "box"
    write_colmap(folder, *procedural_capture(24, 14))
    data = io.BytesIO()
    with zipfile.ZipFile(data, "w", zipfile.ZIP_DEFLATED) as archive:
        for path in sorted(folder.rglob("*")):
            archive.write(path, path.relative_to(folder.parent))
    return folder, data.getvalue()


@pytest.fixture
def served(tmp_path):
    """Start servers on a folder; those that still run at the end are killed."""
    made = []

    def serve(*words, **options):
        made.append(Server(tmp_path / "library", *words, **options))
        return made[-1]

    yield serve
    for server in made:
        if server.process.poll() is None:
            with contextlib.suppress(Exception):
                for job in server.get("jobs")["jobs"]:
                    if job["state"] in ("running", "paused"):
                        os.kill(_pid(tmp_path / "library", job["id"]), signal.SIGKILL)
            server.kill()


def _pid(folder, job):
    return json.loads((folder / ".studio" / "jobs" / job / "job.json").read_text())["pid"]


def logged(folder):
    with contextlib.suppress(OSError, IndexError, ValueError):
        return json.loads((folder / "log.jsonl").read_text().splitlines()[-1])["iteration"]
    return 0


def check_that_an_export_waits(server, training):
    """Check that an export of a run in training waits, although another job could run; then cancel it."""
    late = server.start(command="convert", subject="runs/box", format="ply")
    until(lambda: server.get(f"jobs/{late}")["waits_for"])
    found = server.get(f"jobs/{late}")
    assert (found["state"], found["waits_for"]) == ("queued", [{"job": training, "place": "runs/box"}])
    assert server.client.post(f"/api/jobs/{late}/cancel").json()["attempts"] == 0


@pytest.mark.slow
def test_from_photos_to_a_scene_although_server_and_job_are_killed(served, capture, tmp_path):
    """Upload, train, kill the server, find the job, kill both, rename, resume and export give the commands' bytes.

    The training cannot end before it was paused and killed.
    """
    folder, zipped = capture
    library, run, goes_on = tmp_path / "library", tmp_path / "library" / "runs" / "box", tmp_path / "goes on"
    program = ("-c", HOLDS.format(held=HELD.format(goes_on=str(goes_on), tests=HERE)))
    server = served("--jobs", "2", program=program)
    assert server.client.put("/api/captures/box/zip", content=zipped).json()["files"] > 14
    options = {"iterations": 400, "save_every": 50, "seed": 3}
    job = server.start(command="train", subject="captures/box", to="box", options=options)
    until(lambda: logged(run) >= 80)
    assert server.client.post(f"/api/jobs/{job}/pause").json()["state"] == "paused"
    check_that_an_export_waits(server, job)
    pid = _pid(library, job)
    server.kill()

    server = served(program=program)
    assert server.get(f"jobs/{job}")["state"] == "paused" and _pid(library, job) == pid
    assert server.client.get("/api/runs/box/live/state").status_code in (200, 204)
    assert server.client.post(f"/api/jobs/{job}/resume").json()["state"] == "running"
    os.kill(pid, signal.SIGKILL)
    server.kill()
    goes_on.touch()

    server = served(program=program)
    lost = server.get(f"jobs/{job}")
    assert lost["state"] == "interrupted" and lost["resumable"], lost
    for kind in ("captures", "runs"):
        assert server.client.post(f"/api/{kind}/box/rename", json={"to": "egg"}).status_code == 200
    lost = server.get(f"jobs/{job}")
    assert (lost["subject"], lost["title"]) == ("runs/egg", "training of egg")
    assert server.client.post(f"/api/jobs/{job}/resume").status_code == 200
    done = server.reached(job, "done")
    assert done["attempts"] == 2 and done["command"].endswith("--resume")
    run = library / "runs" / "egg"
    assert done["argv"][1:4] == [str(library / "captures" / "egg"), "--out", str(run)]
    # the job did not start again at the old place
    assert [path.name for path in run.parent.iterdir()] == ["egg"]
    export = server.start(command="convert", subject="runs/egg", format="spz")
    found = server.reached(export, "done")
    assert server.client.post("/api/runs/egg/rename", json={"to": "box"}).status_code == 200
    (written,) = server.get("runs/box/exports")["exports"]
    assert written["psnr"] > 30 and written["command"] == found["command"].replace("runs/egg", "runs/box")
    downloaded = server.client.get(f"/api/runs/box/exports/{written['file']}").content
    run = library / "runs" / "box"

    server.process.send_signal(signal.SIGINT)
    assert server.process.wait(PATIENCE) in (0, 130, -signal.SIGINT)
    assert server.process.stdout.read() == "ended\n"
    server.kill()
    check_the_bytes(folder, downloaded, run, tmp_path)


def check_the_bytes(folder, downloaded, run, tmp_path):
    """Check that an export and a run have the bytes that the commands give without a disturbance."""
    numbers = ["--iterations", "400", "--save-every", "50", "--seed", "3"]
    code = "import sys; from gsplat_edu.cli.main import main; sys.exit(main(sys.argv[1:]))"
    for words in (
        ["train", folder, "--out", tmp_path / "whole", *numbers],
        ["convert", tmp_path / "whole", tmp_path / "box.spz"],
    ):
        assert Program(code, words, tmp_path).ended()[0] == 0
    assert downloaded == (tmp_path / "box.spz").read_bytes()
    scene = Path("point_cloud") / "iteration_400" / "point_cloud.ply"
    assert (run / scene).read_bytes() == (tmp_path / "whole" / scene).read_bytes()


def raw(server, request, wait=5.0):
    """Send bytes; return the answer until the connection is closed, or nothing more comes for some seconds."""
    with socket.create_connection(("127.0.0.1", server.port), timeout=PATIENCE) as connection:
        with contextlib.suppress(BrokenPipeError, ConnectionResetError):  # it may answer before all was sent
            connection.sendall(request)
        found = b""
        with contextlib.suppress(TimeoutError, ConnectionResetError):
            while piece := connection.recv(65536):
                found += piece
                connection.settimeout(wait)
        return found


def check_refusals(server):
    """Check that requests of other pages, and requests that cost too much, are refused."""
    head = f"Host: 127.0.0.1:{server.port}\r\nAuthorization: Bearer {server.token}\r\n"
    huge = f"PUT /api/photos/a/files/a.jpg HTTP/1.1\r\n{head}Content-Length: 10737418240\r\n\r\n"
    answer = raw(server, huge.encode() + bytes(1000))
    assert answer.startswith(b"HTTP/1.1 413 ") and b"one file may have" in answer  # the connection is closed
    assert raw(server, b"GET / HTTP/1.1\r\n" + b"X: y\r\n" * 20_000 + b"\r\n").startswith(b"HTTP/1.1 4")
    assert raw(server, b"\x16\x03\x01nonsense\r\n\r\n").startswith(b"HTTP/1.1 400")
    foreign = f"GET /api/library HTTP/1.1\r\n{head}Origin: http://evil.example\r\n\r\n"
    assert raw(server, foreign.encode()).startswith(b"HTTP/1.1 403")
    rebound = f"GET /?token={server.token} HTTP/1.1\r\nHost: evil.example:{server.port}\r\n\r\n"
    assert raw(server, rebound.encode()).startswith(b"HTTP/1.1 403")
    twice = f"GET /api/library HTTP/1.1\r\n{head}Host: evil.example\r\n\r\n"
    assert raw(server, twice.encode()).startswith(b"HTTP/1.1 4")
    # a browser that is refused while it sends gets the answer, too
    text = f"PUT /api/photos/a/files/a.txt HTTP/1.1\r\n{head}Content-Length: 300000\r\n\r\n"
    with socket.create_connection(("127.0.0.1", server.port), timeout=PATIENCE) as connection:
        connection.sendall(text.encode() + bytes(300_000))
        answer = b"".join(iter(lambda: connection.recv(65536), b""))
        assert b"neither a photo nor a video" in answer
    # an interrupted upload leaves no files, as the caller checks
    cut = f"PUT /api/photos/a/files/a.jpg HTTP/1.1\r\n{head}Content-Length: 1000\r\n\r\n"
    with socket.create_connection(("127.0.0.1", server.port)) as connection:
        connection.sendall(cut.encode() + bytes(500))


def test_a_server_under_attack_answers_its_page_and_works_on(served, tmp_path):
    server = served()
    half_open = [socket.create_connection(("127.0.0.1", server.port)) for _ in range(100)]
    for number, connection in enumerate(half_open):
        connection.sendall(b"GET / HTTP/1.1\r\nHost: "[: number % 20])
    check_refusals(server)
    lists = []
    threads = [threading.Thread(target=lambda: lists.append(server.get("library"))) for _ in range(50)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(lists) == 50 and all(found["photos"] == [] for found in lists)
    until(lambda: not list((tmp_path / "library" / ".studio" / "uploads").iterdir()))

    # events arrive in the meantime, and again after a pause
    (tmp_path / "library" / "captures" / "none").mkdir()
    with server.client.stream("GET", "/api/events") as stream:
        lines = stream.iter_lines()
        ids = [next(line for line in lines if line.startswith("id: "))]
        job = server.start(command="doctor", subject="captures/none")
        ids += [next(line for line in lines if line.startswith("id: ")) for _ in range(2)]
    with server.client.stream("GET", "/api/events", headers={"Last-Event-ID": ids[1][4:]}) as stream:
        assert next(line for line in stream.iter_lines() if line.startswith("id: ")) == ids[2]
    server.client.post(f"/api/jobs/{job}/cancel")

    words = [
        sys.executable,
        "-m",
        "gsplat_edu",
        "studio",
        str(tmp_path / "library"),
        "--port",
        "0",
        "--no-open",
    ]
    second = subprocess.run(words, capture_output=True, text=True, check=False)
    assert second.returncode == 2 and "is in use by" in second.stderr and second.stderr.count("\n") == 1
    # half-open connections are closed by now, or will be soon
    half_open[0].settimeout(REQUEST_SECONDS + PATIENCE)
    assert half_open[0].recv(1) == b""
    for connection in half_open:
        connection.close()


def test_the_server_imports_no_torch():
    code = (
        "import sys; import gsplat_edu.studio.server, gsplat_edu.cli.studio, gsplat_edu.options.studio;"
        "import gsplat_edu.data.images; print(sorted({'torch', 'scipy', 'matplotlib'} & set(sys.modules)))"
    )
    assert (
        subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
        == "[]\n"
    )
