"""Only the live view's own pages may connect, with the token and by its host name."""

import socket

import pytest

from gsplat_edu.data.procedural import procedural_capture
from gsplat_edu.data.writers import write_colmap
from gsplat_edu.viewer import serve
from gsplat_edu.viewer.guard import Guard
from live_clients import PATIENCE, Client, Training, is_closed
from waiting import until


@pytest.fixture(scope="module")
def guarded(tmp_path_factory):
    """A live view whose training never starts, because access does not depend on the training."""
    folder = tmp_path_factory.mktemp("captures")
    write_colmap(folder / "egg", *procedural_capture(24, 6, splats=60))
    made = Training(folder / "egg", folder / "run", "--iterations", "30")
    made.view.take_state({})  # requests for a state do not wait
    with made.view:
        yield Client(made.view.url)


def status(client, method="GET", path="/state", **headers):
    """Return the status of a request with the cookie; a POST has the origin as well."""
    given = {"Cookie": client.own["Cookie"]} | ({"Origin": client.own["Origin"]} if method == "POST" else {})
    body = b"{}" if method == "POST" else None
    headers = {**given, **{name.replace("_", "-"): value for name, value in headers.items()}}
    headers = {name: value for name, value in headers.items() if value is not None}
    return client.ask(method, path, body, headers)[0]


def test_only_pages_of_its_own_origin_are_let_in(guarded):
    host, port = guarded.host, guarded.port
    assert status(guarded, Origin=f"http://{host}:{port}") == status(guarded) == 200
    assert status(guarded, "POST", "/control") == 400, "access is granted, but the command is missing"
    for origin in (
        "null",
        "http://example.org",
        f"http://localhost.example.org:{port}",
        f"http://{host}:{port + 1}",
        f"http://{host}",
        f"http://localhost:{port}",  # the page was not requested by this name
        f"http://{host}:{port}.example.org",
        f"http://{host}:{port}/",
        "",
    ):
        assert status(guarded, Origin=origin) == 403, origin
        assert status(guarded, "POST", "/control", Origin=origin) == 403, origin
        assert status(guarded, "POST", "/picture", Origin=origin) == 403, origin
    assert status(guarded, "POST", "/control", Origin=None) == 403, "a change needs an Origin"


def test_other_sites_on_this_computer_cannot_load_anything(guarded):
    """A page on another port is the same site, so its requests have the cookie, and images have no Origin."""
    for site in ("same-site", "cross-site"):
        assert status(guarded, path="/scene", Sec_Fetch_Site=site) == 403
        assert status(guarded, Sec_Fetch_Site=site) == 403
    assert status(guarded, Sec_Fetch_Site="same-origin") == status(guarded, Sec_Fetch_Site="none") == 200
    page = f"/?token={guarded.token}"
    assert guarded.ask("GET", page, None, {"Sec-Fetch-Site": "cross-site"})[0] == 200, (
        "a link with the token opens the page"
    )
    assert guarded.ask("GET", "/", None, {"Sec-Fetch-Site": "cross-site"})[0] == 403
    headers = guarded.ask("GET", "/state", None, {"Cookie": guarded.own["Cookie"]})[1]
    assert headers["Cross-Origin-Resource-Policy"] == "same-origin"
    assert "Access-Control-Allow-Origin" not in headers


def test_without_the_token_no_address_is_served(guarded):
    port, token = guarded.port, guarded.token
    wrong = token[:-1] + ("A" if token[-1] != "A" else "B")
    for path in (
        "/",
        "/?token=",
        f"/?token={wrong}",
        f"/?token={token[:5]}",
        "/?token=%C3%A4",
        "/?token=%FF",
    ):
        assert guarded.ask("GET", path, None, {})[0] == 403, path
    for path in ("/state", "/scene", "/nothing"):
        assert guarded.ask("GET", path, None, {})[0] == 403, path
    for cookie in (f"gsplat_edu_{port}={wrong}", f"gsplat_edu_{port + 1}={token}", "=;;", "\u00e4"):
        assert status(guarded, Cookie=cookie) == 403, cookie
    assert status(guarded, Cookie=f"other=1; gsplat_edu_{port}={token}") == 200
    assert status(guarded, "POST", "/control", Cookie=None) == 403

    code, headers, body = guarded.ask("GET", f"/?token={token}", None, {})
    assert code == 200 and b"<html" in body[:300].lower() and token.encode() not in body
    cookie = f"gsplat_edu_{port}={token}; Path=/; HttpOnly; SameSite=Strict"
    assert headers["Set-Cookie"] == cookie and headers["Referrer-Policy"] == "no-referrer"
    assert "frame-ancestors 'none'" in headers["Content-Security-Policy"]
    assert guarded.ask("GET", "/", None, {"Cookie": cookie.partition(";")[0]})[0] == 200


@pytest.mark.parametrize("name", ["evil.example.org:PORT", "192.168.0.7:PORT", "", "a:PORT"])
def test_a_foreign_host_name_is_refused(guarded, name):
    """With DNS rebinding, a foreign page has the same origin and even the token."""
    port, page = guarded.port, f"/?token={guarded.token}"
    assert guarded.ask("GET", page, None, {"Host": name.replace("PORT", str(port))})[0] == 403
    # through a tunnel the port differs, but host and origin have the same port
    assert guarded.ask("GET", page, None, {"Host": "localhost:9000"})[0] == 200
    headers = {"Host": "localhost:9000", "Origin": f"http://localhost:{port}"}
    assert guarded.ask("GET", page, None, headers)[0] == 403


def test_each_server_has_its_own_token():
    tokens = {Guard("127.0.0.1", 80).token for _ in range(100)}
    assert len(tokens) == 100 and all(len(token) >= 22 for token in tokens)  # 16 bytes in base64


def test_a_request_that_trickles_in_is_cut_off(guarded, monkeypatch):
    monkeypatch.setattr(serve, "REQUEST_SECONDS", 0.2)
    with socket.create_connection((guarded.host, guarded.port), timeout=PATIENCE) as connection:
        until(lambda: is_closed(connection, b"G"), "the end of the connection")
    assert status(guarded) == 200
