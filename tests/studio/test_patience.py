"""Stalled bodies are given up, odd numbers and long values are refused in a short line, the terminal stays clean."""

import asyncio
import logging
import socket
import struct

import pytest

from gsplat_edu.base.text import LONGEST_LINE, LONGEST_WORD, bounded
from gsplat_edu.cli.main import main
from gsplat_edu.server.patience import LEAST_GAIN, Patience
from gsplat_edu.server.refusal import RefusedError
from gsplat_edu.studio.uploads import Limits
from studio.conftest import Inline
from studio.pages import served
from studio.test_stream import ODD
from waiting import finished

LONG = "x" * 5_000


def read(piece, wait, count, seconds):
    """Read a body whose pieces each come after a wait, with this patience; return its bytes.

    A clock of the test's own passes the waits at once.
    """
    found, came, waited = bytearray(), 0, 0.0

    async def receive():
        nonlocal came, waited
        waited += wait
        loop, turned = asyncio.get_running_loop(), asyncio.Event()
        loop.call_soon(loop.call_soon, turned.set)  # a timer that is due fires before
        await turned.wait()
        came += 1
        return {"type": "http.request", "body": bytes(piece), "more_body": came < count}

    async def app(scope, receive, send):
        loop = asyncio.get_running_loop()
        start = loop.time()
        loop.time = lambda: start + waited
        more = True
        while more:
            message = await receive()
            found.extend(message["body"])
            more = message["more_body"]

    finished(Patience(app, seconds)({"type": "http"}, receive, None))
    return len(found)


def test_a_stalled_body_is_given_up():
    assert read(LEAST_GAIN, 0.0, 100, 30.0) == 100 * LEAST_GAIN and read(1, 0.0, 10, 30.0) == 10
    for piece, wait in (
        (1, 0.01),
        (LEAST_GAIN // 1000, 0.01),
        (LEAST_GAIN, 60.0),
    ):  # sends a few bytes and stops
        with pytest.raises(RefusedError, match=r"fewer than 4,096 bytes of it came in 0.1 s"):
            read(piece, wait, 1_000, 0.1)


REQUESTS = {
    "POST /api/jobs": b"{",
    "PUT /api/photos/a/files/a.jpg": b"x",
    "PUT /api/photos/a/zip": b"PK",
    "PUT /api/scenes/s/edits.json": b"{",
    "POST /api/runs/r/live/control": b"",
    "GET /api/library": b"x",  # this route reads no body
    "DELETE /api/trash": b"",
    "PUT /api/nowhere": b"x",
}


def connected(url):
    address, _, token = url.removeprefix("http://127.0.0.1:").partition("/?token=")
    port = int(address)
    head = f"HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\nAuthorization: Bearer {token}\r\n"
    return socket.create_connection(("127.0.0.1", port), timeout=180), head


def test_every_request_whose_body_stalls_ends(tmp_path):
    with served(tmp_path / "library", Inline(), Limits(spare=0, stall=0.2)) as (_, url):
        waiting = {}
        for request, begun in REQUESTS.items():
            waiting[request], head = connected(url)
            kind = "Content-Type: application/json\r\nContent-Length: 100\r\n\r\n"
            waiting[request].sendall(f"{request} {head}{kind}".encode() + begun)
        for request, connection in waiting.items():
            answer = b"".join(iter(lambda connection=connection: connection.recv(65536), b""))
            connection.close()
            if request in ("POST /api/jobs", "PUT /api/photos/a/files/a.jpg", "PUT /api/photos/a/zip"):
                assert answer.startswith(b"HTTP/1.1 408 "), request
            assert answer.startswith(b"HTTP/1.1 "), request


def test_a_stream_whose_reader_is_gone_is_not_written_to(tmp_path, caplog):
    with served(tmp_path / "library", Inline()) as (studio, url), caplog.at_level(logging.WARNING, "asyncio"):
        for number in range(1_000):
            studio.stream.publish("job", {"id": f"{number:06d}", "filled": "x" * 500})
        for _ in range(20):
            connection, head = connected(url)
            request = f"GET /api/events {head}Last-Event-ID: {studio.stream.boot}-1\r\n\r\n"
            connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
            connection.sendall(request.encode())
            connection.close()  # by a reset of the connection
        connection, head = connected(url)
        connection.sendall(f"GET /api/events {head}Last-Event-ID: {studio.stream.boot}-990\r\n\r\n".encode())
        found = b""
        while b"000999" not in found:
            found += connection.recv(65536)
        connection.close()
    assert [record.message for record in caplog.records if "socket.send" in record.message] == []


@pytest.mark.parametrize("number", ODD)
def test_other_spellings_of_numbers_are_refused(page, studio, number):
    (studio.library.root / "runs" / "r").mkdir()
    (studio.library.root / "runs" / "r" / "log.jsonl").write_text("")
    (studio.library.hidden("trash") / number[:20]).mkdir()
    (studio.library.root / "captures" / "a").mkdir()
    job = page.post("/api/jobs", json={"command": "doctor", "subject": "captures/a"}).json()["id"]
    assert page.get(f"/api/jobs/{job}/events", params={"after": number}).status_code == 400
    known = page.get("/api/runs/r/curves").json()["next"].partition(".")[0]
    assert page.get("/api/runs/r/curves", params={"after": f"{known}.{number}"}).json()["reset"]
    assert page.get(f"/api/runs/r/views/{number}/render.png").status_code == 404
    assert page.get("/api/trash").json() == {"trash": []}


def test_answers_that_quote_long_values_are_short(page, studio):
    (studio.library.root / "captures" / "a").mkdir()
    train = {"command": "train", "subject": "captures/a"}
    answers = [
        *(page.get(f"/api/{LONG}/x"), page.get(f"/api/photos/{LONG}"), page.get(f"/api/jobs/{LONG}")),
        *(page.post("/api/jobs", json={LONG: 1}), page.post("/api/jobs", json={**train, LONG: 1})),
        *(
            page.post("/api/jobs", json={**train, name: LONG})
            for name in ("command", "subject", "to", "options")
        ),
        page.post("/api/jobs", json={**train, "options": {LONG: 1}}),
        *(
            page.post("/api/jobs", json={**train, "options": {n: LONG}})
            for n in ("quality", "seed", "time_limit")
        ),
        page.post("/api/adopt", json={"kind": LONG, "path": "/x", "name": "x"}),
        page.post("/api/adopt", json={"kind": "photos", "path": LONG, "name": "x"}),
        page.post("/api/adopt", json={"kind": "photos", "path": f"/{LONG}", "name": "x"}),
        page.post(f"/api/trash/{LONG}/restore"),
        page.put(f"/api/photos/a/files/{LONG}.jpg", content=b"x"),
        page.put(f"/api/{LONG}/a/zip", content=b"x"),
        page.get("/api/compare", params={"a": LONG, "b": "x"}),
        page.get("/api/captures/a/forecast", params={"resolution": LONG}),
        page.get(f"/api/captures/a/thumbs/{LONG}.jpg", params={"side": LONG}),
        page.get(f"/api/captures/a/thumbs/{LONG}.jpg"),
        page.delete(f"/api/runs/a/exports/{LONG}"),
    ]
    for answer in answers:
        assert 400 <= answer.status_code < 500, answer.text
        assert len(answer.json()["error"]) < 2 * LONGEST_WORD, answer.text[:100]


@pytest.mark.parametrize(
    "words",
    [
        *([LONG], ["info", LONG], ["train", LONG], ["train", ".", LONG], ["train", ".", f"--{LONG}"]),
        *(
            ["train", ".", f"--{name}", LONG]
            for name in ("quality", "iterations", "time-limit", "max-memory")
        ),
        *(["view", ".", "--host", LONG], ["studio", LONG, "--no-open"]),
        *(["info", "x " * 2_500], ["studio", f"/tmp/{LONG}", "--no-open"]),
    ],
    ids=lambda words: " ".join(word[:12] for word in words),
)
def test_lines_of_commands_that_quote_long_values_are_short(capsys, monkeypatch, tmp_path, words):
    monkeypatch.chdir(tmp_path)
    try:
        code = main(words)
    except SystemExit as end:
        code = end.code
    said = capsys.readouterr().err
    assert code == 2 and said.count("\n") == 1 and len(said) <= LONGEST_LINE + 1


def test_a_bounded_line_keeps_its_start_and_its_advice():
    line = bounded(f"--out: {LONG} is no folder; choose another one")
    assert line.startswith("--out: xxx") and line.endswith("xxx is no folder; choose another one")
    assert len(line) < LONGEST_WORD + 60 and bounded("short") == "short"
    assert len(bounded("x " * 5_000)) == LONGEST_LINE
