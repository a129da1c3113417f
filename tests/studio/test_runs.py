"""Curves, views, comparison, page and edits of a run over HTTP."""

import io
import json
import shutil

import numpy as np
import pytest
from PIL import Image

from gsplat_edu.base.files import written_aside
from gsplat_edu.data.procedural import procedural_capture
from gsplat_edu.data.writers import write_colmap
from gsplat_edu.edits.identity import identity_of
from gsplat_edu.evaluate.comparison import save_comparison
from gsplat_edu.jobs import events
from gsplat_edu.jobs.record import Work
from gsplat_edu.runs.folder import RunFolder
from gsplat_edu.runs.source import open_source
from gsplat_edu.scene.camera import Camera
from gsplat_edu.scene.views import View
from gsplat_edu.studio import runs as runs_module
from gsplat_edu.studio.runs import GAIN
from processes import Program


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A capture and a run of 40 iterations."""
    folder = tmp_path_factory.mktemp("trained")
    write_colmap(folder / "box", *procedural_capture(24, 6))
    words = [
        "train",
        folder / "box",
        "--out",
        folder / "r",
        "--iterations",
        40,
        "--test-every",
        3,
        "--eval-every",
        20,
    ]
    code = "import sys; from gsplat_edu.cli.main import main; sys.exit(main(sys.argv[1:]))"
    assert Program(code, words, folder).ended()[0] == 0
    return folder


@pytest.fixture
def run(studio, trained):
    """The run in the studio, and its folder."""
    shutil.copytree(trained / "r", studio.library.root / "runs" / "r")
    return RunFolder(studio.library.root / "runs" / "r")


def test_a_run_is_listed_with_its_scores(page, run):
    (found,) = page.get("/api/library").json()["runs"]
    metrics = run.read_metrics()
    assert found["psnr"] == metrics["test"]["psnr"] and found["num_gaussians"] == metrics["num_gaussians"]
    assert (found["iterations"], found["planned"], found["finished"]) == (40, 40, True)
    run.metrics.unlink()
    found = page.get("/api/runs/r").json()
    assert (found["iterations"], found["finished"], found["psnr"]) == (40, False, None)
    run.config.write_text("{")
    assert page.get("/api/runs/r").json()["problem"].startswith(f"{run.config}: is not JSON")


def test_curves_of_a_log_that_is_replaced_meanwhile_begin_anew(page, run, monkeypatch):
    """A resumed training puts a shortened log in place of the old one, here while the old one is being read."""
    log = run.log_file.read_text()
    begin = runs_module.open_file

    def opened(path):
        found = begin(path)
        with written_aside(path) as aside:
            aside.write_text(log)
        return found

    with monkeypatch.context() as patch:
        patch.setattr(runs_module, "open_file", opened)
        token = page.get("/api/runs/r/curves").json()["next"]
    assert page.get("/api/runs/r/curves", params={"after": token}).json()["reset"]


def test_curves_are_read_as_they_grow(page, run):
    log = run.log_file.read_text()
    run.log_file.write_text("")
    inode = run.log_file.stat().st_ino
    half = log.index("\n", len(log) // 2) + 5
    found, token = {"iteration": [], "psnr": []}, ""
    for end in (half, len(log)):
        with run.log_file.open("a") as file:
            file.write(log[run.log_file.stat().st_size : end])
        answer = page.get("/api/runs/r/curves", params={"after": token}).json()
        assert answer["reset"] is (token == "")
        token = answer["next"]
        found["iteration"] += answer["points"]["iteration"]
        found["psnr"] += answer["scores"]["psnr"]
    entries = [json.loads(line) for line in log.splitlines()]
    assert (
        found["iteration"] == [entry["iteration"] for entry in entries if "loss" in entry] == [10, 20, 30, 40]
    )
    assert (
        found["psnr"] == [entry["psnr"] for entry in entries if "psnr" in entry] and len(found["psnr"]) == 1
    )
    again = page.get("/api/runs/r/curves", params={"after": token}).json()
    assert again["points"]["iteration"] == [] and again["next"] == token and not again["reset"]
    run.log_file.write_text(log[:half])  # shorter, as after a resumption
    assert run.log_file.stat().st_ino == inode
    assert page.get("/api/runs/r/curves", params={"after": token}).json()["reset"]
    other = run.log_file.with_name("other")
    other.write_text(log + log)
    other.replace(run.log_file)  # another file, although it is longer
    assert page.get("/api/runs/r/curves", params={"after": token}).json()["reset"]


def test_held_out_views_are_sorted_and_have_pictures(page, run):
    views = page.get("/api/runs/r/views").json()["views"]
    scores = {view["name"]: view["psnr"] for view in run.read_metrics()["test_views"]}
    assert [view["psnr"] for view in views] == sorted(scores.values()) and len(views) == 2
    pictures = {}
    for what in ("render", "photo", "difference"):
        answer = page.get(f"/api/runs/r/views/{views[0]['index']}/{what}.png")
        assert answer.headers["content-type"] == "image/png"
        with Image.open(io.BytesIO(answer.content)) as image:
            pictures[what] = np.asarray(image, dtype=np.int64)
    apart = abs(pictures["render"] - pictures["photo"])
    np.testing.assert_array_equal(pictures["difference"], np.minimum(GAIN * apart, 255))
    score = -10 * np.log10(np.mean((apart / 255) ** 2))
    assert abs(score - views[0]["psnr_8bit"]) < 0.01  # the pictures are those of this view that were scored
    assert (views[0]["H"], views[0]["W"]) == pictures["photo"].shape[:2]
    for path in ("9/photo.png", "9/photo.jpg", "0/secret.jpg", "x/photo.png", "0/secret.png"):
        assert page.get(f"/api/runs/r/views/{path}").status_code == 404


def test_previews_are_small_and_made_once(page, run, studio):
    (index, view) = next(enumerate(run.read_metrics()["test_views"]))
    (path,) = (run.path / "renders" / "test").glob(f"{view['name'].removesuffix('.png')}*")
    photo, render = (np.full((600, 900, 3), color, np.uint8) for color in ((180, 100, 60), (200, 100, 50)))
    save_comparison(path, photo, render)
    wanted = {"render": (200, 100, 50), "photo": (180, 100, 60), "difference": (80, 0, 40)}
    for what, color in wanted.items():
        answer = page.get(f"/api/runs/r/views/{index}/{what}.jpg")
        assert answer.headers["content-type"] == "image/jpeg"
        with Image.open(io.BytesIO(answer.content)) as image:
            assert image.size == (512, 341)
            assert np.abs(np.asarray(image, int) - color).max() <= 3  # 8-bit levels, rounded by JPEG
        etag = answer.headers["etag"]
        assert page.get(answer.request.url, headers={"If-None-Match": etag}).status_code == 304
    studio.decoder.close()  # no picture is decoded again
    assert page.get(f"/api/runs/r/views/{index}/photo.jpg").status_code == 200
    path.unlink()
    assert page.get(f"/api/runs/r/views/{index}/photo.jpg").status_code == 404


def test_two_runs_are_compared_view_by_view(page, run):
    shutil.copytree(run.path, run.path.with_name("s"))
    other = RunFolder(run.path.with_name("s"))
    metrics = other.read_metrics()
    first, second = (view["name"] for view in metrics["test_views"])
    metrics["test_views"][0]["psnr"] += 1.5
    metrics["test_views"][1]["name"] = "elsewhere.png"
    other.write_metrics(metrics)
    found = page.get("/api/compare", params={"a": "r", "b": "s"}).json()
    assert [(view["name"], round(view["gain"], 9)) for view in found["views"]] == [(first, 1.5)]
    assert (found["only_a"], found["only_b"]) == ([second], ["elsewhere.png"])
    assert page.get("/api/compare", params={"a": "r", "b": "none"}).status_code == 404


def test_the_report_is_served_without_rights(page, run):
    answer = page.get("/api/runs/r/report")
    assert answer.status_code == 200
    policy = answer.headers["content-security-policy"]
    assert policy.startswith("sandbox;") and "script" not in policy


def test_the_page_of_a_scene_brings_its_own_policy(page, run):
    answer = page.get("/api/runs/r/page")
    assert answer.status_code == 200 and b'class="splats"' in answer.content
    policy = answer.headers["content-security-policy"]
    assert "sha256-" in policy and policy.endswith("frame-ancestors 'self'")
    assert page.get("/api/runs/r/page", headers={"If-None-Match": answer.headers["etag"]}).status_code == 304
    assert page.get("/api/runs/r/scene").content == run.latest_scene()[0].read_bytes()


def test_a_file_that_is_no_scene_ends_in_one_line(page, studio):
    folder = studio.library.root / "scenes" / "a"
    folder.mkdir()
    assert page.get("/api/scenes/a/page").status_code == 400
    (folder / "a.spz").write_bytes(b"no scene")
    answer = page.get("/api/scenes/a/page")
    assert answer.status_code == 400 and answer.json()["error"].startswith(str(folder / "a.spz"))


def document(run, *operations):
    source = open_source(run.path)
    scene = identity_of(source.scene).document()
    return json.dumps(
        {"format": "gsplat_edu edits", "version": 1, "scene": scene, "operations": list(operations)}
    )


def test_edits_of_two_tabs_do_not_overwrite_each_other(page, run):
    url = "/api/runs/r/edits.json"
    first = page.get(url)
    assert first.text == "null\n"
    edits = document(run)
    mine = page.put(url, content=edits, headers={"If-Match": first.headers["etag"]})
    assert mine.status_code == 200 and (run.path / "edits.json").read_text() == edits
    late = page.put(url, content=edits, headers={"If-Match": first.headers["etag"]})
    assert late.status_code == 412 and "changed elsewhere" in late.text
    assert page.put(url, content=edits).status_code == 412
    again = page.get(url)
    assert again.text == edits and again.headers["etag"] == mine.headers["etag"]
    assert page.put(url, content=edits + "\n", headers={"If-Match": again.headers["etag"]}).status_code == 200
    assert page.get("/api/runs/r").json()["edited"] is True


@pytest.mark.parametrize("damage", ["{", '{"format":"x"}', "other scene", "unknown"])
def test_damaged_edits_are_not_stored(page, run, damage):
    edits = {
        "other scene": lambda: document(run).replace('"count": ', '"count": 1'),
        "unknown": lambda: document(run, {"do": "explode"}),
    }.get(damage, lambda: damage)()
    answer = page.put("/api/runs/r/edits.json", content=edits, headers={"If-Match": "none"})
    assert (
        answer.status_code == 400 and answer.text.startswith("edits.json: ") and answer.text.count("\n") == 1
    )
    assert not (run.path / "edits.json").exists()


def test_the_cover_of_a_run_is_its_start_view_in_the_shape_of_a_card(page, run):
    answer = page.get("/api/runs/r/cover")
    assert answer.status_code == 200 and answer.headers["content-type"] == "image/jpeg"
    assert Image.open(io.BytesIO(answer.content)).size == (512, 384)


def test_findings_name_photos(page, studio, trained):
    shutil.copytree(trained / "box", studio.library.root / "captures" / "box")
    assert page.get("/api/captures/box/findings").json()["job"] is None
    page.post("/api/jobs", json={"command": "doctor", "subject": "captures/box"})
    found = events.Found("blur", "warning", "is blurred", "leave it out", ("view_001.png", "gone.png"))
    log = [
        events.Started(1, ""),
        events.Stage("photos"),
        found,
        events.Diagnosed((("a", "b"),), ("files",), ("train",)),
    ]
    path = studio.queue.files("000001").events
    path.write_text("".join(events.line_of(event, 1.0) for event in [*log, *log]))  # the command ran twice
    answer = page.get("/api/captures/box/findings").json()
    (finding,) = answer["findings"]
    assert finding["photos"] == ["captures/box/images/view_001.png", None]
    assert (answer["fine"], answer["advice"], answer["facts"]) == (["files"], ["train"], [["a", "b"]])
    assert page.get("/api/captures/box/thumbs/images/view_001.png").status_code == 200


def test_what_is_certain_about_a_capture_is_there_before_anyone_examines_it(page, studio):
    views, points, colors = procedural_capture(16, 12)
    one, eye = views[3].camera, np.array([9000.0, 0.0, -4000.0])
    far = Camera(one.R, eye, one.fx, one.fy, one.cx, one.cy, one.H, one.W)
    views[3] = View(far, views[3].read().image, name=views[3].name)
    write_colmap(studio.library.root / "captures" / "far", views, points, colors)
    answer = page.get("/api/captures/far/findings").json()
    (finding,) = (one for one in answer["findings"] if one["name"] == "wrong poses")
    assert finding["photos"] == [f"captures/far/images/{views[3].name}"]
    assert answer["job"] is None and "gsplat-edu" not in finding["advice"]


def test_exports_are_listed_with_their_figures(page, studio, run):
    (run.path / "exports").mkdir()
    path = run.path / "exports" / "<b>r.compressed.ply"
    path.write_bytes(b"scene")
    job = studio.queue.submit(Work("convert", ("runs/r",), (f"runs/r/exports/{path.name}",)))
    lines = [events.Metric("psnr", 31.5, "dB", str(path)), events.Finished((str(path),))]
    studio.queue.files(job.id).events.write_text("".join(events.line_of(event, 1.0) for event in lines))
    studio.queue._ended(studio.queue.get(job.id), 0)
    (found,) = page.get("/api/runs/r/exports").json()["exports"]
    assert (found["psnr"], found["bytes"], found["format"]) == (31.5, 5, "compressed.ply")
    answer = page.get("/api/runs/r/exports/<b>r.compressed.ply")
    assert answer.content == b"scene" and answer.headers["content-type"] == "application/octet-stream"
    assert answer.headers["content-disposition"].startswith("attachment; filename*=utf-8''%3Cb%3Er")
    assert page.delete("/api/runs/r/exports/<b>r.compressed.ply").status_code == 200
    assert page.get("/api/runs/r/exports").json()["exports"] == []
