"""The queue runs processes: small programs that write events as commands do."""

import itertools
import json
import os
import shutil
import signal
import subprocess
import sys
import threading
from pathlib import Path

import numpy as np
import pytest

from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.jobs.process import carries, identity, is_running, send
from gsplat_edu.jobs.queue import MOST_QUEUED, JobQueue
from gsplat_edu.jobs.record import Job, JobFolder, Rendered, State, Work, collision
from waiting import HERE, until

PROGRAM = (
    f"import sys; sys.path.append({HERE!r})"
    + """
import json, os, signal
from waiting import until  # not later: Python drops what a signal's handler raises at some moments of an import
file = os.open(os.environ["GSPLAT_EDU_EVENTS"], os.O_WRONLY | os.O_APPEND | os.O_CREAT)
def emit(event, **fields):  # a signal may come while it writes, and a file object does not let its handler write then
    os.write(file, (json.dumps({"event": event, "time": 0, **fields}) + "\\n").encode())
def stop(number, frame):
    if "stubborn" not in sys.argv:
        emit("interrupted", line="interrupted after a checkpoint")
        sys.exit(130)
signal.signal(signal.SIGINT, stop)
if "stubborn" in sys.argv:
    signal.signal(signal.SIGTERM, stop)
emit("started", pid=os.getpid(), identity="")
open(sys.argv[2] + ".ran", "a").write(sys.argv[2] + "\\n")
emit("stage", name="work")
print("printed", flush=True)
if "fails" in sys.argv:
    emit("failed", line="it failed", code=2)
    sys.exit(2)
if "crashes" in sys.argv:
    print("Traceback and all", file=sys.stderr)
    sys.exit(1)
if "waits" in sys.argv:
    until(lambda: emit("progress", stage="work", done=1) or os.path.exists(sys.argv[2]))
emit("finished", outputs=[sys.argv[2]])
"""
)


def asked(*words, reads=(), writes=()):
    """Return work whose command line is given."""
    return Work(words[0], tuple(reads), tuple(writes), {"words": list(words[1:])})


def render(work, purpose):
    words = work.options.get("words")
    if not isinstance(words, list) or "refused" in words:
        raise ArgumentError("words: are not allowed")
    return Rendered(work, (work.command, *words))


@pytest.fixture
def opened(tmp_path):
    """Return a function that opens queues on one folder; at the end they are closed and their processes are killed."""
    made = []

    def open_queue(**options):
        given = {"render": render, "program": (sys.executable, "-S", "-c", PROGRAM)} | options
        made.append(JobQueue(tmp_path / "jobs", **given))
        return made[-1]

    yield open_queue
    for queue in made:
        for job in queue.jobs():
            if job.pid is not None:
                send(job.pid, job.identity, signal.SIGKILL, group=True)
        queue.close()


def reached(queue, name, *states):
    until(lambda: queue.get(name).state in states)
    return queue.get(name)


def abandon(queue):
    """Abandon a queue as kill -9 would: it writes nothing more, and its processes keep running."""
    queue.close(interrupt=False)


def test_jobs_run_one_after_the_other_and_their_results_are_kept(opened, tmp_path):
    changes = []
    queue = opened(changed=lambda name, job: changes.append((name, job and job.state)))
    first = queue.submit(asked("run", str(tmp_path / "a"), "waits"))
    second = queue.submit(asked("run", str(tmp_path / "b")))
    third = queue.submit(asked("run", str(tmp_path / "c"), "fails"))
    fourth = queue.submit(asked("run", str(tmp_path / "d"), "crashes"))
    reached(queue, first.id, State.RUNNING)
    assert {queue.get(job.id).state for job in (second, third, fourth)} == {State.QUEUED}
    (tmp_path / "a").touch()
    done = reached(queue, first.id, State.DONE)
    assert done.ended >= done.started >= done.created
    assert reached(queue, second.id, State.DONE).line == ""
    assert reached(queue, third.id, State.FAILED).line == "it failed"
    assert reached(queue, fourth.id, State.FAILED).line == "Traceback and all"
    assert "printed" in queue.files(first.id).output.read_text()
    assert [state for name, state in changes if name == first.id] == ["queued", "running", "running", "done"]
    queue.remove(first.id)
    assert changes[-1] == (first.id, None) and not (queue.folder / first.id).exists()
    with pytest.raises(ArgumentError, match="does not exist"):
        queue.get(first.id)


def test_two_jobs_run_at_once_if_the_queue_allows_it(opened, tmp_path):
    queue = opened(at_once=2)
    jobs = [queue.submit(asked("run", str(tmp_path / name), "waits")) for name in "abc"]
    for job in jobs[:2]:
        reached(queue, job.id, State.RUNNING)
    assert queue.get(jobs[2].id).state is State.QUEUED


def test_cancel_interrupts_and_resume_runs_again(opened, tmp_path):
    queue = opened()
    job = queue.submit(asked("run", str(tmp_path / "a"), "waits"))
    waiting = queue.submit(asked("run", str(tmp_path / "b")))
    assert queue.cancel(waiting.id).state is State.CANCELLED
    until(lambda: (tmp_path / "a.ran").exists() and (tmp_path / "a.ran").read_text())
    queue.cancel(job.id)
    ended = reached(queue, job.id, State.CANCELLED)
    assert ended.line == "interrupted after a checkpoint" and ended.resumable
    with pytest.raises(ArgumentError, match="is cancelled"):
        queue.cancel(job.id)
    (tmp_path / "a").touch()
    queue.resume(job.id)
    done = reached(queue, job.id, State.DONE)
    assert done.attempts == 2 and (tmp_path / "a.ran").read_text().count("\n") == 2
    with pytest.raises(ArgumentError, match="cannot be resumed"):
        queue.resume(job.id)
    assert not (tmp_path / "b.ran").exists()


def test_a_process_that_ends_without_a_word_does_not_get_that_of_an_earlier_one(opened, tmp_path):
    queue = opened(at_once=0)
    job = queue.submit(asked("run", str(tmp_path / "a"), "crashes"))
    said = {"event": "failed", "time": 0, "line": "said by an earlier process", "code": 2}
    queue.files(job.id).events.write_text(json.dumps(said) + "\n")
    queue.at_once = 1
    assert reached(queue, job.id, State.FAILED).line == "Traceback and all"


def test_a_job_that_ignores_its_interrupt_is_killed(opened, tmp_path):
    queue = opened(patience={"interrupt": 0.2, "terminate": 0.2})
    job = queue.submit(asked("run", str(tmp_path / "a"), "waits", "stubborn"))
    until((tmp_path / "a.ran").exists)
    queue.cancel(job.id)
    assert reached(queue, job.id, State.CANCELLED).line == "it was ended"


def test_a_paused_job_makes_no_progress(opened, tmp_path):
    queue = opened()
    job = queue.submit(asked("run", str(tmp_path / "a"), "waits"))
    with pytest.raises(ArgumentError):
        queue.pause("000099")
    until((tmp_path / "a.ran").exists)
    assert queue.pause(job.id).state is State.PAUSED
    events = queue.files(job.id).events
    until(lambda: _is_stopped(queue.get(job.id).pid))
    size = events.stat().st_size
    with pytest.raises(ArgumentError, match="is paused"):
        queue.pause(job.id)
    queue.resume(job.id)
    until(lambda: events.stat().st_size > size)
    queue.pause(job.id)
    queue.cancel(job.id)  # a stopped process handles signals only once it is continued
    reached(queue, job.id, State.CANCELLED)


def _is_stopped(pid):
    return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] == "T"


def test_jobs_outlive_a_killed_queue_and_the_next_one_finds_them(opened, tmp_path):
    queue = opened()
    job = queue.submit(asked("run", str(tmp_path / "a"), "waits"))
    after = queue.submit(asked("run", str(tmp_path / "b")))
    until((tmp_path / "a.ran").exists)
    abandon(queue)
    found = opened()
    assert found.get(job.id).state is State.RUNNING and found.get(after.id).state is State.HELD
    pid = found.get(job.id).pid  # the queue forgets it once the process has ended
    (tmp_path / "a").touch()
    os.waitpid(pid, 0)  # init waits for an orphaned process
    assert reached(found, job.id, State.DONE).attempts == 1
    assert found.get(after.id).state is State.HELD and not (tmp_path / "b.ran").exists()
    found.resume(after.id)
    reached(found, after.id, State.DONE)
    assert (tmp_path / "a.ran").read_text().count("\n") == 1


def test_a_job_that_ended_without_a_queue_is_not_run_again(opened, tmp_path):
    queue = opened()
    done, killed = (queue.submit(asked("run", str(tmp_path / name), "waits")) for name in "ab")
    until((tmp_path / "a.ran").exists)
    abandon(queue)
    (tmp_path / "a").touch()
    os.waitpid(queue.get(done.id).pid, 0)
    # the record of a job that ran when the computer was switched off
    folder = JobFolder(queue.folder / killed.id)
    folder.write(
        Job(**{**vars(queue.get(killed.id)), "state": State.RUNNING, "pid": 2, "identity": "other boot"})
    )
    found = opened()
    assert found.get(done.id).state is State.DONE
    lost = found.get(killed.id)
    assert (
        lost.state is State.INTERRUPTED and lost.resumable and lost.line == "its process ended without a word"
    )
    next_one = found.submit(asked("run", str(tmp_path / "c")))  # jobs run one at a time, the oldest first
    reached(found, next_one.id, State.DONE)
    assert (tmp_path / "a.ran").read_text().count("\n") == 1 and not (tmp_path / "b.ran").exists()


def test_a_queue_killed_before_it_noted_the_process_finds_it_by_its_first_event(opened, tmp_path):
    queue = opened()
    job = queue.submit(asked("run", str(tmp_path / "a"), "waits"))
    until((tmp_path / "a.ran").exists)
    abandon(queue)
    pid = queue.get(job.id).pid
    line = {"event": "started", "time": 0, "pid": pid, "identity": identity(pid)}
    with queue.files(job.id).events.open("a") as file:
        file.write(json.dumps(line) + "\n")
    JobFolder(queue.folder / job.id).write(Job(**{**vars(queue.get(job.id)), "pid": None, "identity": ""}))
    assert opened().get(job.id).pid == pid


def test_closing_interrupts_running_jobs_and_keeps_waiting_ones(opened, tmp_path):
    queue = opened()
    job = queue.submit(asked("run", str(tmp_path / "a"), "waits"))
    waiting = queue.submit(asked("run", str(tmp_path / "b"), "waits"))
    until((tmp_path / "a.ran").exists)
    queue.close()
    assert queue.get(job.id).state is State.INTERRUPTED and queue.get(waiting.id).state is State.QUEUED
    again = opened()
    assert again.get(waiting.id).state is State.HELD
    again.resume(waiting.id)
    reached(again, waiting.id, State.RUNNING)
    assert again.get(job.id).state is State.INTERRUPTED


def test_a_full_queue_and_a_damaged_record_are_one_line(opened, tmp_path):
    queue = opened()
    queue.submit(asked("run", str(tmp_path / "a"), "waits"))
    until((tmp_path / "a.ran").exists)
    kept = [queue.submit(asked("run", str(tmp_path / "b"))) for _ in range(MOST_QUEUED)]
    with pytest.raises(ArgumentError, match=r"^jobs: 200 are waiting; cancel some"):
        queue.submit(asked("run", "d"))
    with pytest.raises(ArgumentError, match="cancel it first"):
        queue.remove(queue.jobs()[0].id)
    abandon(queue)
    queue.files(kept[0].id).record.write_text("{")
    shutil.copytree(queue.folder / kept[1].id, queue.folder / "000777")
    found = opened()
    assert len(found.damaged) == 2 and all(line.count("\n") == 0 for line in found.damaged.values())
    assert found.submit(asked("run", str(tmp_path / "e"))).id == "000778"  # ids are never reused


def test_records_on_a_full_disk_are_written_later(opened, tmp_path, monkeypatch):
    queue = opened()
    write = JobFolder.write
    full = [True]

    def failing(self, job):
        if full[0] and job.state is not State.QUEUED:
            raise OSError(28, "No space left on device", str(self.record))
        write(self, job)

    monkeypatch.setattr(JobFolder, "write", failing)
    job = queue.submit(asked("run", str(tmp_path / "a")))
    until(lambda: queue.trouble)
    assert "no space left on device" in queue.trouble and queue.get(job.id).state is State.QUEUED
    full[0] = False
    reached(queue, job.id, State.DONE)
    assert (tmp_path / "a.ran").read_text().count("\n") == 1


def test_jobs_follow_a_renamed_place(opened, tmp_path):
    place, other = tmp_path / "runs" / "a", tmp_path / "runs" / "ab"
    place.mkdir(parents=True)

    def in_place(work, purpose):
        return Rendered(work, ("run", str(tmp_path / work.outputs[0]), *work.options["words"]))

    queue = opened(render=in_place)
    job = queue.submit(Work("run", ("captures/a",), ("runs/a/x",), {"words": ["fails"]}))
    near = queue.submit(Work("run", ("runs/ab",), ("runs/ab/y",), {"words": []}))
    other.mkdir()
    reached(queue, job.id, State.FAILED)
    before = reached(queue, near.id, State.DONE)
    moved = place.with_name("b")
    queue.rename("runs/a", "runs/b", lambda: place.rename(moved))
    now = queue.get(job.id)
    assert now.work == Work("run", ("captures/a",), ("runs/b/x",), {"words": ["fails"]})
    assert now.argv == ("run", str(moved / "x"), "fails")
    assert queue.get(near.id) == before  # a place whose name has the same beginning is another place
    assert JobFolder(queue.folder / job.id).read(in_place) == now

    def refused():
        raise OSError(28, "No space left on device", str(moved))

    with pytest.raises(OSError, match="No space"):
        queue.rename("runs/b", "runs/a", refused)
    assert queue.get(job.id) == now
    queue.resume(job.id)
    reached(queue, job.id, State.FAILED)
    assert (moved / "x.ran").read_text().count("\n") == 2 and not place.exists()


@pytest.fixture
def changing():
    """Rules that a test changes: once `refused` is set, no work is allowed."""
    refused = threading.Event()
    return refused, lambda work, purpose: render(
        asked("run", "refused") if refused.is_set() else work, purpose
    )


def test_work_is_checked_again_before_its_job_is_started_again(opened, changing, tmp_path):
    refused, rules = changing
    queue = opened(render=rules)
    job = queue.submit(asked("run", str(tmp_path / "a"), "fails"))
    reached(queue, job.id, State.FAILED)
    refused.set()
    with pytest.raises(ArgumentError, match="are not allowed"):
        queue.resume(job.id)
    assert queue.get(job.id).state is State.FAILED


def test_work_is_checked_when_its_job_starts(opened, changing, tmp_path):
    refused, rules = changing
    queue = opened(at_once=0, render=rules)
    job = queue.submit(asked("run", str(tmp_path / "a")))
    refused.set()
    queue.at_once = 1
    assert reached(queue, job.id, State.FAILED).line == "words: are not allowed"
    assert queue.get(job.id).attempts == 0 and not (tmp_path / "a.ran").exists()


def started(folder, *names):
    until(lambda: all((folder / f"{name}.ran").exists() for name in names))


def test_a_writer_waits_for_readers_and_readers_for_a_writer(opened, tmp_path):
    queue = opened(at_once=4)

    def add(name, **places):
        return queue.submit(asked("run", str(tmp_path / name), "waits", **places)).id

    readers = [add(name, reads=["runs/a"], writes=[f"scenes/{name}"]) for name in ("r1", "r2")]
    started(tmp_path, "r1", "r2")  # readers run at the same time
    writer = add("w", reads=["captures/a"], writes=["runs/a"])
    late = add("r3", reads=["runs/a"])
    apart = add("o", reads=["runs/ab"], writes=["runs/a/exports/x"])
    started(tmp_path, "o")  # a job of other places overtakes them
    assert queue.get(writer).waits_for == tuple((name, "runs/a") for name in readers)
    assert queue.get(late).waits_for == ((writer, "runs/a"),)  # this reader may not overtake the writer
    (tmp_path / "r1").touch()
    until(lambda: queue.get(writer).waits_for == ((readers[1], "runs/a"),))
    assert queue.get(writer).state is queue.get(late).state is State.QUEUED
    (tmp_path / "r2").touch()
    started(tmp_path, "w")
    until(lambda: queue.get(late).waits_for == ((writer, "runs/a"),))
    assert queue.get(writer).waits_for == () and not (tmp_path / "r3.ran").exists()
    queue.pause(writer)
    assert queue.get(late).state is State.QUEUED
    queue.cancel(writer)
    started(tmp_path, "r3")
    assert queue.get(apart).state is State.RUNNING and queue.get(late).waits_for == ()


def test_a_resumed_job_waits_for_jobs_added_before_it_was_resumed(opened, tmp_path):
    queue = opened(at_once=4)
    work = {name: asked("run", str(tmp_path / name), "waits", writes=["runs/a"]) for name in "abc"}
    jobs = {name: queue.submit(work[name]).id for name in "abc"}
    started(tmp_path, "a")
    queue.cancel(jobs["b"])
    queue.resume(jobs["b"])
    (tmp_path / "a").touch()
    started(tmp_path, "c")
    until(lambda: queue.get(jobs["b"]).waits_for == ((jobs["c"], "runs/a"),))
    (tmp_path / "c").touch()
    started(tmp_path, "b")


def test_a_job_of_a_killed_queue_keeps_its_place_locked(opened, tmp_path):
    queue = opened()
    job = queue.submit(asked("run", str(tmp_path / "a"), "waits", writes=["runs/a"]))
    started(tmp_path, "a")
    abandon(queue)
    found = opened(at_once=2)
    late = found.submit(asked("run", str(tmp_path / "b"), reads=["runs/a"]))
    until(lambda: found.get(late.id).waits_for == ((job.id, "runs/a"),))
    (tmp_path / "a").touch()
    os.waitpid(queue.get(job.id).pid, 0)
    reached(found, late.id, State.DONE)


def test_two_paths_of_one_place_exclude_each_other(opened, tmp_path):
    queue = opened(at_once=2, identify=str.lower)
    job = queue.submit(asked("run", str(tmp_path / "a"), "waits", writes=["runs/A"]))
    late = queue.submit(asked("run", str(tmp_path / "b"), reads=["runs/a"]))
    started(tmp_path, "a")
    until(lambda: queue.get(late.id).waits_for == ((job.id, "runs/a"),))
    assert queue.get(late.id).state is State.QUEUED


@pytest.mark.parametrize("seed", range(3))
def test_random_jobs_all_end_and_never_collide(opened, tmp_path, seed):
    """Each program records when it starts and ends. No writer of a place overlaps with another job of that place."""
    random, queue = np.random.default_rng(seed), opened(at_once=3)
    begun, ended, works = {}, {}, {}

    def changed(name, job):
        if job.state is State.RUNNING and job.pid is None:
            begun[name] = len(begun) + len(ended)
        elif job.state is State.DONE:
            ended[name] = len(begun) + len(ended)

    queue.changed = changed
    for number in range(12):
        reads, writes = ([f"p{i}" for i in range(3) if random.random() < share] for share in (0.4, 0.25))
        work = asked("run", str(tmp_path / str(number)), reads=reads, writes=writes)
        works[queue.submit(work).id] = work
    until(lambda: len(ended) == len(works))
    for one, other in itertools.combinations(works, 2):
        if collision(works[one], works[other], str):
            assert ended[one] < begun[other]  # jobs of one place keep their order


def test_a_process_proves_by_its_environment_that_a_job_started_it():
    variables = {"GSPLAT_EDU_EVENTS": "/jobs/000001/events.jsonl"}
    child = subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE, env=variables)
    try:
        until(lambda: carries(child.pid, "GSPLAT_EDU_EVENTS", "/jobs/000001/events.jsonl"))
        assert not carries(child.pid, "GSPLAT_EDU_EVENTS", "/jobs/000001/events")
        assert not carries(child.pid, "GSPLAT_EDU_EVENTS", "/jobs/000002/events.jsonl")
    finally:
        child.kill()
        child.wait()
        child.stdin.close()
    assert not carries(child.pid, "GSPLAT_EDU_EVENTS", "/jobs/000001/events.jsonl")
    assert not is_running(1, identity(1) or "x") and not is_running(os.getpid(), "")
