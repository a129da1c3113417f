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
        found = []
        watching = stream.watch(last_id)
        async for text in watching:
            fields = dict(line.split(": ", 1) for line in text.strip().splitlines())
            found.append((fields.get("id"), fields["event"], json.loads(fields["data"])))
            if len(found) == count:
                break
        await watching.aclose()
        return found

    return finished(run())


def number_of(stream):
    """Return the number of the last event."""
    ((last, kind, _),) = collected(stream, None, 1)
    assert kind == "reset"
    return int(last.partition("-")[2])


def test_a_watcher_resumes_after_the_last_event_it_has():
    stream = Stream()
    for number in range(5):
        stream.publish("job", {"number": number})
    found = collected(stream, f"{stream.boot}-2", 3)
    assert [data["number"] for _, _, data in found] == [2, 3, 4]
    assert found[-1][0] == f"{stream.boot}-5"


def test_unknown_ids_start_from_the_beginning():
    stream, last = Stream(), stream_module.KEPT + 3
    for number in range(last):
        stream.publish("job", {"number": number})
    odd = [f"{stream.boot}-{number}" for number in ODD]
    for last_id in (
        None,
        "",
        "other-3",
        f"{stream.boot}-x",
        f"{stream.boot}-{last + 1}",
        f"{stream.boot}-2",
        *odd,
    ):
        ((found_id, kind, _),) = collected(stream, last_id, 1)
        assert kind == "reset" and found_id == f"{stream.boot}-{last}", last_id
    assert [data["number"] for _, _, data in collected(stream, f"{stream.boot}-3", 3)] == [3, 4, 5]


def test_streams_are_limited():
    """A watcher that leaves makes room for another one."""
    stream = Stream()

    async def begun():
        watching = [stream.watch(None) for _ in range(stream_module.MOST_WATCHING + 1)]
        said = [await anext(one) for one in watching]
        for one in watching:
            await one.aclose()
        return said

    for _ in range(2):
        *said, last = finished(begun())
        assert all("event: reset" in text for text in said) and last == "event: full\ndata: {}\n\n"


def test_the_events_of_jobs_are_published_once_and_in_order(studio):
    studio.queue.at_once = 0
    (studio.library.root / "captures" / "x").mkdir()
    job = studio.queue.submit(Work("train", ("captures/x",), ("runs/x",)))
    path = studio.queue.files(job.id).events
    now = [replace(job, state=State.RUNNING)]
    queue = studio.queue
    queue.close(interrupt=False)  # it looks for no process
    queue.jobs = lambda: now
    path.write_text(
        events.line_of(events.Stage("photos"), 1.0) + events.line_of(events.Progress("photos", 1, 2), 2.0)
    )
    studio.stream.look(queue)
    with path.open("a") as file:
        file.write(events.line_of(events.Finished(("x",)), 3.0))
    now[:] = [job]  # the job ends before the next look
    studio.stream.look(queue)
    studio.stream.look(queue)
    found = collected(studio.stream, f"{studio.stream.boot}-1", 3)
    assert [(data["job"], data["number"], data["event"]) for _, kind, data in found if kind == "event"] == [
        (job.id, 1, "stage"),
        (job.id, 2, "progress"),
        (job.id, 3, "finished"),
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
        counts.append(number_of(stream))
        clock[0] += 0.1
    assert (counts[0], counts[-1]) == (1, 3)
    clock[0] += 10
    stream.look(queue)
    stream.look(queue)
    assert number_of(stream) == 4, "the last change is told, and only once"


def test_a_job_that_starts_and_ends_between_two_looks_is_told_whole(studio, monkeypatch):
    """A loaded machine looks seldom. What a short job printed would be missing on the page until it is loaded again."""
    monkeypatch.setattr(following, "PIECE", 200)
    studio.queue.at_once = 0
    (studio.library.root / "captures" / "x").mkdir()
    job = studio.queue.submit(Work("train", ("captures/x",), ("runs/x",)))
    lines = [events.line_of(events.Message(f"line {number}"), 1.0) for number in range(20)]
    studio.queue.files(job.id).events.write_text("".join(lines))
    for state in (State.RUNNING, State.DONE):
        studio.stream.changed(job.id, replace(job, state=state))
    for _ in range(2):
        studio.stream.look(studio.queue)
    kept = collected(studio.stream, f"{studio.stream.boot}-0", number_of(studio.stream))
    told = [data for _, kind, data in kept if kind == "event"]
    assert [event["text"] for event in told] == [f"line {number}" for number in range(20)]


def test_news_after_the_end_of_the_server_does_no_harm(studio):
    """The loop ends first, and the queue's thread must go on to note how its jobs end."""
    stream = Stream()

    async def served():
        following = asyncio.create_task(stream.follow(studio.queue))
        await asyncio.wait([following], timeout=0)
        following.cancel()

    finished(served())
    stream.publish("job", {"number": 1})
    assert number_of(stream) == 1
