"""The studio's application: it is guarded, has a policy, serves its page's files and refuses other bodies than JSON."""

import shlex

import pytest
from starlette.testclient import TestClient

from gsplat_edu.studio.app import application
from studio.conftest import HOST, TOKEN


@pytest.fixture
def stranger(studio):
    """A client without cookie, Origin or token."""
    with TestClient(application(studio, TOKEN), base_url=HOST) as client:
        yield client


def test_the_url_with_the_token_opens_the_page_and_sets_the_cookie(stranger):
    answer = stranger.get("/", params={"token": TOKEN}, headers={"Sec-Fetch-Site": "cross-site"})
    assert answer.status_code == 200 and "<title>" in answer.text
    cookie = answer.headers["set-cookie"]
    assert "HttpOnly" in cookie and "SameSite=Strict" in cookie and "Path=/" in cookie
    assert stranger.get("/api/library").status_code == 200  # the cookie is enough
    assert "set-cookie" not in stranger.get("/api/library").headers


@pytest.mark.parametrize(
    "headers",
    [
        {},
        {"Authorization": "Bearer wrong"},
        {"Authorization": f"Bearer {TOKEN}", "Host": "evil.example"},  # DNS rebinding
        {"Authorization": f"Bearer {TOKEN}", "Origin": "http://evil.example"},
        {"Authorization": f"Bearer {TOKEN}", "Sec-Fetch-Site": "same-site"},
    ],
    ids=str,
)
def test_every_address_is_guarded(stranger, headers):
    """What the guard refuses is in tests/server/test_guard.py."""
    for path in ("/api/library", "/", "/web/index.html", "/api/events", "/nothing"):
        answer = stranger.get(path, headers=headers)
        assert answer.status_code == 403 and answer.text.startswith("403 Forbidden: "), path
        assert "set-cookie" not in answer.headers and "access-control-allow-origin" not in answer.headers
    assert stranger.delete("/api/trash", headers=headers).status_code == 403


def test_a_person_without_the_token_reads_what_to_open(stranger):
    """After a restart, reloading the page used to say "403 Forbidden" only."""
    answer = stranger.get("/", headers={"Accept": "text/html,application/xhtml+xml"})
    assert answer.status_code == 403 and answer.headers["content-type"].startswith("text/html")
    assert "begins with\n<strong>http://127.0.0.1:8090/?token=</strong>" in answer.text
    assert TOKEN not in answer.text and "library" not in answer.text
    rebinding = {"Accept": "text/html", "Host": "evil.example"}
    assert stranger.get("/", headers=rebinding).text.startswith("403 Forbidden: ")


@pytest.mark.parametrize(("at_once", "more"), [(1, ""), (3, " --jobs 3")])
def test_the_page_knows_the_whole_command_that_starts_the_studio_again(page, studio, at_once, more):
    studio.queue.at_once = at_once
    command = page.get("/api/library").json()["start"]
    assert command == f"gsplat-edu studio {shlex.quote(str(studio.library.root))}{more}"


def test_every_answer_has_the_headers_that_keep_other_pages_out(page, stranger):
    answers = [(page.get("/"), "none"), (page.get("/api/library"), "none"), (stranger.get("/"), "none")]
    answers += [(page.get("/api/nothing/x"), "self")]  # the studio's own page may have wanted it for a frame
    for answer, ancestors in answers:
        policy = answer.headers["content-security-policy"]
        assert "default-src 'none'" in policy and "unsafe" not in policy
        assert policy.endswith(f"frame-ancestors '{ancestors}'")
        assert answer.headers["x-content-type-options"] == "nosniff"
        assert answer.headers["cross-origin-resource-policy"] == "same-origin"
        assert answer.headers["referrer-policy"] == "no-referrer"


@pytest.mark.parametrize(
    "path",
    [
        "/web/../app.py",
        "/web/%2e%2e/app.py",
        "/web/..%2fapp.py",
        "/viewer/__init__.py",
        "/viewer/web/__init__.py",
        "/web/nothing.js",
        "/web/",
    ],
)
def test_only_the_files_of_the_page_are_served(page, path):
    assert page.get(path).status_code in (404, 405)


def test_the_scripts_of_the_viewer_are_served(page):
    answer = page.get("/viewer/web/patch.js")
    assert answer.status_code == 200 and answer.headers["content-type"].startswith("text/javascript")
    again = page.get("/viewer/web/patch.js", headers={"If-None-Match": answer.headers["etag"]})
    assert again.status_code == 304


@pytest.mark.parametrize(
    ("body", "kind", "status"),
    [
        (b"{", "application/json", 400),
        (b"[1]", "application/json", 400),
        (b'{"kind":"photos"}', "text/plain", 415),
        (b'{"kind":"photos"}', "application/x-www-form-urlencoded", 415),
        (b'{"a":NaN}', "application/json", 400),
        (b"[" * 100_000, "application/json", 400),
    ],
    ids=lambda value: str(value)[:30],
)
def test_bodies_that_are_no_json_objects_are_refused_in_one_line(page, body, kind, status):
    answer = page.post("/api/adopt", content=body, headers={"Content-Type": kind})
    assert answer.status_code == status and answer.json()["error"].count("\n") == 0
