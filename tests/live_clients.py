"""Helpers for tests of the live view: trainings with a live view, and a client of its server."""

import http.client
import json
import threading
import urllib.parse
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from gsplat_edu.budget.plan import Limits, plan
from gsplat_edu.cli.main import build_parser
from gsplat_edu.options.train import options_from
from gsplat_edu.runs.training import CaptureRun
from gsplat_edu.viewer import page_data
from gsplat_edu.viewer.live import LiveView
from gsplat_edu.viewer.snapshots import Broadcast
from waiting import PATIENCE, until

GROWING = ["--max-gaussians", "600", "--set", "densify_start=5", "densify_every=10"]
STRATEGIES = {
    "adc": [
        "--strategy",
        "adc",
        "--set",
        "densify_stop=150",
        "--set",
        "grad_threshold=1e-4",
        "--set",
        "reset_every=60",
    ],
    "mcmc": ["--strategy", "mcmc", "--set", "mcmc_stop=150"],
    "fast": ["--set", "fast_full_size=150", "fast_start_factor=1.5"],
}


def made_run(capture, out, *words):
    """Make a run from options of the command line."""
    words = ["train", str(capture), "--out", str(out), "--seed", "3", *GROWING, *words]
    return CaptureRun(plan(options_from(build_parser(["train"]).parse_args(words)), Limits()).options)


class CountedView(LiveView):
    """A live view that notes each time when the training asks whether it has to wait."""

    def __init__(self, *arguments, **options):
        super().__init__(*arguments, **options)
        self.asked = []

    def holds(self, iteration):
        self.asked.append(iteration)
        return super().holds(iteration)


class Training:
    """A training in its own thread, with its live view."""

    def __init__(self, capture, out, *words, grace=PATIENCE, **waits):
        """Other programs may keep a client from its next request for seconds, so the view is patient."""
        self.run = made_run(capture, out, *words)
        self.stopped = threading.Event()
        self.view = CountedView(self.run, port=0, grace=grace, **waits)
        self.broadcast = Broadcast(self.run, self.stopped.is_set, [self.view])
        self.failure = None
        self.thread = threading.Thread(target=self._train)

    def _train(self):
        try:
            self.run.train(self.stopped.is_set, [self.broadcast.show])
        except BaseException as error:
            self.failure = error

    @property
    def iteration(self):
        return self.run.trainer.iteration

    def ended(self):
        """Wait for the training to end, and check that it ended without an error."""
        self.thread.join(PATIENCE)
        assert not self.thread.is_alive() and self.failure is None, self.failure


@contextmanager
def training(capture, out, *words, pressed=None, **waits):
    """Train with a live view until the end of the block; a button may be pressed before the first iteration."""
    made = Training(capture, out, *words, **waits)
    with made.view:
        assert pressed is None or Client(made.view.url).control(pressed) == 204
        made.thread.start()
        try:
            yield made
        finally:
            made.stopped.set()
            made.thread.join(PATIENCE)
        made.ended()


class Client:
    """Sends the requests of a page, without a browser."""

    def __init__(self, url):
        parts = urllib.parse.urlsplit(url)
        self.host, self.port = parts.hostname, parts.port
        self.token = urllib.parse.parse_qs(parts.query)["token"][0]
        self.own = {
            "Cookie": f"gsplat_edu_{self.port}={self.token}",
            "Origin": f"http://{self.host}:{self.port}",
        }

    def ask(self, method, path, body=None, headers=None):
        """Return status, headers and body of a request, which has the page's headers unless others are given."""
        connection = http.client.HTTPConnection(self.host, self.port, timeout=PATIENCE)
        try:
            connection.request(method, path, body, self.own if headers is None else headers)
            answer = connection.getresponse()
            return answer.status, answer.headers, answer.read()
        finally:
            connection.close()

    def state(self, after=-1):
        """Return the next state whose version is not `after`."""
        answer = until(lambda: (a := self.ask("GET", f"/state?after={after}"))[0] == 200 and a, "a state")
        return json.loads(answer[2])

    def states(self, **wanted):
        """Return the next state with these values."""
        state = self.state()
        while any(state[name] != value for name, value in wanted.items()):
            state = self.state(state["version"])
        return state

    def scene(self, after=-1):
        """Return header and Gaussians of the next scene whose iteration is not `after`."""
        answer = until(lambda: (a := self.ask("GET", f"/scene?after={after}"))[0] == 200 and a, "a scene")
        return unframed(answer[2])

    def control(self, what):
        """Press a button; return the status."""
        return self.ask("POST", "/control", json.dumps({"do": what}))[0]


def is_closed(connection, more):
    """Send more of a request; return whether the server has closed the connection."""
    try:
        connection.sendall(more)
    except (BrokenPipeError, ConnectionResetError):
        return True
    return False


def unframed(data):
    """Return header and Gaussians of the bytes of scene.bin, read by its specification."""
    length = int.from_bytes(data[:4], "little")
    assert length % 4 == 0
    header = json.loads(data[4 : 4 + length])
    assert (header["format"], header["version"]) == ("gsplat-edu snapshot", 1)
    return header, page_data.unpacked(
        Path("scene.bin"), data[4 + length :], header["count"], header["sh_degree"]
    )


def camera_json(camera):
    """Return a camera in the form that the page sends."""
    numbers = {name: getattr(camera, name) for name in ("fx", "fy", "cx", "cy", "H", "W")}
    return json.dumps({"R": np.asarray(camera.R).tolist(), "eye": np.asarray(camera.eye).tolist(), **numbers})
