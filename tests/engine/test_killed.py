"""A training on the adapter whose process is killed, or whose device is lost, ends with an undisturbed one's bytes.

wgpu ends the process if a submission fails because of a device that was lost just then; a run is resumed after that as
after any kill. The processes here use the adapter as it is, without the limits of the other tests.
"""

import os
import signal
import subprocess
import sys

import pytest

from gsplat_edu.data.procedural import procedural_capture
from gsplat_edu.data.writers import write_colmap

pytestmark = pytest.mark.own_process

RUN = (
    "--backend",
    "webgpu",
    "--iterations",
    "12",
    "--save-every",
    "4",
    "--eval-every",
    "0",
    "--max-gaussians",
    "120",
)
RUN += ("--set", "densify_start=2", "densify_every=3")

BEGIN = """
import os, sys, warnings
from gsplat_edu.runs.training import CaptureRun
from gsplat_edu.render.webgpu import render as webgpu
save, done = CaptureRun.save, []
def disturbed(self):
    path = save(self)
    if self.trainer.iteration >= 8 and not done:
        done.append(1)
        disturb(self)
    return path
CaptureRun.save = disturbed
"""

END = """
from gsplat_edu.cli.main import main
sys.exit(main(sys.argv[1:]))
"""

KILLED = "def disturb(run): os.kill(os.getpid(), 9)"

LOST = "def disturb(run): webgpu.device().device.destroy()"

ABORTED = """
def disturb(run):
    device = webgpu.device().device
    submit = device.queue.submit
    def lost(buffers):
        device.destroy()
        submit(buffers)
    device.queue.submit = lost
"""
"""Lose the device after a submission was recorded and before it is made."""


@pytest.fixture(scope="module")
def capture(device, tmp_path_factory):
    folder = tmp_path_factory.mktemp("capture")
    write_colmap(folder, *procedural_capture(40, 6, splats=80))
    return folder


def train(capture, out, *words, disturb=""):
    """Train in a process; return what it did."""
    code = BEGIN + disturb + END if disturb else f"import sys{END}"
    command = [sys.executable, "-c", code, "train", str(capture), "--out", str(out), *RUN, *words]
    return subprocess.run(command, check=False, capture_output=True, text=True)


def results(out):
    """Return the bytes of the scene, and of the last checkpoint without its clock."""
    from gsplat_edu.train.checkpoint import list_checkpoints, read_checkpoint

    tensors, numbers = read_checkpoint(list_checkpoints(out / "checkpoints")[-1])
    (scene,) = out.glob("point_cloud/*/*.ply")
    return scene.read_bytes(), {name: tensor.numpy().tobytes() for name, tensor in tensors.items()}, numbers


@pytest.fixture(scope="module")
def whole(capture, tmp_path_factory):
    out = tmp_path_factory.mktemp("whole") / "run"
    done = train(capture, out)
    assert done.returncode == 0, done.stderr
    return results(out)


@pytest.mark.slow
@pytest.mark.skipif(os.name == "nt", reason="Windows has no SIGKILL")
@pytest.mark.parametrize("disturb", [KILLED, ABORTED], ids=["killed", "aborted"])
def test_a_process_that_ends_in_the_middle_is_resumed(capture, whole, tmp_path, disturb):
    code = -signal.SIGKILL if disturb == KILLED else -signal.SIGABRT
    done = train(capture, tmp_path / "run", disturb=disturb)
    assert done.returncode == code, done.stderr
    assert not list(tmp_path.glob("run/point_cloud/*")) and list(tmp_path.glob("run/checkpoints/*"))
    done = train(capture, tmp_path / "run", "--resume")
    assert done.returncode == 0, done.stderr
    assert "resuming after 8 iterations" in done.stdout + done.stderr
    assert results(tmp_path / "run") == whole


@pytest.mark.slow
def test_a_run_whose_device_is_lost_says_so_and_goes_on(capture, whole, tmp_path):
    done = train(capture, tmp_path / "run", disturb=LOST)
    assert done.returncode == 0, done.stderr
    (line,) = [line for line in done.stderr.splitlines() if "was lost" in line]
    assert "on a new device" in line and "Traceback" not in done.stderr and "DEVICE LOST" not in done.stderr
    assert results(tmp_path / "run") == whole
