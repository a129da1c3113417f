"""Every server's guard: only requests that name this computer and, with a token, its own page may connect."""

import http.client
import urllib.parse

import pytest
from starlette.requests import Request
from starlette.responses import PlainTextResponse

from gsplat_edu.server.guard import Guard
from gsplat_edu.server.serving import Server
from waiting import PATIENCE

POLICY = "default-src 'none'; frame-ancestors 'none'"


async def application(scope, receive, send):
    """Answer any request with its method and path."""
    if scope["type"] == "http":
        request = Request(scope, receive)
        await PlainTextResponse(f"{request.method} {request.url.path}")(scope, receive, send)
    else:
        for kind in ("startup", "shutdown"):
            await receive()
            await send({"type": f"lifespan.{kind}.complete"})


def started(server):
    guard = Guard(application, server.host, POLICY, server.token, server.cookie)
    server.start(guard)
    return server


@pytest.fixture(scope="module")
def server():
    with Server(token=True) as made:
        yield started(made)


def ask(server, method="GET", path="/state", **headers):
    """Return status, headers and text of the answer to a request with these headers and no other ones."""
    connection = http.client.HTTPConnection("127.0.0.1", server.port, timeout=PATIENCE)
    try:
        connection.putrequest(method, path, skip_host="Host" in headers, skip_accept_encoding=True)
        for name, values in headers.items():
            for value in values if isinstance(values, list) else [values]:
                connection.putheader(name.replace("_", "-"), value)
        connection.endheaders()
        answer = connection.getresponse()
        return answer.status, answer.headers, answer.read().decode()
    finally:
        connection.close()


def status(server, method="GET", path="/state", **headers):
    """Return the status of a request with the cookie, and for a change with the origin; None takes one away."""
    given = {"Cookie": f"{server.cookie}={server.token}"}
    if method not in ("GET", "HEAD"):
        given["Origin"] = f"http://127.0.0.1:{server.port}"
    return ask(server, method, path, **{n: v for n, v in (given | headers).items() if v is not None})[0]


def foreign_origins(port):
    return (
        "null",
        "http://example.org",
        f"http://localhost.example.org:{port}",
        f"http://127.0.0.1:{port + 1}",
        "http://127.0.0.1",
        f"http://localhost:{port}",  # the page was not requested by this name
        f"http://127.0.0.1:{port}.example.org",
        f"http://127.0.0.1:{port}/",
        "",
    )


@pytest.mark.parametrize("method", ["GET", "HEAD", "POST", "PUT", "DELETE", "PATCH"])
def test_only_pages_of_its_own_origin_are_let_in(server, method):
    own = f"http://127.0.0.1:{server.port}"
    assert status(server, method, Origin=own) == status(server, method) == 200
    assert status(server, method, Origin=[own, own]) == 403
    bearer = {"Cookie": None, "Authorization": f"Bearer {server.token}"}
    for origin in foreign_origins(server.port):
        assert status(server, method, Origin=origin) == 403, origin
        assert status(server, method, Origin=origin, **bearer) == 403, origin
    if method not in ("GET", "HEAD"):
        assert status(server, method, Origin=None) == 403, "a change needs an Origin"


def test_other_sites_on_this_computer_cannot_load_anything(server):
    """A page on another port is the same site, so its requests have the cookie, and images have no Origin."""
    bearer = {"Cookie": None, "Authorization": f"Bearer {server.token}"}
    for site in ("same-site", "cross-site", "x", ["none", "cross-site"]):
        for path in ("/", "/state"):
            assert status(server, path=path, Sec_Fetch_Site=site) == 403, (site, path)
            assert status(server, path=path, Sec_Fetch_Site=site, **bearer) == 403, (site, path)
        assert status(server, "POST", Sec_Fetch_Site=site) == 403, site
    assert status(server, Sec_Fetch_Site="same-origin") == status(server, Sec_Fetch_Site="none") == 200
    opened = f"/?token={server.token}"
    assert ask(server, path=opened, Sec_Fetch_Site="cross-site")[0] == 200, (
        "a link with the token opens the page"
    )


def test_without_the_token_no_address_is_served(server):
    token = server.token
    wrong = token[:-1] + ("A" if token[-1] != "A" else "B")
    queries = ("", "?token=", f"?token={wrong}", f"?token={token[:5]}", "?token=%C3%A4", "?token=%FF")
    for path in (*(f"/{query}" for query in queries), "/state", "/nothing", "/../x"):
        for method in ("GET", "HEAD", "POST", "DELETE"):
            answer = ask(server, method, path, Origin=f"http://127.0.0.1:{server.port}")
            assert answer[0] == 403 and answer[1]["Set-Cookie"] is None, (method, path)
            assert answer[2].startswith("403 Forbidden: ") or method == "HEAD"
            assert answer[2].count("\n") == (method != "HEAD")


def test_a_token_counts_only_where_the_page_is_opened(server):
    for path in (f"/state?token={server.token}", f"//?token={server.token}"):
        assert ask(server, path=path)[0] == 403, path
    own = f"http://127.0.0.1:{server.port}"
    assert ask(server, "POST", f"/?token={server.token}", Origin=own)[0] == 403


def test_cookies_and_headers_with_anything_but_the_token_are_refused(server):
    port, token = server.port, server.token
    wrong = token[:-1] + ("A" if token[-1] != "A" else "B")
    for cookie in (
        f"gsplat_edu_{port}={wrong}",
        f"gsplat_edu_{port + 1}={token}",
        f"gsplat_edu_other={token}",
        "gsplat_edu_1=x",
        "=;;",
        "\x01;;=,",
        "\u00e4",
    ):
        assert status(server, Cookie=cookie) == 403, cookie
    assert status(server, Cookie=f"other=1; gsplat_edu_{port}={token}") == 200
    assert status(server, Cookie=["\x01;;=,", f"gsplat_edu_{port}={token}"]) == 200
    for value in (token, f"Bearer {wrong}", f"Basic {token}", f"Bearer  {token}", "Bearer"):
        assert status(server, Cookie=None, Authorization=value) == 403, value


@pytest.mark.parametrize("method", ["GET", "POST", "DELETE"])
def test_programs_use_the_token_in_a_header(server, method):
    assert ask(server, method, Authorization=f"Bearer {server.token}")[0] == 200


def test_the_url_opens_the_page_and_gives_a_cookie_that_no_other_site_can_use(server):
    parts = urllib.parse.urlsplit(server.url)
    assert server.url == f"http://127.0.0.1:{server.port}/?token={server.token}"
    answered, headers, text = ask(server, path=f"{parts.path}?{parts.query}")
    assert (answered, text) == (200, "GET /")
    cookie = f"gsplat_edu_{server.port}={server.token}"
    assert headers["Set-Cookie"] == f"{cookie}; Path=/; HttpOnly; SameSite=Strict"
    assert ask(server, path="/", Cookie=cookie)[0] == 200
    assert ask(server, path="/", Cookie=cookie)[1]["Set-Cookie"] is None


def test_every_answer_has_the_headers_that_keep_other_pages_out(server):
    for answer in (ask(server), ask(server, path=f"/?token={server.token}"), ask(server, Host="example.org")):
        headers = answer[1]
        assert headers["Content-Security-Policy"] == POLICY
        assert headers["X-Content-Type-Options"] == "nosniff"
        assert headers["Cross-Origin-Resource-Policy"] == "same-origin"
        assert headers["Cross-Origin-Opener-Policy"] == "same-origin"
        assert headers["Referrer-Policy"] == "no-referrer" and headers["Cache-Control"] == "no-store"
        assert "Access-Control-Allow-Origin" not in headers


@pytest.mark.parametrize(
    "name", ["evil.example.org:PORT", "127.0.0.1.evil.example:PORT", "192.168.0.7:PORT", "", "a:PORT"]
)
def test_a_foreign_host_name_is_refused(server, name):
    """With DNS rebinding, a foreign page has the same origin and even the token."""
    host = name.replace("PORT", str(server.port))
    opened = f"/?token={server.token}"
    assert ask(server, path=opened, Host=host)[0] == 403
    assert ask(server, Authorization=f"Bearer {server.token}", Host=host)[0] == 403
    assert status(server, "POST", Host=host, Origin=f"http://{host}") == 403
    # through a tunnel the port differs, but host and origin have the same port
    assert ask(server, path=opened, Host="localhost:9000")[0] == 200
    assert ask(server, path=opened, Host="localhost:9000", Origin="http://localhost:9000")[0] == 200
    assert ask(server, path=opened, Host="localhost:9000", Origin=f"http://localhost:{server.port}")[0] == 403


def test_without_a_token_only_the_host_name_is_checked():
    with Server() as server:
        started(server)
        assert server.token == "" and server.url == f"http://127.0.0.1:{server.port}/"
        headers = {"Origin": "http://example.org", "Sec_Fetch_Site": "cross-site"}
        assert ask(server, "POST", "/x", **headers)[2] == "POST /x"
        assert ask(server, path="/?token=")[1]["Set-Cookie"] is None
        assert ask(server, Host=f"evil.example.org:{server.port}")[0] == 403


def test_each_server_has_its_own_token():
    tokens = set()
    for _ in range(20):
        with Server(token=True) as one:
            tokens.add(one.token)
    assert len(tokens) == 20 and all(len(token) >= 22 for token in tokens)  # 16 bytes in base64
