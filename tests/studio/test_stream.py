"""The stream of events is complete and in order, and is resumed by its ids."""

import asyncio
import json
from dataclasses import replace

from gsplat_edu.jobs import events, following
from gsplat_edu.jobs.record import State, Work
from gsplat_edu.studio import stream as stream_module
from gsplat_edu.studio.stream import Stream
from waiting import finished

ODD = ("\u00b2", "\u0663", "+6", "-6", " 6", "6_0", "6.0", "9" * 5_000)
"""Texts that `str.isdigit`, `str.isdecimal` or `int` accept as numbers."""


def collected(stream, last_id, count):
    """Return the next events as (id, kind, data)."""

    async def run():
        stream._loop = asyncio.get_running_loop()
        found = []
        watching = stream.watch(last_id)
        async for text in watching:
            fields = dict(line.split(": ", 1) for line in text.strip().splitlines())
            found.append((fields.get("id"), fields["event"], json.loads(fields["data"])))
            if len(found) == count:
                break
        await watching.aclose()
        assert not stream._woken
        return found

    return finished(run())


def test_a_watcher_resumes_after_the_last_event_it_has():
    stream = Stream()
    for number in range(5):
        stream.publish("job", {"number": number})
    found = collected(stream, f"{stream.boot}-2", 3)
    assert [data["number"] for _, _, data in found] == [2, 3, 4]
    assert found[-1][0] == f"{stream.boot}-5"


def test_unknown_ids_start_from_the_beginning(monkeypatch):
    monkeypatch.setattr(stream_module, "KEPT", 3)
    stream = Stream()
    for number in range(6):
        stream.publish("job", {"number": number})
    odd = [f"{stream.boot}-{number}" for number in ODD]
    for last_id in (None, "", "other-3", f"{stream.boot}-x", f"{stream.boot}-99", f"{stream.boot}-2", *odd):
        ((found_id, kind, _),) = collected(stream, last_id, 1)
        assert kind == "reset" and found_id == f"{stream.boot}-6", last_id
    assert [data["number"] for _, _, data in collected(stream, f"{stream.boot}-3", 3)] == [3, 4, 5]


def test_streams_are_limited(monkeypatch):
    monkeypatch.setattr(stream_module, "MOST_WATCHING", 0)
    assert collected(Stream(), None, 1) == [(None, "full", {})]


def test_the_events_of_jobs_are_published_once_and_in_order(studio):
    studio.queue.at_once = 0
    (studio.library.root / "captures" / "x").mkdir()
    job = studio.queue.submit(Work("train", ("captures/x",), ("runs/x",)))
    path = studio.queue.files(job.id).events
    studio.queue._jobs[job.id] = running = type(job)(
        **{**vars(job), "state": stream_module.ACTIVE[0], "pid": 1}
    )
    studio.queue._look = lambda: None  # process 1 is not a job's
    path.write_text(
        events.line_of(events.Stage("photos"), 1.0) + events.line_of(events.Progress("photos", 1, 2), 2.0)
    )
    studio.stream.look(studio.queue)
    with path.open("a") as file:
        file.write(events.line_of(events.Finished(("x",)), 3.0))
    studio.queue._jobs[job.id] = job  # the job ends before the next look
    studio.stream.look(studio.queue)
    studio.stream.look(studio.queue)
    found = collected(studio.stream, f"{studio.stream.boot}-1", 3)
    assert [(data["job"], data["number"], data["event"]) for _, kind, data in found if kind == "event"] == [
        (running.id, 1, "stage"),
        (running.id, 2, "progress"),
        (running.id, 3, "finished"),
    ]


def test_many_changes_of_the_library_are_told_once_a_second(studio, monkeypatch):
    """Uploads change the library with every file, and each event makes every tab read the whole list."""
    clock = [100.0]
    monkeypatch.setattr(stream_module, "monotonic", lambda: clock[0])
    stream, queue = Stream(), studio.queue
    counts = []
    for _ in range(25):
        stream.library_changed()
        stream.look(queue)
        counts.append(stream._number)
        clock[0] += 0.1
    assert (counts[0], counts[-1]) == (1, 3)
    clock[0] += 10
    stream.look(queue)
    stream.look(queue)
    assert stream._number == 4, "the last change is told, and only once"


def test_a_job_that_starts_and_ends_between_two_looks_is_told_whole(studio, monkeypatch):
    """A loaded machine looks seldom. What a short job printed would be missing on the page until it is loaded again."""
    monkeypatch.setattr(following, "PIECE", 200)
    studio.queue.at_once = 0
    (studio.library.root / "captures" / "x").mkdir()
    job = studio.queue.submit(Work("train", ("captures/x",), ("runs/x",)))
    lines = [events.line_of(events.Message(f"line {number}"), 1.0) for number in range(20)]
    studio.queue.files(job.id).events.write_text("".join(lines))
    for state in (State.RUNNING, State.DONE):
        studio.queue._note(replace(job, state=state))
    for _ in range(2):
        studio.stream.look(studio.queue)
    kept = [text for _, text in studio.stream._kept if "event: event" in text]
    told = [json.loads(text.partition("data: ")[2]) for text in kept]
    assert [event["text"] for event in told] == [f"line {number}" for number in range(20)]


def test_news_after_the_end_of_the_server_does_no_harm(monkeypatch):
    """The loop ends first, and the queue's thread must go on to note how its jobs end."""
    stream, loop = Stream(), asyncio.new_event_loop()
    loop.close()
    stream._loop = loop
    with monkeypatch.context() as patch:
        patch.setattr(loop, "is_closed", lambda: False)  # it ends right after it was asked
        stream.publish("job", {"number": 1})
    stream.publish("job", {"number": 2})
    assert stream._number == 2
