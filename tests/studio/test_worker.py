"""The worker process answers a line by a line, and is replaced if it ends."""

import subprocess
import threading

import pytest

from gsplat_edu.server.refusal import RefusedError
from gsplat_edu.studio import workers
from gsplat_edu.studio.worker import answer
from gsplat_edu.studio.workers import Worker
from waiting import PATIENCE, until

HANGS = ("sleep", "100")
"""A worker that never answers."""

COUNTS = """
number=0
while read -r request; do
    touch "$0.begun"
    until [ -e "$0" ]; do sleep 0.02; done
    number=$((number + 1))
    echo "{\\"error\\": \\"$number\\"}"
done
"""
"""A worker, for the shell, that answers with the number of the request once there is a file."""


@pytest.mark.own_process
def test_a_worker_answers_and_is_replaced():
    worker = Worker()
    for _ in range(2):
        with pytest.raises(RefusedError, match="^KeyError: 'nothing'$"):
            worker.ask("nothing")
        worker.process.kill()
        worker.process.wait()
    worker.close()


@pytest.mark.own_process
def test_a_worker_that_hangs_is_killed():
    worker = Worker(command=HANGS, patience=0.2)
    with pytest.raises(RefusedError, match="ended or took too long"):
        worker.ask("page")
    assert worker.process is None


@pytest.mark.own_process
def test_the_number_of_waiting_requests_is_limited():
    worker = Worker(waiting=1, command=HANGS)
    thread, said = asking(worker)
    until(lambda: worker.process is not None)
    with pytest.raises(RefusedError, match="too many requests"):
        worker.ask("page")
    worker.close()
    thread.join()
    assert "took too long" in said[0]


@pytest.mark.own_process
def test_equal_requests_that_wait_share_an_answer(tmp_path):
    """As those of a page that is opened again and again while an earlier question is measured."""
    worker = Worker(command=("sh", "-c", COUNTS, str(tmp_path / "gate")))
    first = asking(worker)
    until((tmp_path / "gate.begun").exists)
    later = [asking(worker) for _ in range(3)]
    until(lambda: worker.asked == 4)
    (tmp_path / "gate").touch()
    for thread, _ in (first, *later):
        thread.join(PATIENCE)
    worker.close()
    assert [said for _, said in (first, *later)] == [["1"], ["2"], ["2"], ["2"]]


@pytest.mark.own_process
def test_closing_ends_a_process_that_a_request_is_just_starting(monkeypatch):
    begins, goes_on = threading.Event(), threading.Event()
    start = subprocess.Popen

    def slow(*words, **options):
        begins.set()
        assert goes_on.wait(PATIENCE)
        return start(*words, **options)

    monkeypatch.setattr(workers.subprocess, "Popen", slow)
    worker = Worker(command=HANGS)
    thread, said = asking(worker)
    assert begins.wait(PATIENCE)
    closing = threading.Thread(target=worker.close)
    closing.start()
    until(lambda: worker.closed)
    goes_on.set()
    for one in (closing, thread):
        one.join(PATIENCE)
        assert not one.is_alive()
    assert "took too long" in said[0] and worker.process is None


def asking(worker):
    """Start a request in a thread; return the thread and the list that gets the refusal."""
    said = []

    def ask():
        with pytest.raises(RefusedError) as caught:
            worker.ask("page")
        said.append(str(caught.value))

    thread = threading.Thread(target=ask)
    thread.start()
    return thread, said


@pytest.mark.parametrize(
    "request_",
    [
        *(b"", b"[]", b"{}", b'{"task": "page"}'),
        b'{"task": "page", "source": "/none", "title": "", "out": ""}',
    ],
)
def test_a_failure_is_one_line(request_):
    (line,) = answer(request_).values()
    assert isinstance(line, str) and line and "\n" not in line
