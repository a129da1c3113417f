"""The page's server, tested over sockets, serves one page and nothing else, and only to allowed host names."""

import contextlib
import http.client
import io
import socket
import threading

import numpy as np
import pytest
from PIL import Image

from gsplat_edu.io.scene import Scene
from gsplat_edu.render.settings import RenderSettings
from gsplat_edu.viewer import page, page_parts, serve
from gsplat_edu.viewer.serve import PageServer
from live_clients import is_closed
from viewer.pages import running
from waiting import PATIENCE, until

PAGE = b"<!doctype html><title>page</title>" + bytes(range(256)) * 8192  # two MB take more than one write
ORANGE = (1.0, 0.5, 0.0)


@pytest.fixture
def server():
    with PageServer(PAGE) as made, running(made):
        yield made


def ask(server, method="GET", path="/", **headers):
    """Return status, headers and body of the answer to one request."""
    connection = http.client.HTTPConnection(*server.server_address[:2], timeout=PATIENCE)
    try:
        connection.putrequest(method, path, skip_host="Host" in headers)
        for name, value in headers.items():
            if value is not None:
                connection.putheader(name, value)
        connection.endheaders()
        answer = connection.getresponse()
        return answer.status, answer.headers, answer.read()
    finally:
        connection.close()


def ask_raw(server, request):
    """Send bytes, HTTP or not; return the whole answer."""
    with socket.create_connection(server.server_address[:2], timeout=PATIENCE) as connection:
        connection.sendall(request)
        connection.shutdown(socket.SHUT_WR)
        answer = b""
        while piece := connection.recv(1 << 16):
            answer += piece
    return answer


def test_the_page_is_served_unchanged(server):
    status, headers, body = ask(server)
    assert (status, body) == (200, PAGE)
    assert headers["Content-Type"] == "text/html; charset=utf-8"
    assert headers["Content-Length"] == str(len(PAGE))
    assert headers["Cache-Control"] == "no-store"
    assert headers["X-Content-Type-Options"] == "nosniff"
    assert "Python" not in headers["Server"]


def test_head_returns_only_the_headers(server):
    status, headers, body = ask(server, "HEAD")
    assert (status, body) == (200, b"")
    assert headers["Content-Length"] == str(len(PAGE))


@pytest.mark.parametrize(
    "path",
    [
        "/index.html",
        "/favicon.ico",
        "/?page",
        "/.",
        "*",
        "/../../../../etc/passwd",
        "/..%2f..%2f..%2fetc/passwd",
        "/%2e%2e/%2e%2e/etc/passwd",
        "/..\\..\\etc\\passwd",
        "//etc/passwd",
        "/etc/passwd",
        "file:///etc/passwd",
        "http://127.0.0.1/",
        "/" + "a" * 60_000,
    ],
)
def test_no_other_path_is_served(server, path):
    answer = ask_raw(server, f"GET {path} HTTP/1.1\r\nHost: localhost\r\n\r\n".encode())
    assert answer.split(b" ", 2)[1] in (b"404", b"400") and b"root:" not in answer and PAGE[:40] not in answer


def test_files_of_the_working_folder_are_not_served(server, tmp_path, monkeypatch):
    (tmp_path / "secret.txt").write_text("secret")
    monkeypatch.chdir(tmp_path)
    assert ask(server, path="/secret.txt")[0] == 404


@pytest.mark.parametrize(
    "method", ["POST", "PUT", "DELETE", "PATCH", "OPTIONS", "TRACE", "CONNECT", "FROBNICATE"]
)
def test_other_methods_are_not_allowed(server, method):
    status, headers, body = ask(server, method)
    assert (status, headers["Allow"], body) == (405, "GET, HEAD", b"405 Method Not Allowed\n")


@pytest.mark.parametrize(
    "host", ["localhost", "LOCALHOST:80", "127.0.0.1", "127.0.0.1:9999", "127.1.2.3", "[::1]", "[::1]:8080"]
)
def test_names_of_this_computer_are_answered(server, host):
    assert ask(server, Host=host)[0] == 200


@pytest.mark.parametrize(
    "host",
    [
        "example.org",
        "example.org:8080",
        "localhost.example.org",
        "127.0.0.1.example.org",
        "127.0.0.1@example.org",
        "127.0.0.1 example.org",
        "192.168.0.7",
        "",
        None,
    ],
)
def test_other_host_names_are_refused(server, host):
    """A foreign page may make its own host name resolve to 127.0.0.1."""
    status, _, body = ask(server, Host=host)
    assert (status, body) == (403, b"403 Forbidden\n")
    assert ask(server, "HEAD", Host=host)[0] == 403


def test_two_host_headers_are_refused(server):
    answer = ask_raw(server, b"GET / HTTP/1.1\r\nHost: localhost\r\nHost: example.org\r\n\r\n")
    assert answer.startswith(b"HTTP/1.0 403")


@pytest.mark.parametrize(
    "request_", [b"", b"\r\n", b"GET\r\n\r\n", b"\x16\x03\x01\x00\xa5\x01\x00", b"GET /", b"\0" * 70_000]
)
def test_an_invalid_request_does_no_harm(server, capsys, request_):
    with contextlib.suppress(OSError):  # the server may close the connection before a long line is sent
        ask_raw(server, request_)
    assert ask(server)[2] == PAGE
    assert capsys.readouterr() == ("", ""), "the terminal stays clean"


@pytest.mark.parametrize("first", [b"G", b"GET / HTTP/1.1\r\nHost: localhost\r\nX: "])
def test_a_request_that_trickles_in_is_cut_off(server, monkeypatch, capsys, first):
    """The whole request has 0.2 s, although each read is quick."""
    monkeypatch.setattr(serve, "REQUEST_SECONDS", 0.2)
    with socket.create_connection(server.server_address[:2], timeout=PATIENCE) as connection:
        connection.sendall(first)
        until(lambda: is_closed(connection, b"a"), "the end of the connection")
    monkeypatch.undo()
    assert ask(server)[2] == PAGE
    assert capsys.readouterr() == ("", "")


def test_a_request_without_end_is_cut_off(server):
    # http.server accepts 100 headers. These are 90 headers of 60 KB, about a hundred times the limit.
    with socket.create_connection(server.server_address[:2], timeout=PATIENCE) as connection:
        connection.sendall(b"GET / HTTP/1.1\r\n")
        assert any(is_closed(connection, b"X: " + b"a" * 60_000 + b"\r\n") for _ in range(90))


def test_connections_beyond_the_limit_are_closed(server, monkeypatch):
    """Waiting connections occupy all threads, so the next one gets no answer. Once they close, the server answers
    again."""
    server._room = threading.Semaphore(3)
    waiting = [socket.create_connection(server.server_address[:2], timeout=PATIENCE) for _ in range(3)]
    try:
        until(lambda: server._room._value == 0, "connections in all threads")
        assert ask_raw(server, b"") == b""
        with pytest.raises((http.client.BadStatusLine, ConnectionError)):
            ask(server)
    finally:
        for connection in waiting:
            connection.close()
    until(lambda: server._room._value == 3, "the release of the threads")
    assert ask(server)[2] == PAGE


def test_a_browser_that_disconnects_midway_does_no_harm(server, capsys):
    for _ in range(3):
        with socket.create_connection(server.server_address[:2], timeout=PATIENCE) as connection:
            connection.sendall(b"GET / HTTP/1.1\r\nHost: localhost\r\n\r\n")
            assert connection.recv(100).startswith(b"HTTP/1.0 200")
    assert ask(server)[2] == PAGE
    assert capsys.readouterr() == ("", "")


def test_a_browser_draws_the_page_without_complaint(server, visit, random_gaussians):
    server.page = page.html(Scene(random_gaussians(300)), settings=RenderSettings(background=ORANGE))
    server.policy = page_parts.policy()
    assert ask(server)[1]["Content-Security-Policy"] == f"{page_parts.policy()}; frame-ancestors 'none'"
    tab = visit(320, 240, url=server.url).ready().tab
    picture = np.asarray(Image.open(io.BytesIO(tab.screenshot())).convert("RGB"), dtype=float)
    orange = np.abs(picture - 255.0 * np.array(ORANGE)).max(axis=2) < 3
    assert 0.1 < orange.mean() < 0.95 and picture[~orange].std() > 20


def test_bound_to_every_address_the_server_accepts_local_network_names():
    with PageServer(PAGE, "0.0.0.0") as open_to_all, running(open_to_all):
        assert ask(open_to_all, Host="my-desktop.lan")[2] == PAGE
        assert ask(open_to_all, Host="evil.example.org")[0] == 403
    assert open_to_all.url == f"http://127.0.0.1:{open_to_all.server_port}/"


def test_by_default_only_this_computer_can_connect():
    with PageServer(PAGE) as server:
        assert server.server_address[0] == "127.0.0.1"
        assert server.url == f"http://127.0.0.1:{server.server_port}/"
