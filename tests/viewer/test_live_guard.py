"""Only the view's own pages may connect, with the token and under its own host name."""

import http.client
import socket
import time
import urllib.parse
from types import SimpleNamespace

import pytest

pytest.importorskip("viser", reason="viser is not installed")
from websockets.exceptions import InvalidStatus

from gsplat_edu.data.procedural import procedural_capture
from gsplat_edu.data.writers import write_colmap
from gsplat_edu.errors import ArgumentError
from gsplat_edu.viewer import live, live_guard
from gsplat_edu.viewer.live_guard import Guard
from live_clients import PATIENCE, Client, Training, until


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    folder = tmp_path_factory.mktemp("captures") / "egg"
    write_colmap(folder, *procedural_capture(24, 6, splats=60))
    return folder


@pytest.fixture
def guarded(capture, tmp_path):
    """A view whose training never starts; access does not depend on the training."""
    made = Training(capture, tmp_path / "guarded", "--iterations", "30")
    with made.view:
        yield made.view


def parts(view):
    """Return the address, port and token of a view."""
    found = urllib.parse.urlsplit(view.url)
    return found.hostname, found.port, urllib.parse.parse_qs(found.query)["token"][0]


def lets_in(view, *words, **options):
    """Return whether a client may connect. A refusal must be a 403."""
    try:
        with Client(view, *words, **options) as client:
            until(lambda: client.listened().buttons, "the panel")
            return True
    except InvalidStatus as refused:
        assert refused.response.status_code == 403
        return False


def test_only_pages_of_its_own_origin_are_let_in(guarded):
    host, port, _ = parts(guarded)
    assert lets_in(guarded) and lets_in(guarded, f"http://{host}:{port}")
    for origin in (
        None,
        "null",
        "http://example.org",
        f"http://localhost.example.org:{port}",
        f"http://{host}:{port + 1}",
        f"http://{host}",
        f"http://localhost:{port}",  # the page was not requested under this name
        f"http://{host}:{port}.example.org",
        f"http://{host}:{port}/",
    ):
        assert not lets_in(guarded, origin), origin


def test_without_the_token_there_is_no_page_and_no_websocket(guarded):
    host, port, token = parts(guarded)
    bare = f"http://{host}:{port}/"
    wrong = token[:-1] + ("A" if token[-1] != "A" else "B")
    for url in (
        bare,
        f"{bare}?token=",
        f"{bare}?token={wrong}",
        f"{bare}?token={token[:5]}",
        f"{bare}?token=\u00e4",
    ):
        assert not lets_in(guarded, url=url), url
    for cookie in (f"gsplat_edu_{port}={wrong}", f"gsplat_edu_{port + 1}={token}", "=;;", "\u00e4"):
        assert not lets_in(guarded, url=bare, Cookie=cookie), cookie
    assert lets_in(guarded, url=bare, Cookie=f"other=1; gsplat_edu_{port}={token}")

    assert get(guarded, "/")[0] == get(guarded, f"/?token={wrong}")[0] == 403
    status, headers, body = get(guarded, f"/?token={token}")
    assert status == 200 and b"<html" in body[:300].lower()
    cookie = f"gsplat_edu_{port}={token}; Path=/; HttpOnly; SameSite=Strict"
    assert headers["Set-Cookie"] == cookie and headers["Referrer-Policy"] == "no-referrer"
    assert get(guarded, "/", Cookie=cookie.partition(";")[0])[0] == 200
    assert get(guarded, "/", Upgrade="WebSocket")[0] == 403


def get(view, path, **headers):
    """Return status, headers and body for one request."""
    host, port, _ = parts(view)
    connection = http.client.HTTPConnection(host, port, timeout=PATIENCE)
    try:
        connection.request("GET", path, headers=headers)
        answer = connection.getresponse()
        return answer.status, answer.headers, answer.read()
    finally:
        connection.close()


@pytest.mark.parametrize("name", ["evil.example.org:PORT", "192.168.0.7:PORT", "", "a:PORT"])
def test_a_foreign_host_name_is_refused(guarded, name):
    """DNS rebinding: the page has the same origin and even the token."""
    _, port, token = parts(guarded)
    assert get(guarded, f"/?token={token}", Host=name.replace("PORT", str(port)))[0] == 403
    # Through a tunnel the port differs, and the origin's port must differ in the same way.
    assert get(guarded, f"/?token={token}", Host="localhost:9000")[0] == 200
    assert (
        get(guarded, f"/?token={token}", Host="localhost:9000", Origin=f"http://localhost:{port}")[0] == 403
    )


def test_each_run_has_its_own_token():
    tokens = {Guard("127.0.0.1", 80).token for _ in range(100)}
    assert len(tokens) == 100 and all(len(token) >= 22 for token in tokens)  # 16 bytes in base64


def test_a_handshake_that_trickles_in_is_cut_off(guarded, capture, tmp_path, monkeypatch):
    monkeypatch.setattr(live_guard, "REQUEST_SECONDS", 0.2)
    made = Training(capture, tmp_path / "run", "--iterations", "30")
    with (
        made.view,
        socket.create_connection(parts(made.view)[:2], timeout=PATIENCE) as connection,
        pytest.raises((BrokenPipeError, ConnectionResetError)),
    ):
        for _ in range(2000):  # a byte every 10 ms
            connection.sendall(b"G")
            time.sleep(0.01)
    assert lets_in(guarded)


def test_a_viser_that_cannot_be_guarded_is_not_used(capture, tmp_path, monkeypatch):
    monkeypatch.setattr(live, "_Server", lambda **_: SimpleNamespace(stop=lambda: None))
    with pytest.raises(ArgumentError, match="cannot be guarded"):
        Training(capture, tmp_path / "run", "--iterations", "30")
