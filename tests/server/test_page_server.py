"""The page's server, tested over sockets, serves one page and nothing else, and only to allowed host names."""

import contextlib
import http.client
import socket

import pytest

from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.server import serving
from gsplat_edu.server.page_server import PageServer
from live_clients import is_closed
from viewer.pages import running
from waiting import PATIENCE, until

PAGE = b"<!doctype html><title>page</title>" + bytes(range(256)) * 8192  # two MB take more than one write


def page_server(*arguments, **options):
    server = PageServer(*arguments, **options)
    server.page = PAGE
    return server


@pytest.fixture
def server():
    with page_server() as made, running(made):
        yield made


def ask(server, method="GET", path="/", **headers):
    """Return status, headers and body of the answer to one request."""
    connection = http.client.HTTPConnection("127.0.0.1", server.port, timeout=PATIENCE)
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


def ask_raw(server, request, ends=False):
    """Send bytes, HTTP or not, and nothing after them if they end; return the whole answer."""
    with socket.create_connection(("127.0.0.1", server.port), timeout=PATIENCE) as connection:
        connection.sendall(request)
        if ends:
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
    assert headers["Cross-Origin-Resource-Policy"] == "same-origin"
    assert headers["Server"] is None and headers["Set-Cookie"] is None


def test_head_returns_only_the_headers(server):
    status, headers, body = ask(server, "HEAD")
    assert (status, body) == (200, b"")
    assert headers["Content-Length"] == str(len(PAGE))


@pytest.mark.parametrize(
    "path",
    [
        "/index.html",
        "/favicon.ico",
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
    answer = ask_raw(server, f"GET {path} HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n\r\n".encode())
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
    ],
)
def test_other_host_names_are_refused(server, host):
    """A foreign page may make its own host name resolve to 127.0.0.1."""
    status, _, body = ask(server, Host=host)
    assert (status, body) == (403, b"403 Forbidden: unknown host name for this server\n")
    assert ask(server, "HEAD", Host=host)[0] == 403


@pytest.mark.parametrize("hosts", [b"", b"Host: localhost\r\nHost: example.org\r\n"])
def test_no_host_header_and_two_of_them_are_refused(server, hosts):
    answer = ask_raw(server, b"GET / HTTP/1.1\r\n" + hosts + b"\r\n")
    assert answer.startswith(b"HTTP/1.1 400") and PAGE[:40] not in answer
    assert ask_raw(server, b"GET / HTTP/1.0\r\n\r\n").startswith(b"HTTP/1.1 403")


@pytest.mark.parametrize(
    "request_", [b"", b"\r\n", b"GET\r\n\r\n", b"\x16\x03\x01\x00\xa5\x01\x00", b"GET /", b"\0" * 70_000]
)
def test_an_invalid_request_does_no_harm(server, capsys, request_):
    with contextlib.suppress(OSError):  # the server may close the connection before a long line is sent
        ask_raw(server, request_, ends=True)
    assert ask(server)[2] == PAGE
    assert capsys.readouterr() == ("", ""), "the terminal stays clean"


@pytest.mark.parametrize("first", [b"G", b"GET / HTTP/1.1\r\nHost: localhost\r\nX: "])
def test_a_request_that_trickles_in_is_cut_off(server, monkeypatch, capsys, first):
    """The whole request has 0.2 s, although each read is quick."""
    monkeypatch.setattr(serving, "REQUEST_SECONDS", 0.2)
    with socket.create_connection(("127.0.0.1", server.port), timeout=PATIENCE) as connection:
        connection.sendall(first)
        until(lambda: is_closed(connection, b"a"), "the end of the connection")
    monkeypatch.undo()
    assert ask(server)[2] == PAGE
    assert capsys.readouterr() == ("", "")


def test_a_request_without_end_is_cut_off(server):
    # 90 headers of 60 KB, about a hundred times the limit
    with socket.create_connection(("127.0.0.1", server.port), timeout=PATIENCE) as connection:
        connection.sendall(b"GET / HTTP/1.1\r\n")
        assert any(is_closed(connection, b"X: " + b"a" * 60_000 + b"\r\n") for _ in range(90))


def test_connections_beyond_the_limit_are_closed(server):
    """Once waiting connections close, the server answers again."""
    address = ("127.0.0.1", server.port)
    waiting = [socket.create_connection(address, timeout=PATIENCE) for _ in range(serving.MOST_CONNECTIONS)]
    try:
        assert ask_raw(server, b"") == b"", "the server has accepted those before"
        with pytest.raises((http.client.BadStatusLine, ConnectionError)):
            ask(server)
    finally:
        for connection in waiting:
            connection.close()

    def answered():
        with contextlib.suppress(http.client.BadStatusLine, ConnectionError):
            return ask(server)[2] == PAGE

    until(answered, "room for another connection")


def test_a_browser_that_stops_reading_is_cut_off(server, monkeypatch):
    server.page = bytes(64 << 20)
    monkeypatch.setattr(serving, "PATIENCE", 0.2)
    with socket.socket() as connection:
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        connection.settimeout(PATIENCE)
        connection.connect(("127.0.0.1", server.port))
        connection.sendall(b"GET / HTTP/1.1\r\nHost: localhost\r\n\r\n")
        until(
            lambda: is_closed(connection, b"GET / HTTP/1.1\r\nHost: localhost\r\n\r\n"),
            "the end of the connection",
        )
    server.page = PAGE
    assert ask(server)[2] == PAGE


def test_a_browser_that_disconnects_midway_does_no_harm(server, capsys):
    for _ in range(3):
        with socket.create_connection(("127.0.0.1", server.port), timeout=PATIENCE) as connection:
            connection.sendall(b"GET / HTTP/1.1\r\nHost: localhost\r\n\r\n")
            assert connection.recv(100).startswith(b"HTTP/1.1 200")
    assert ask(server)[2] == PAGE
    assert capsys.readouterr() == ("", "")


def test_bound_to_every_address_the_server_accepts_local_network_names():
    with page_server(host="0.0.0.0") as open_to_all, running(open_to_all):
        assert ask(open_to_all, Host="my-desktop.lan")[2] == PAGE
        assert ask(open_to_all, Host="evil.example.org")[0] == 403
    assert open_to_all.url == f"http://127.0.0.1:{open_to_all.port}/"


def test_by_default_only_this_computer_can_connect():
    with page_server() as server:
        assert server.host == "127.0.0.1"
        assert server.url == f"http://127.0.0.1:{server.port}/"


def test_a_port_is_reported_at_once_and_free_after_the_end():
    with (
        page_server() as first,
        pytest.raises(ArgumentError, match=f"^--port: {first.port} is in use on 127.0.0.1"),
    ):
        page_server(port=first.port)
    with page_server(port=first.port) as second, running(second):
        assert ask(second)[2] == PAGE
