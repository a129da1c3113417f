"""The stream of events is complete and in order, and is resumed by its ids."""

import asyncio
import json

from gsplat_edu.jobs import events
from gsplat_edu.jobs.record import Work
from gsplat_edu.studio import stream as stream_module
from gsplat_edu.studio.stream import Stream

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

    return asyncio.run(asyncio.wait_for(run(), 10))


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
