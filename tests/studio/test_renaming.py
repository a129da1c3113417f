"""Names follow a project: all of them are renamed or none, links and origins stay, jobs refuse by name."""

import json

import pytest

from gsplat_edu.cli.main import main
from gsplat_edu.data.procedural import procedural_capture
from gsplat_edu.data.writers import write_colmap
from gsplat_edu.jobs.record import Work
from gsplat_edu.server.refusal import RefusedError, conflict
from gsplat_edu.studio.renaming import FORMER, FormerNames, names_along, rename_all
from gsplat_edu.studio.state import Studio

PARENTS = {
    "captures/toy": "photos/toy",
    "runs/toy": "captures/toy",
    "runs/toy-run-2": "captures/toy",
    "runs/best": "captures/toy",
    "runs/toys": "captures/toy",
    "scenes/toy": "runs/best",
    "runs/toy-of-others": "captures/other",
}


@pytest.fixture
def trained(studio):
    """A capture and a run that a program outside the studio trained: only the run's config names the capture."""
    root = studio.library.root
    write_colmap(root / "captures" / "toy", *procedural_capture(32, 6, splats=50))
    for name in ("toy", "best"):
        run = root / "runs" / name
        run.mkdir(parents=True)
        config = {"data": {"path": str(root / "captures" / "toy")}, "train": {"iterations": 10}}
        (run / "config.json").write_text(json.dumps({"format": 1, **config}))
    return studio


def made_from(page):
    return {one["entry"]: one["made_from"] for one in page.get("/api/library").json()["runs"]}


def test_what_came_from_an_entry_and_has_its_name_is_renamed():
    assert names_along("photos/toy", "bear", PARENTS) == {
        "photos/toy": "photos/bear",
        "captures/toy": "captures/bear",
        "runs/toy": "runs/bear",
        "runs/toy-run-2": "runs/bear-run-2",
        "scenes/toy": "scenes/bear",
    }
    assert names_along("runs/best", "good", PARENTS) == {"runs/best": "runs/good"}


@pytest.mark.parametrize(
    "names", [{"a/x": "a/y", "b/x": "b/y", "c/x": "c/y"}, {"a/x": "a/y", "a/w": "a/x", "c/x": "c/y"}]
)
def test_one_that_fails_puts_the_names_back(names):
    """Also if one entry has got the former name of another."""
    now = dict(zip(names, range(3), strict=True)) | {"c/y": 3}
    before = now.copy()

    def rename(old, new):
        if new in now:
            raise conflict(f"{new}: exists already; choose another name")
        now[new] = now.pop(old)

    with pytest.raises(RefusedError, match=r"c/y: exists already; .*; all names are as before"):
        rename_all(names, rename)
    assert now == before


def test_a_project_is_renamed_with_its_links(page, trained):
    answer = page.post("/api/captures/toy/rename", json={"to": "bear", "along": True})
    assert answer.status_code == 200, answer.text
    assert answer.json()["renamed"] == {"captures/toy": "captures/bear", "runs/toy": "runs/bear"}
    assert made_from(page) == {"runs/bear": "captures/bear", "runs/best": "captures/bear"}
    assert page.post("/api/captures/bear/rename", json={"to": "fox"}).status_code == 200
    assert made_from(page) == {"runs/bear": "captures/fox", "runs/best": "captures/fox"}
    (project,) = page.get("/api/library").json()["projects"]
    assert set(project["entries"]) == {"captures/fox", "runs/bear", "runs/best"}


def test_the_links_outlast_the_server_and_a_new_entry_of_the_old_name(page, trained):
    page.post("/api/captures/toy/rename", json={"to": "bear"})
    root = trained.library.root
    write_colmap(root / "captures" / "toy", *procedural_capture(32, 6, splats=50))
    assert made_from(page) == {"runs/toy": "captures/bear", "runs/best": "captures/bear"}
    again = Studio(root)
    try:
        began = (root / "runs" / "toy" / "config.json").stat().st_mtime
        assert again.former.present("captures/toy", began) == "captures/bear"
    finally:
        again.close()


def test_the_link_outlasts_a_training_that_goes_on_after_the_renaming(page, studio):
    root = studio.library.root
    write_colmap(root / "captures" / "toy", *procedural_capture(32, 6, splats=50))
    words = ["--out", str(root / "runs" / "best"), "--eval-every", "0"]
    assert main(["train", str(root / "captures" / "toy"), *words, "--iterations", "10"]) == 0
    assert page.post("/api/captures/toy/rename", json={"to": "bear"}).status_code == 200
    assert made_from(page) == {"runs/best": "captures/bear"}
    config = root / "runs" / "best" / "config.json"
    before = config.stat().st_mtime_ns
    assert main(["train", str(root / "captures" / "bear"), *words, "--iterations", "20", "--resume"]) == 0
    assert config.stat().st_mtime_ns > before and str(root / "captures" / "toy") in config.read_text()
    assert made_from(page) == {"runs/best": "captures/bear"}
    write_colmap(root / "captures" / "toy", *procedural_capture(32, 6, splats=50))
    assert made_from(page) == {"runs/best": "captures/bear"}, "another capture now has the old name"


def test_a_running_job_or_a_taken_name_refuses_and_nothing_is_renamed(page, trained):
    root = trained.library.root

    def names():
        return sorted(path.relative_to(root).as_posix() for path in root.glob("[!.]*/*"))

    before = names()
    (root / "runs" / "bear").mkdir()
    answer = page.post("/api/captures/toy/rename", json={"to": "bear", "along": True})
    assert answer.status_code == 409 and "runs/bear: exists already" in answer.json()["error"]
    (root / "runs" / "bear").rmdir()
    trained.queue.submit(Work("doctor", ("runs/toy",), (), {}))
    answer = page.post("/api/captures/toy/rename", json={"to": "bear", "along": True})
    assert answer.status_code == 409, answer.text
    assert "runs/toy: is used by “" in answer.json()["error"]
    assert names() == before
    for body in ({"to": "bear", "along": "yes"}, {"to": "../x", "along": True}, {"along": True}):
        assert page.post("/api/captures/toy/rename", json=body).status_code == 400
    assert names() == before


@pytest.mark.parametrize(
    "text", ["", "[]", '{"renamed": [[1, 2, 3]]}', '{"renamed": 7}', '{"renamed": [["a"]]}']
)
def test_a_damaged_record_has_no_names(tmp_path, text):
    (tmp_path / FORMER).write_text(text)
    former = FormerNames(tmp_path)
    assert former.present("captures/toy", 0) == "captures/toy"
    former.note("captures/toy", "captures/bear")
    assert FormerNames(tmp_path).present("captures/toy", 0) == "captures/bear"
