"""The editor's server, over sockets: only its own page may write, and only valid edits that follow the stored ones."""

import http.client
import json
from contextlib import contextmanager

import pytest

from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.edits.document import empty_document
from gsplat_edu.edits.identity import Identity
from gsplat_edu.edits.stored import MOST_BYTES, NO_FILE
from gsplat_edu.viewer.edit_serve import ADDRESS, EditServer
from viewer.pages import running

SCENE = Identity(7, "ab" * 32, (0.0, 0.0, 0.0))
PAGE = b"<!doctype html><title>page</title>"
TEXT = empty_document(SCENE).encode()


@contextmanager
def serving(file):
    with EditServer("127.0.0.1", 0, "default-src 'none'", file) as made:
        made.page = PAGE
        made.prepare(SCENE)
        with running(made):
            yield made


@pytest.fixture
def server(tmp_path):
    with serving(tmp_path / "edits.json") as made:
        yield made


def ask(server, method, path, body=None, **headers):
    """Return status, headers and body of the answer to one request."""
    connection = http.client.HTTPConnection("127.0.0.1", server.port, timeout=180)
    try:
        connection.putrequest(method, path, skip_host="Host" in headers)
        for name, value in headers.items():
            if value is not None:
                connection.putheader(name.replace("_", "-"), value)
        if body is not None and "Content_Length" not in headers:
            connection.putheader("Content-Length", str(len(body)))
        connection.endheaders(body)
        answer = connection.getresponse()
        return answer.status, answer.headers, answer.read()
    finally:
        connection.close()


def cookie_of(server):
    return f"{server.cookie}={server.token}"


def put(server, body=TEXT, version=NO_FILE, path=ADDRESS, **headers):
    own = {
        "Cookie": cookie_of(server),
        "Origin": f"http://127.0.0.1:{server.port}",
        "If_Match": f'"{version}"',
    }
    return ask(server, "PUT", path, body, **(own | headers))


def test_the_url_opens_the_page_and_gives_a_cookie_that_no_other_site_can_use(server):
    status, headers, body = ask(server, "GET", f"/?token={server.token}")
    assert (status, body) == (200, PAGE)
    assert headers["Set-Cookie"] == f"{cookie_of(server)}; Path=/; HttpOnly; SameSite=Strict"
    assert headers["Content-Security-Policy"] == "default-src 'none'; frame-ancestors 'none'"
    assert headers["Referrer-Policy"] == "no-referrer" and "Access-Control-Allow-Origin" not in headers
    assert server.url == f"http://127.0.0.1:{server.port}/?token={server.token}"
    assert ask(server, "GET", "/", Cookie=cookie_of(server))[2] == PAGE


def test_saved_edits_are_the_bytes_that_were_sent(server):
    assert ask(server, "GET", ADDRESS, Cookie=cookie_of(server))[2] == b"null\n"
    status, headers, _ = put(server)
    assert status == 200 and server.file.read_bytes() == TEXT
    version = headers["ETag"].strip('"')
    status, headers, body = ask(server, "GET", ADDRESS, Cookie=cookie_of(server))
    assert (status, body, headers["ETag"]) == (200, TEXT, f'"{version}"')
    other = TEXT.replace(b"\n", b" \n")
    assert put(server, other, version)[0] == 200
    assert server.file.read_bytes() == other
    assert [path.name for path in server.file.parent.iterdir()] == ["edits.json"]


@pytest.mark.parametrize(
    "headers",
    [
        {"Cookie": None},
        {"Cookie": "gsplat_edu_1=x"},
        {"Cookie": "\x01;;=,"},
        {"Origin": None},
        {"Origin": "null"},
        {"Origin": "http://example.org"},
        {"Origin": "http://127.0.0.1:1"},
        {"Host": "example.org"},
        {"Host": "example.org", "Origin": "http://example.org"},
    ],
)
def test_a_write_from_elsewhere_is_refused(server, headers):
    status, _, body = put(server, **headers)
    assert status == 403 and body.count(b"\n") == 1
    assert not server.file.exists()


@pytest.mark.parametrize("path", ["/", ADDRESS, "/?token=", "/?token=wrong", f"{ADDRESS}?token=wrong"])
def test_no_file_is_served_without_the_token(server, path):
    for method in ("GET", "HEAD"):
        status, headers, body = ask(server, method, path)
        assert status == 403 and PAGE not in body and "Set-Cookie" not in headers
    assert ask(server, "GET", path, Cookie=cookie_of(server), Host="example.org")[0] == 403


def test_only_the_edits_can_be_written_and_nothing_else_is_served(server):
    for path in ("/", "/x", "/../edits.json", f"{ADDRESS}/"):
        assert put(server, path=path)[0] == 405
        if path != "/":
            assert ask(server, "GET", path, Cookie=cookie_of(server))[0] == 404
    own = {"Cookie": cookie_of(server), "Origin": f"http://127.0.0.1:{server.port}"}
    status, headers, _ = ask(server, "POST", ADDRESS, TEXT, **own)
    assert (status, headers["Allow"]) == (405, "GET, HEAD, PUT")
    assert not server.file.exists()


def test_a_file_that_somebody_else_wrote_is_not_overwritten(server):
    server.file.write_bytes(TEXT)
    status, _, body = put(server, TEXT.replace(b"7", b"7 "))
    assert status == 412 and b"was changed elsewhere" in body
    assert server.file.read_bytes() == TEXT


@pytest.mark.parametrize(
    ("body", "says"),
    [
        (b"", b"is not JSON"),
        (TEXT[:-9], b"is not JSON"),
        (TEXT.replace(b'"version": 1', b'"version": 3'), b"version: is 3"),
        (empty_document(Identity(8, "ab" * 32, (0.0, 0.0, 0.0))).encode(), b"was made for another scene"),
        (TEXT.replace(b"[]", b'[{"op": "paint"}]'), b'operations[0].op: is "paint"'),
    ],
)
def test_invalid_edits_are_refused_in_one_line(server, body, says):
    status, _, answer = put(server, body)
    assert status == 400 and says in answer and answer.count(b"\n") == 1
    assert not server.file.exists()


def test_lengths_are_checked_before_anything_is_read(server):
    assert put(server, b"", Content_Length=str(MOST_BYTES + 1))[0] == 413
    assert put(server, b"", Content_Length="-1")[0] == 400
    assert put(server, None)[0] == 411
    large = TEXT.replace(b"[]", b"[" + b'{"op": "invert"},' * 5000 + b'{"op": "show"}]')
    assert len(large) > 65_536, "more than the headers of a request may have"
    assert put(server, large)[0] == 200
    assert len(json.loads(server.file.read_bytes())["operations"]) == 5001


def test_an_unwritable_folder_is_one_line(server):
    server.file = server.file.parent / "file" / "edits.json"
    (server.file.parent.parent / "file").write_text("")
    status, _, body = put(server)
    assert status == 500 and body.count(b"\n") == 1 and b"file" in body


def test_a_damaged_file_is_named_at_the_start_and_when_it_is_read(tmp_path):
    (tmp_path / "edits.json").write_text("{")
    with pytest.raises(ArgumentError, match=r"edits\.json: is not JSON"), serving(tmp_path / "edits.json"):
        pass
    (tmp_path / "edits.json").unlink()
    with serving(tmp_path / "edits.json") as server:
        (tmp_path / "edits.json").write_text("{")
        status, _, body = ask(server, "GET", ADDRESS, Cookie=cookie_of(server))
        assert status == 409 and b"edits.json: is not JSON" in body
