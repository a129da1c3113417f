"""Entries are grouped to projects by what they were made from, each with one next step."""

import json
import os
import shutil
from dataclasses import replace

import pytest

from gsplat_edu.jobs.record import State
from gsplat_edu.sfm.photos import fingerprint, photo_files
from studio.pages import png


def add_photos(studio, name, seed=0, count=3):
    folder = studio.library.root / "photos" / name
    folder.mkdir()
    for index in range(count):
        (folder / f"{index}.png").write_bytes(png(10 * seed + index))
    return folder


def add_capture(studio, name, stages=None):
    """Write the files by which a capture with poses is recognised."""
    folder = studio.library.root / "captures" / name
    (folder / "sparse" / "0").mkdir(parents=True)
    (folder / "sparse" / "0" / "cameras.bin").touch()
    if stages is not None:
        (folder / "sfm").mkdir()
        (folder / "sfm" / "stages.json").write_text(json.dumps({"stages": stages}))
    return folder


def add_run(studio, name, capture, iterations=40, planned=40, psnr=20.0):
    folder = studio.library.root / "runs" / name
    folder.mkdir()
    config = {"train": {"iterations": planned}, "data": {"path": str(capture)}}
    (folder / "config.json").write_text(json.dumps({"format": 1, **config}))
    (folder / "metrics.json").write_text(json.dumps({"iterations": iterations, "test": {"psnr": psnr}}))
    return folder


def job_of(studio, state=None, **request):
    """Queue a job; the queue starts none. With a state, it is taken to have come there."""
    job = studio.start(request)
    return (
        job if state is None else studio.queue._put(job, state=state, started=job.created, ended=job.created)
    )


def projects(page):
    return {project["name"]: project for project in page.get("/api/library").json()["projects"]}


def only(page):
    (project,) = projects(page).values()
    return project


def test_entries_without_origin_are_projects_of_their_own_whatever_they_are_called(page, studio):
    add_photos(studio, "toy")
    add_capture(studio, "toy")
    add_run(studio, "toy", "/elsewhere/toy")
    (studio.library.root / "scenes" / "toy").mkdir()
    found = page.get("/api/library").json()["projects"]
    assert sorted(project["entries"] for project in found) == [
        ["captures/toy"],
        ["photos/toy"],
        ["runs/toy"],
        ["scenes/toy"],
    ]


def test_a_project_goes_from_photos_to_an_export(page, studio):
    """What is asked for by each next step leads to the following one."""
    folder = add_photos(studio, "walk")
    assert only(page)["stage"] == "poses"
    step = only(page)["next"]
    assert step == {"label": "Place the photos", "request": {"command": "sfm", "subject": "photos/walk"}}
    job = job_of(studio, **step["request"])
    assert only(page)["next"] == {"label": "Watch the photos being placed", "place": "photos/walk"}
    job = studio.queue._put(job, state=State.DONE)
    add_capture(studio, "walk", {})
    project = only(page)
    assert (project["entries"], project["stage"]) == (["photos/walk", "captures/walk"], "training")
    cameras = project["next"]
    assert (cameras["label"], cameras["place"]) == ("Look at the cameras", "captures/walk")

    job = job_of(studio, **cameras["then"]["request"])
    project = only(page)
    assert project["next"] == {"label": "Watch the training", "place": "runs/walk"}
    assert project["entries"][-1] == "runs/walk", "it has no folder yet"
    run = add_run(studio, "walk", studio.library.root / "captures" / "walk")
    studio.queue._put(job, state=State.DONE)
    project = only(page)
    assert (project["stage"], project["picture"]) == ("look", "runs/walk")
    look, share, export = project["next"], project["next"]["then"], project["next"]["then"]["then"]
    assert [look["place"], share["place"]] == ["runs/walk", "runs/walk/share"]
    assert export["request"] == {"command": "convert", "subject": "runs/walk", "format": "html"}
    (run / "edits.json").write_text("{}")
    assert only(page)["next"]["then"]["then"]["request"]["edits"] is True

    (run / "exports").mkdir()
    (run / "exports" / "walk.mesh.glb").touch()
    assert only(page)["stage"] == "look", "a mesh alone shows no scene"
    (run / "exports" / "walk.html").touch()
    project = only(page)
    assert project["stage"] == "share" and project["next"]["then"]["file"] == "walk.html"
    places = ["photos/walk", "captures/walk", "runs/walk", "runs/walk", "runs/walk/share"]
    assert [step["place"] for step in project["steps"]] == places
    assert folder.is_dir() and list(projects(page)) == ["walk"]


@pytest.mark.parametrize("state", [State.FAILED, State.CANCELLED, State.INTERRUPTED])
def test_what_was_stopped_is_tried_again(page, studio, state):
    add_photos(studio, "walk")
    job_of(studio, state, command="sfm", subject="photos/walk")
    assert only(page)["next"] == {"label": "Try again to place the photos", "place": "photos/walk"}
    capture = add_capture(studio, "walk", {})
    job_of(studio, state, command="train", subject="captures/walk")
    add_run(studio, "walk", capture, iterations=10)
    project = only(page)
    assert project["next"] == {"label": "Resume the training", "place": "runs/walk"}
    assert [step["place"] for step in project["steps"]][-2:] == [None, None]


def test_an_entry_has_the_next_step_of_what_was_made_from_it(page, studio):
    """A second capture of the same photos is not trained yet, although the project has a result."""
    add_photos(studio, "walk")
    for name in ("walk", "walk-poses-2"):
        job_of(studio, State.DONE, command="sfm", subject="photos/walk")
        add_capture(studio, name, {})
    add_run(studio, "walk", studio.library.root / "captures" / "walk")
    answer = page.get("/api/library").json()
    (project,), (first, second) = answer["projects"], answer["captures"]
    assert project["next"]["label"] == first["next"]["label"] == "Look at the result"
    assert second["next"]["place"] == "captures/walk-poses-2"
    assert second["made_from"] == "photos/walk" and answer["runs"][0]["made_from"] == "captures/walk"


@pytest.mark.parametrize("stage", ["frames", "faces", "photos"])
def test_a_capture_without_a_job_is_known_by_the_digest_of_its_photos(page, studio, stage):
    """`gsplat-edu sfm` outside of the studio leaves no job, but a digest of its photos."""
    folders = [add_photos(studio, f"set{seed}", seed) for seed in (1, 2)]
    files = photo_files(folders[1])
    option = {"frames": "video", "faces": "panoramas", "photos": "photos"}[stage]
    add_capture(
        studio, "anything", {stage: {"options": {option: fingerprint(files, folders[1])}, "facts": {}}}
    )
    found = projects(page)
    assert found["set2"]["entries"] == ["photos/set2", "captures/anything"]
    assert found["set1"]["entries"] == ["photos/set1"]
    (folders[1] / "0.png").write_bytes(png(77))
    os.utime(folders[1])
    assert sorted(projects(page)) == ["anything", "set1", "set2"], "these are other photos now"


def test_runs_belong_to_the_capture_that_their_config_names_also_where_it_was_adopted(page, studio, tmp_path):
    outside = add_capture(studio, "orbit")
    shutil.move(outside, tmp_path / "orbit of a ship")
    studio.library.adopt("captures", tmp_path / "orbit of a ship", "ship")
    add_run(studio, "first", tmp_path / "orbit of a ship")
    job_of(studio, State.DONE, command="train", subject="captures/ship", to="second")
    add_run(studio, "second", studio.library.root / "captures" / "ship")
    assert only(page)["entries"] == ["captures/ship", "runs/first", "runs/second"]
    studio.rename("captures", "ship", "vessel")
    assert only(page)["entries"] == ["captures/vessel", "runs/first", "runs/second"]


def test_a_run_that_found_its_poses_itself_belongs_to_its_photos(page, studio):
    add_photos(studio, "walk")
    job_of(studio, State.DONE, command="train", subject="photos/walk", to="quick")
    add_run(studio, "quick", studio.library.root / "runs" / "quick" / "capture")
    assert only(page)["entries"] == ["photos/walk", "runs/quick"]


def test_a_cleaned_scene_belongs_to_its_run_and_another_scene_of_its_name_does_not(page, studio):
    add_run(studio, "toy", "/elsewhere")
    job = job_of(studio, State.DONE, command="clean", subject="runs/toy")
    folder = studio.library.root / job.work.outputs[0]
    folder.mkdir()
    (folder / "toy-clean.ply").write_bytes(b"ply")
    assert only(page)["entries"] == ["runs/toy", "scenes/toy-clean"]
    os.utime(folder / "toy-clean.ply", (job.created + 3600,) * 2)
    assert len(projects(page)) == 2


def test_a_capture_whose_search_failed_leads_back_to_its_photos(page, studio):
    add_photos(studio, "walk")
    job_of(studio, State.FAILED, command="sfm", subject="photos/walk")
    (studio.library.root / "captures" / "walk" / "sfm").mkdir(parents=True)
    (capture,) = page.get("/api/library").json()["captures"]
    assert capture["next"] == {"label": "Go back to the photos", "place": "photos/walk"}
    (studio.library.root / "photos" / "walk").rename(studio.library.root / "photos" / "gone")
    (capture,) = page.get("/api/library").json()["captures"]
    assert capture["next"]["place"] == "captures/walk" and capture["made_from"] is None


def test_an_empty_set_asks_for_photos(page, studio):
    (studio.library.root / "photos" / "new").mkdir()
    assert only(page)["next"] == {"label": "Add photos", "place": "photos/new"}
    assert (only(page)["stage"], only(page)["picture"]) == ("photos", None)


def test_a_job_that_exports_is_watched(page, studio):
    add_run(studio, "toy", "/elsewhere")
    job = job_of(studio, command="convert", subject="runs/toy", format="html")
    assert only(page)["next"] == {"label": "Watch the export", "place": "runs/toy/share"}
    studio.queue._jobs[job.id] = replace(job, state=State.FAILED)
    assert only(page)["next"]["label"] == "Look at the result"
