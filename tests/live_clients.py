"""Helpers for tests of the live view: trainings that have one, and a client of its WebSocket."""

import io
import re
import threading
import time
from contextlib import contextmanager

import msgspec
import numpy as np
import viser
import websockets.sync.client
import zstandard
from PIL import Image

from gsplat_edu.budget.plan import Limits, plan
from gsplat_edu.cli.main import build_parser
from gsplat_edu.cli.options.train import options_from
from gsplat_edu.runs.training import CaptureRun
from gsplat_edu.viewer.live import LiveView

PATIENCE = 180.0
"""Seconds after which a wait fails."""

LEVEL = (1.0, 0.0, 0.0, 0.0)
CANVAS = (120, 80)
POSE = {"wxyz": LEVEL, "position": (0.1, -0.05, -3.0), "fov": 0.8, "image_width": 120, "image_height": 80}
GROWING = ["--max-gaussians", "600", "--densify-start", "5", "--densify-every", "10"]
STRATEGIES = {
    "adc": ["--strategy", "adc", "--densify-stop", "150", "--grad-threshold", "1e-4", "--reset-every", "60"],
    "mcmc": ["--strategy", "mcmc", "--mcmc-stop", "150"],
    "fast": ["--fast-full-size", "150", "--fast-start-factor", "1.5"],
}


def until(true, what):
    """Wait until a function returns something true, and return that."""
    deadline = time.monotonic() + PATIENCE
    while not (found := true()):
        assert time.monotonic() < deadline, f"timed out waiting for: {what}"
        time.sleep(0.01)
    return found


class Training:
    """A training in its own thread, with its live view."""

    def __init__(self, capture, out, *words):
        parsed = build_parser(["train"]).parse_args(["train", str(capture), "--out", str(out), *words])
        self.run = CaptureRun(plan(options_from(parsed), Limits()).options)
        self.stopped = threading.Event()
        self.view = LiveView(self.run, self.stopped.is_set, port=0)
        self.failure = None
        self.thread = threading.Thread(target=self._train)

    def _train(self):
        try:
            self.run.train(self.stopped.is_set, [self.view.show])
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
def training(capture, out, *words):
    made = Training(capture, out, "--seed", "3", *GROWING, *words)
    with made.view:
        made.thread.start()
        try:
            yield made
        finally:
            made.stopped.set()
            made.thread.join(PATIENCE)
        made.ended()


OWN = object()
"""The origin of the view's own page."""


class Client:
    """The part of viser's browser client that these tests need: a WebSocket that carries MessagePack."""

    def __init__(self, view, origin=OWN, url=None, **headers):
        self.socket = websockets.sync.client.connect(
            (url or view.url).replace("http", "ws", 1),
            subprotocols=[f"viser-v{viser.__version__}"],
            origin=view.url.partition("/?")[0] if origin is OWN else origin,
            additional_headers=headers,
            compression=None,
            max_size=None,
            open_timeout=PATIENCE,
        )
        self.buttons, self.text, self.shared = {}, "", []
        self.pictures = []
        self.lists, self.moved = {}, {}

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.socket.close()

    def send(self, kind, **fields):
        self.socket.send(msgspec.msgpack.encode({"type": kind, **fields}))

    def move(self, **changes):
        ignored = {"near": 0.01, "far": 1000.0, "look_at": (0.0, 0.0, 0.0), "up_direction": (0.0, -1.0, 0.0)}
        self.send("ViewerCameraMessage", **{**POSE, **ignored, **changes})

    def press(self, label):
        until(lambda: label in self.listened().buttons, label)
        self.send("GuiUpdateMessage", uuid=self.buttons[label], updates={"value": True})

    def options(self, label):
        """Return the options of a dropdown list."""
        return until(lambda: self.listened().lists.get(label), label)[1]

    def choose(self, label, option):
        assert option in self.options(label)
        self.send("GuiUpdateMessage", uuid=self.lists[label][0], updates={"value": option})

    def listened(self):
        """Read all messages that have arrived so far."""
        while True:
            try:
                data = self.socket.recv(timeout=0.01)
            except TimeoutError:
                return self
            size = int.from_bytes(data[8:16], "little")
            for message in msgspec.msgpack.decode(zstandard.decompress(data[16 : 16 + size]))["messages"]:
                self._note(message)

    def _note(self, message):
        if message["type"] == "BackgroundImageMessage" and message["rgb_data"] is not None:
            self.pictures.append(np.asarray(Image.open(io.BytesIO(message["rgb_data"]))))
        elif message["type"] == "GuiButtonMessage":
            self.buttons[message["props"]["label"]] = message["uuid"]
        elif message["type"] == "GuiUpdateMessage":
            self.text = message["updates"].get("_markdown", self.text)
            label = message["updates"].get("label")
            if label is not None:
                self.buttons = {name: uuid for name, uuid in self.buttons.items() if uuid != message["uuid"]}
                self.buttons[label] = message["uuid"]
        elif message["type"] == "GuiDropdownMessage":
            self.lists[message["props"]["label"]] = (message["uuid"], list(message["props"]["options"]))
        elif message["type"].startswith("SetCamera") and not message.get("initial"):
            self.moved[message["type"]] = message
        elif message["type"].startswith("ShareUrl"):
            self.shared.append(message)

    def picture(self, width=None):
        """Return the next picture, or the next one of a given width."""
        self.pictures.clear()
        return until(
            lambda: [p for p in self.listened().pictures if width in (None, p.shape[1])], "a picture"
        )[-1]

    def paused_at(self):
        """Wait until the training is paused, and return its iteration."""
        return self.says(r"\*\*paused\*\*\s+iteration ([\d,]+) of")

    def says(self, pattern):
        found = until(lambda: re.search(pattern, self.listened().text), pattern)
        return int(found[1].replace(",", "")) if found.groups() else found
