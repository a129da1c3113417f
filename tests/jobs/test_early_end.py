"""A job that is cancelled while its process still imports ends at once, as cancelled and without a traceback."""

import signal
import sys

import pytest

from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.data.procedural import procedural_capture
from gsplat_edu.data.writers import write_colmap
from gsplat_edu.jobs.process import send
from gsplat_edu.jobs.queue import JobQueue
from gsplat_edu.jobs.record import Rendered, State, Work
from waiting import until

pytestmark = [
    pytest.mark.slow,
    pytest.mark.own_process,
    pytest.mark.skipif(sys.platform == "win32", reason="no jobs run on Windows"),
]

NEVER = {"interrupt": 3600.0, "terminate": 3600.0}
"""The first signal has to suffice: a second one would come after the test."""

WAITS = """
import runpy, signal, sys
from pathlib import Path

class Waits:
    def find_spec(self, name, path, target=None):
        if name != {module!r}:
            return
        Path({mark!r}).touch()
        try:
            while True:
                signal.pause()
        except BaseException:  # as modules do that try whether something can be imported
            if not {catches}:
                raise

sys.meta_path.insert(0, Waits())
runpy.run_module("gsplat_edu", run_name="__main__", alter_sys=True)
"""
"""The command line, which waits for a signal in the import of one of its modules."""


@pytest.fixture(params=[signal.default_int_handler, signal.SIG_IGN], ids=["terminal", "background"])
def interrupts(request):
    """SIGINT as a server in a terminal has it, and as one that a shell started in its background."""
    before = signal.signal(signal.SIGINT, request.param)
    yield
    signal.signal(signal.SIGINT, before)


def render(work, purpose):
    if work.command != "doctor":
        raise ArgumentError("command: has to be doctor")
    return Rendered(work, (work.command, *work.inputs, "--no-forecast"))


@pytest.mark.parametrize(
    ("module", "catches", "line"),
    [
        ("gsplat_edu.cli.main", False, "it was ended"),
        ("gsplat_edu.options.doctor", True, "gsplat-edu: interrupted"),
        ("gsplat_edu.cli.doctor", False, "interrupted"),
        ("gsplat_edu.cli.doctor", True, "interrupted"),
    ],
)
def test_a_job_cancelled_during_an_import_ends_at_once(tmp_path, interrupts, module, catches, line):
    write_colmap(tmp_path / "capture", *procedural_capture(32, 6, splats=50))
    mark = tmp_path / "imports"
    program = (sys.executable, "-c", WAITS.format(module=module, mark=str(mark), catches=catches))
    queue = JobQueue(tmp_path / "jobs", render, program=program, patience=NEVER)
    job = queue.submit(Work("doctor", (str(tmp_path / "capture"),), (), {}))
    try:
        until(mark.exists)
        queue.cancel(job.id)
        until(lambda: queue.get(job.id).state is not State.RUNNING)
        ended = queue.get(job.id)
        assert (ended.state, ended.line) == (State.CANCELLED, line)
        printed = queue.files(job.id).output.read_text()
        assert "Traceback" not in printed and "cameras" not in printed, "the command did not begin"
    finally:
        if (pid := queue.get(job.id).pid) is not None:
            send(pid, queue.get(job.id).identity, signal.SIGKILL, group=True)
        queue.close()
