"""Requests become the command lines that the command line accepts, and nothing else does."""

import argparse

import pytest

from gsplat_edu.cli.main import build_parser
from gsplat_edu.jobs.record import Purpose
from gsplat_edu.studio.commands import (
    CLEAN_OPTIONS,
    CONVERT_OPTIONS,
    DOCTOR_OPTIONS,
    RENDER_OPTIONS,
    SFM_OPTIONS,
    TRAIN_OPTIONS,
    renamed,
    work_of,
)
from gsplat_edu.studio.library import Library
from gsplat_edu.studio.refusal import RefusedError


@pytest.fixture
def library(tmp_path):
    made = Library(tmp_path)
    for entry in (
        "photos/a b",
        "photos/film",
        "photos/none",
        "captures/a",
        "runs/a",
        "scenes/a",
        "scenes/none",
    ):
        (tmp_path / entry).mkdir()
    (tmp_path / "photos" / "a b" / "1.jpg").touch()
    (tmp_path / "photos" / "film" / "x.mp4").touch()
    (tmp_path / "runs" / "a" / "config.json").touch()
    (tmp_path / "scenes" / "a" / "toy.spz").touch()
    return made


def parsed(work):
    return build_parser(work.argv).parse_args(work.argv)


def test_the_commands_and_their_defaults(library):
    def words(**request):
        return [word.replace(f"{library.root}/", "") for word in work_of(library, request).argv]

    assert words(command="sfm", subject="photos/a b") == ["sfm", "photos/a b", "captures/a b"]
    assert words(command="sfm", subject="photos/film", to="x") == ["sfm", "photos/film/x.mp4", "captures/x"]
    assert words(command="train", subject="captures/a") == ["train", "captures/a", "--out", "runs/a-2"]
    assert words(command="train", subject="captures/a", to="a", resume=True) == [
        *("train", "captures/a", "--out", "runs/a", "--resume")
    ]
    assert words(command="doctor", subject="captures/a") == ["doctor", "captures/a", "--no-forecast"]
    assert words(command="doctor", subject="runs/a") == ["doctor", "runs/a"]
    assert words(command="clean", subject="runs/a") == [
        "clean",
        "runs/a",
        "--out",
        "scenes/a-clean/a-clean.ply",
    ]
    assert words(command="convert", subject="scenes/a", format="html", to="My toy") == [
        *("convert", "scenes/a/toy.spz", "scenes/a/exports/My toy.html", "--verify")
    ]
    (library.root / "runs" / "a" / "edits.json").touch()
    assert words(command="convert", subject="runs/a", format="spz", edits=True) == [
        *("convert", "runs/a", "runs/a/exports/a.spz", "--edits", "runs/a/edits.json", "--verify")
    ]
    assert words(command="render", subject="scenes/a", options={"frames": 30, "orbit": True}) == [
        *("render", "scenes/a/toy.spz", "--out", "scenes/a/exports/a.mp4", "--frames", "30", "--orbit")
    ]


def test_a_request_with_its_choices_makes_the_same_command_again(library):
    for request in (
        {"command": "sfm", "subject": "photos/a b"},
        {"command": "train", "subject": "captures/a", "options": {"quality": "draft"}},
        {"command": "clean", "subject": "runs/a"},
        {"command": "convert", "subject": "scenes/a", "format": "spz"},
        {"command": "render", "subject": "runs/a", "to": "film"},
        {"command": "doctor", "subject": "captures/a"},
    ):
        work = work_of(library, request)
        for purpose in Purpose:
            assert work_of(library, work.request, purpose) == work


def test_a_training_resumes_once_its_run_has_begun(library):
    work = work_of(library, {"command": "train", "subject": "captures/a"})
    out = library.root / "runs" / "a-2"
    out.mkdir()
    assert work_of(library, work.request, Purpose.CONTINUE).argv == work.argv
    (out / "config.json").touch()
    resumed = work_of(library, work.request, Purpose.CONTINUE)
    assert resumed.argv == (*work.argv, "--resume")
    assert {work_of(library, resumed.request, purpose) == resumed for purpose in Purpose} == {True}
    with pytest.raises(RefusedError, match="exists already"):
        work_of(library, work.request, Purpose.BEGIN)


def test_what_is_gone_can_be_shown_but_not_started(library):
    work = work_of(library, {"command": "train", "subject": "captures/a"})
    (library.root / "captures" / "a").rmdir()
    assert work_of(library, work.request, Purpose.SHOW) == work
    for purpose in (Purpose.BEGIN, Purpose.CONTINUE):
        with pytest.raises(RefusedError, match="captures/a: does not exist"):
            work_of(library, work.request, purpose)


def test_requests_follow_a_rename(library):
    request = work_of(library, {"command": "train", "subject": "captures/a", "to": "x"}).request
    assert renamed(request, "captures", "a", "b") == {**request, "subject": "captures/b"}
    assert renamed(request, "runs", "x", "y") == {**request, "to": "y"}
    assert renamed(request, "scenes", "x", "y") == renamed(request, "runs", "a", "y") == request
    export = work_of(library, {"command": "convert", "subject": "runs/a", "format": "ply"}).request
    assert renamed(export, "runs", "a", "b") == {**export, "subject": "runs/b"}  # its file keeps its name


SAMPLES = {
    "train": {
        "quality": "draft",
        "time_limit": "20m",
        "max_memory": "4GiB",
        "resolution": 2.5,
        "sky": "auto",
        "clean": True,
    },
    "sfm": {"frames": 30, "matcher": "exhaustive", "camera_model": "auto", "scale": "none"},
}
SUBJECTS = {
    "train": "captures/a",
    "sfm": "photos/a b",
    "doctor": "captures/a",
    "clean": "runs/a",
    "render": "runs/a",
}


@pytest.mark.parametrize(
    ("command", "options"),
    [
        ("train", TRAIN_OPTIONS),
        ("sfm", SFM_OPTIONS),
        ("doctor", DOCTOR_OPTIONS),
        ("clean", CLEAN_OPTIONS),
        ("convert", CONVERT_OPTIONS),
        ("render", RENDER_OPTIONS),
    ],
)
def test_every_option_is_one_of_the_command_line(library, command, options):
    parser = build_parser([command])
    (commands,) = (a for a in parser._actions if isinstance(a, argparse._SubParsersAction))
    known = {flag for action in commands.choices[command]._actions for flag in action.option_strings}
    assert {f"--{name.replace('_', '-')}" for name in options} <= known


def test_the_resolution_may_be_chosen_by_the_command(library):
    options = {"resolution": "auto", "outside_masks": "empty"}
    found = parsed(work_of(library, {"command": "train", "subject": "captures/a", "options": options}))
    assert found.resolution == "auto" and found.outside_masks == "empty"
    with pytest.raises(RefusedError, match="resolution: is big, but has to be a number"):
        work_of(library, {"command": "train", "subject": "captures/a", "options": {"resolution": "big"}})


@pytest.mark.parametrize("command", SAMPLES)
def test_values_reach_the_command(library, command):
    options = SAMPLES[command]
    found = vars(
        parsed(work_of(library, {"command": command, "subject": SUBJECTS[command], "options": options}))
    )
    for name, value in options.items():
        expected = {"20m": 1200.0, "4GiB": 4 << 30}.get(value, value)
        assert found[name] == expected


@pytest.mark.parametrize(
    "request_",
    [
        {},
        {"command": ["train"]},
        {"command": "demo"},
        {"command": "train"},
        {"command": "train", "subject": "captures/../runs/a"},
        {"command": "train", "subject": "captures/none"},
        {"command": "train", "subject": "scenes/a"},
        {"command": "train", "subject": "captures/a", "to": "a"},  # the run exists
        {"command": "train", "subject": "captures/a", "to": "none", "resume": True},
        {"command": "train", "subject": "captures/a", "to": "../../x"},
        {"command": "train", "subject": "captures/a", "shell": "rm"},
        {"command": "train", "subject": "captures/a", "options": []},
        {"command": "train", "subject": "captures/a", "options": {"out": "/tmp/x"}},
        {"command": "train", "subject": "captures/a", "options": {"export": "/tmp/x.spz"}},
        {"command": "train", "subject": "captures/a", "options": {"iterations": -1}},
        {"command": "train", "subject": "captures/a", "options": {"iterations": True}},
        {"command": "train", "subject": "captures/a", "options": {"iterations": "5"}},
        {"command": "train", "subject": "captures/a", "options": {"iterations": 10**30}},
        {"command": "train", "subject": "captures/a", "options": {"resolution": float("nan")}},
        {"command": "train", "subject": "captures/a", "options": {"quality": "best"}},
        {"command": "train", "subject": "captures/a", "options": {"quality": {}}},
        {"command": "train", "subject": "captures/a", "options": {"clean": 1}},
        {"command": "train", "subject": "captures/a", "options": {"time_limit": "--out=x"}},
        {"command": "train", "subject": "captures/a", "options": {"time_limit": "5\n"}},
        {"command": "sfm", "subject": "photos/none"},
        {"command": "convert", "subject": "scenes/none", "format": "spz"},
        {"command": "convert", "subject": "runs/a", "format": "exe"},
        {"command": "convert", "subject": "runs/a", "format": "spz", "to": "a/b"},
        {"command": "convert", "subject": "runs/a", "format": "spz", "edits": True},
        {"command": "clean", "subject": "scenes/a"},
    ],
    ids=str,
)
def test_other_requests_are_refused_in_one_line(library, request_):
    with pytest.raises(RefusedError) as caught:
        work_of(library, request_)
    assert "\n" not in str(caught.value) and str(caught.value)


def test_two_jobs_do_not_write_to_one_place(page, studio):
    (studio.library.root / "captures" / "a").mkdir()
    request = {"command": "train", "subject": "captures/a", "to": "r"}
    first = page.post("/api/jobs", json=request)
    assert first.json()["command"].endswith("/captures/a --out " + str(studio.library.root / "runs" / "r"))
    assert page.post("/api/jobs", json=request).status_code == 409
    assert page.post("/api/jobs", json={**request, "to": "s"}).status_code == 200
    assert page.post("/api/jobs/000001/cancel").json()["state"] == "cancelled"
    assert page.post("/api/jobs/000001/cancel").status_code == 409
    assert page.post("/api/jobs/000001/explode").status_code == 404
    assert page.get("/api/jobs/999999").status_code == 404
    assert page.post("/api/jobs", json=request).status_code == 200
    assert page.delete("/api/jobs/000001").json() == {"removed": "000001"}
    assert [job["id"] for job in page.get("/api/jobs").json()["jobs"]] == ["000002", "000003"]
