"""Links and odd files in a library: nothing outside is sent, and trouble with one entry does not hide the others."""

import json
import os
from urllib.parse import quote

import pytest

from systems import needs_posix

pytestmark = needs_posix

SECRET = "nobody else should read this"


@pytest.fixture
def run(studio):
    """A run without a scene, and its folder."""
    folder = studio.library.root / "runs" / "r"
    (folder / "renders" / "test").mkdir(parents=True)
    (folder / "config.json").write_text('{"format": 1}')
    (folder / "metrics.json").write_text(json.dumps({"test_views": [{"name": "a.jpg", "psnr": 20.0}]}))
    return folder


ROUTES = {
    "report.html": "/api/runs/r/report",
    "renders/test/a.png": "/api/runs/r/views/0/render.png",
    "log.jsonl": "/api/runs/r/curves",
    "metrics.json": "/api/runs/r/views",
}


@pytest.mark.parametrize("name", ROUTES)
def test_files_of_a_run_are_not_read_through_links_out_of_the_library(page, run, tmp_path, jpeg, name):
    secret = tmp_path / "secret"
    secret.write_bytes(SECRET.encode() if name.endswith("html") else jpeg)
    if name == "metrics.json":
        secret.write_text(json.dumps({"test_views": [{"name": SECRET}]}))
    (run / name).unlink(missing_ok=True)
    (run / name).symlink_to(secret)
    for route in (ROUTES[name], "/api/runs/r/views/0/render.jpg", "/api/compare?a=r&b=r"):
        answer = page.get(route)
        assert answer.status_code == 409 and SECRET not in answer.text, route
        assert "leads out of the library by a link" in answer.json()["error"]
    (listed,) = page.get("/api/library").json()["runs"]
    assert f"runs/r/{name}: leads out of the library" in listed["problem"]


@pytest.mark.parametrize("name", ROUTES)
def test_a_pipe_in_a_run_is_one_line_and_does_not_block(page, run, name):
    (run / name).unlink(missing_ok=True)
    os.mkfifo(run / name)
    answer = page.get(ROUTES[name])
    assert answer.status_code < 500 and "\n" not in answer.text
    assert page.get("/api/library").json()["runs"][0]["name"] == "r"


def test_a_report_that_is_a_folder_or_a_pipe_is_named(page, run):
    os.mkfifo(run / "report.html")
    assert (
        "report.html: cannot be read (is a pipe, not a file)"
        in page.get(ROUTES["report.html"]).json()["error"]
    )


@pytest.mark.parametrize("kind", ["photos", "captures", "runs", "scenes"])
@pytest.mark.parametrize("inside", ["", "odd/", "odd/deep/"])
@pytest.mark.parametrize("target", ["loop", "x" * 300, "gone"])
def test_a_link_that_cannot_be_followed_hides_nothing_else(page, studio, jpeg, kind, inside, target):
    root = studio.library.root
    (root / "photos" / "good").mkdir()
    (root / "photos" / "good" / "a.jpg").write_bytes(jpeg)
    link = root / kind / f"{inside}loop"
    link.parent.mkdir(parents=True, exist_ok=True)
    link.symlink_to(target)
    answer = page.get("/api/library")
    assert answer.status_code == 200, answer.text
    listed = answer.json()
    assert [entry["files"] for entry in listed["photos"] if entry["name"] == "good"] == [1]
    if not inside:
        (line,) = listed["trouble"]
        assert line.startswith(f"{kind}/loop: is a link that leads nowhere (")
    else:
        assert listed["trouble"] == [] and [entry["name"] for entry in listed[kind]][-1] == "odd"
    assert page.post("/api/adopt", json={"kind": kind, "path": str(link)}).status_code == 400


def test_an_entry_that_cannot_be_read_is_named_and_the_others_are_listed(page, studio, jpeg):
    """A name that the system refuses stands for a folder without permissions, which root may read all the same."""
    root = studio.library.root
    (root / "captures" / "odd").mkdir()
    (root / "captures" / "odd" / "transforms.json").symlink_to("x" * 300)
    (root / "captures" / "good").mkdir()
    answer = page.get("/api/library")
    assert answer.status_code == 200, answer.text
    assert [entry["name"] for entry in answer.json()["captures"]] == ["good"]
    (line,) = answer.json()["trouble"]
    assert "captures/odd/transforms.json: file name too long" in line


@pytest.mark.parametrize("kind", ["photos", "captures", "runs", "scenes"])
def test_a_place_that_cannot_be_read_is_not_adopted(page, studio, tmp_path, kind):
    os.mkfifo(tmp_path / "pipe.ply")
    (tmp_path / "loop").symlink_to("loop")
    places = [tmp_path / "pipe.ply", "/dev/null", "/dev/zero", tmp_path / "loop", tmp_path / ("x" * 300)]
    for place in places:
        answer = page.post("/api/adopt", json={"kind": kind, "path": str(place)})
        assert answer.status_code == 400 and answer.json()["error"].startswith("path: "), answer.text
        assert list((studio.library.root / kind).iterdir()) == []


@pytest.mark.parametrize("kind", ["photos", "captures", "runs", "scenes"])
def test_a_folder_without_permissions_hides_nothing_else(page, studio, tmp_path, kind):
    closed, root = tmp_path / "closed", studio.library.root
    (closed / "inner").mkdir(parents=True)
    closed.chmod(0)
    try:
        if may_read(closed):
            pytest.skip("this user may read every folder")
        (root / kind / "link").symlink_to(closed / "inner")
        (root / kind / "odd").mkdir(mode=0)
        (root / kind / "good").mkdir()
        answer = page.get("/api/library")
        assert answer.status_code == 200, answer.text
        assert "good" in [entry["name"] for entry in answer.json()[kind]]
        assert any("permission denied" in line for line in answer.json()["trouble"]), answer.json()["trouble"]
        for place in (closed, closed / "inner"):
            answer = page.post("/api/adopt", json={"kind": kind, "path": str(place), "name": "new"})
            assert answer.status_code == 400 and not os.path.lexists(root / kind / "new"), answer.text
    finally:
        closed.chmod(0o700)


def may_read(folder):
    try:
        list(folder.iterdir())
    except PermissionError:
        return False
    return True


def test_photos_with_any_name_have_thumbnails(page, studio, jpeg):
    folder = studio.library.root / "photos" / "trip" / "day 1: sea?"
    folder.mkdir(parents=True)
    names = ["12:30.jpg", "what?.jpg", 'a "b" |*.jpg', "-first.jpg", "back\\slash.jpg", "u\u0308.jpg"]
    for name in names:
        (folder / name).write_bytes(jpeg)
    listed = {photo["name"] for photo in page.get("/api/photos/trip/photos").json()["photos"]}
    assert listed == {f"{folder.name}/{name}" for name in names}
    for name in listed:
        answer = page.get(f"/api/photos/trip/thumbs/{quote(name)}?side=256")
        assert answer.status_code == 200 and answer.content[:2] == b"\xff\xd8", answer.text
    for name in ("../trip/a.jpg", "%2e%2e/secret.jpg", "day 1: sea?//12:30.jpg", ".hidden.jpg", "a%00.jpg"):
        answer = page.get(f"/api/photos/trip/thumbs/{quote(name, safe='%/')}?side=256")
        assert answer.status_code in (400, 404), name


@pytest.mark.parametrize("number", ["9" * 400, "1.2.3", "1e999", "Infinity", "-1", "NaN"])
def test_impossible_numbers_in_a_log_hide_nothing(page, run, number):
    line = (
        f'{{"iteration": {number}, "loss": 0.5, "num_gaussians": {number}, "ms": 1.0, "seconds": {number}}}\n'
    )
    (run / "log.jsonl").write_text(line)
    (run / "metrics.json").unlink()
    answer = page.get("/api/library")
    assert answer.status_code == 200, answer.text
    assert answer.json()["runs"][0]["iterations"] is None
    assert page.get("/api/runs/r/curves").status_code == 200


@pytest.mark.parametrize("number", ["1e999", "nan", "-inf", "two"])
def test_a_forecast_is_asked_for_at_a_finite_resolution(page, studio, number):
    (studio.library.root / "captures" / "c").mkdir()
    answer = page.get(f"/api/captures/c/forecast?resolution={number}")
    assert answer.status_code == 400 and "has to be a number or auto" in answer.json()["error"]
