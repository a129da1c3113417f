"""The worker process answers a line by a line, and is replaced if it ends."""

import threading
import time

import pytest

from gsplat_edu.studio import workers
from gsplat_edu.studio.refusal import RefusedError
from gsplat_edu.studio.worker import answer
from gsplat_edu.studio.workers import Worker


@pytest.mark.own_process
def test_a_worker_answers_and_is_replaced():
    worker = Worker()
    for _ in range(2):
        with pytest.raises(RefusedError, match="^KeyError: 'nothing'$"):
            worker.ask("nothing")
        worker._process.kill()
        worker._process.wait()
    worker.close()


@pytest.mark.own_process
def test_a_worker_that_hangs_is_killed(monkeypatch):
    monkeypatch.setattr(workers, "COMMAND", ("sleep", "100"))
    monkeypatch.setattr(workers, "PATIENCE", 0.2)
    worker = Worker()
    with pytest.raises(RefusedError, match="ended or took too long"):
        worker.ask("page")
    assert worker._process is None


@pytest.mark.own_process
def test_the_number_of_waiting_requests_is_limited(monkeypatch):
    monkeypatch.setattr(workers, "COMMAND", ("sleep", "100"))
    monkeypatch.setattr(workers, "PATIENCE", 0.5)
    monkeypatch.setattr(workers, "MOST_WAITING", 1)
    worker = Worker()
    said = []

    def ask():
        with pytest.raises(RefusedError) as caught:
            worker.ask("page")
        said.append(str(caught.value))

    thread = threading.Thread(target=ask)
    thread.start()
    time.sleep(0.1)
    ask()
    thread.join()
    assert "too many requests" in said[0] and "took too long" in said[1]


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
