"""Requests become command lines that the command line accepts; other requests are refused."""

import re
from pathlib import Path

import pytest

from gsplat_edu.cli.main import build_parser
from gsplat_edu.jobs.record import Purpose, Work
from gsplat_edu.options.offers import offered
from gsplat_edu.server.refusal import RefusedError
from gsplat_edu.studio.commands import COMMANDS, command_line, subject_of, title_of, work_of
from gsplat_edu.studio.library import Library
from waiting import until


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
    (tmp_path / "runs" / "a" / "config.json").write_text('{"format": 1}')
    (tmp_path / "scenes" / "a" / "toy.spz").touch()
    return made


def begun(library, request):
    """Return the command line of a request that begins."""
    return command_line(library, work_of(library, request), Purpose.BEGIN).argv


def parsed(argv):
    return build_parser(argv).parse_args(argv)


def test_the_commands_and_their_defaults(library):
    def words(**request):
        return [word.replace(f"{library.root}/", "") for word in begun(library, request)]

    assert words(command="sfm", subject="photos/a b") == ["sfm", "photos/a b", "captures/a b"]
    assert words(command="sfm", subject="photos/film", to="x") == ["sfm", "photos/film/x.mp4", "captures/x"]
    assert words(command="train", subject="captures/a") == ["train", "captures/a", "--out", "runs/a-run-2"]
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
    assert words(command="convert", subject="runs/a", format="html", options={"verify": "photos"}) == [
        *("convert", "runs/a", "runs/a/exports/a.html", "--verify", "photos")
    ]
    (library.root / "runs" / "a" / "edits.json").touch()
    assert words(command="convert", subject="runs/a", format="laz") == [
        "convert",
        "runs/a",
        "runs/a/exports/a.laz",
    ]
    assert words(command="convert", subject="runs/a", format="spz", edits=True) == [
        *("convert", "runs/a", "runs/a/exports/a.spz", "--edits", "runs/a/edits.json", "--verify")
    ]
    assert words(command="clean", subject="runs/a", edits=True) == [
        *("clean", "runs/a", "--out", "scenes/a-clean/a-clean.ply", "--edits", "runs/a/edits.json")
    ]
    assert words(command="mesh", subject="runs/a", format="mesh.glb", options={"texture": True}) == [
        *("mesh", "runs/a", "runs/a/exports/a.mesh.glb", "--texture")
    ]
    assert words(
        command="mesh", subject="scenes/a", format="collider.glb", to="x", options={"faces": 900}
    ) == [*("mesh", "scenes/a/toy.spz", "scenes/a/exports/x.collider.glb", "--collider", "--faces", "900")]
    assert words(command="render", subject="scenes/a", options={"frames": 30, "orbit": True}) == [
        *("render", "scenes/a/toy.spz", "--out", "scenes/a/exports/a.mp4", "--frames", "30", "--orbit")
    ]


REQUESTS = (
    ({"command": "sfm", "subject": "photos/a b"}, "cameras of a b", "photos/a b"),
    (
        {"command": "train", "subject": "captures/a", "options": {"quality": "draft"}},
        "training of a-run-2",
        "runs/a-run-2",
    ),
    ({"command": "clean", "subject": "runs/a"}, "cleaning of a", "runs/a"),
    ({"command": "convert", "subject": "scenes/a", "format": "spz"}, "export of a.spz", "scenes/a"),
    ({"command": "mesh", "subject": "runs/a", "format": "mesh.glb"}, "mesh of a", "runs/a"),
    ({"command": "render", "subject": "runs/a", "to": "film"}, "video of a", "runs/a"),
    ({"command": "doctor", "subject": "captures/a"}, "doctor of a", "captures/a"),
)


@pytest.mark.parametrize(("request_", "title", "subject"), REQUESTS, ids=lambda value: str(value)[:30])
def test_work_makes_the_same_command_for_every_purpose(library, request_, title, subject):
    work = work_of(library, request_)
    assert (title_of(work), subject_of(work)) == (title, subject)
    assert {command_line(library, work, purpose).argv for purpose in Purpose} == {begun(library, request_)}
    assert {command_line(library, work, purpose).work == work for purpose in Purpose} == {True}


def test_inputs_and_outputs_are_entries_and_files_of_the_library(library):
    def places(**request):
        work = work_of(library, request)
        return work.inputs, work.outputs

    assert places(command="sfm", subject="photos/film") == (("photos/film",), ("captures/film",))
    assert places(command="doctor", subject="runs/a") == (("runs/a",), ())
    assert places(command="train", subject="captures/e\u0301", to="o\u0302") == (
        ("captures/\u00e9",),
        ("runs/\u00f4",),
    )
    found = places(command="convert", subject="runs/a", format="compressed.ply", to="x", edits=True)
    assert found == (("runs/a", "runs/a/edits.json"), ("runs/a/exports/x.compressed.ply",))


def test_a_page_is_exported_with_meshes_of_its_entry(library):
    exports = library.root / "runs" / "a" / "exports"
    exports.mkdir()
    files = {"surface": "a.mesh.glb", "collider": "a.collider.glb"}
    request = {"command": "convert", "subject": "runs/a", "format": "html", "edits": True, **files}
    inputs = ("runs/a", "runs/a/edits.json", "runs/a/exports/a.mesh.glb", "runs/a/exports/a.collider.glb")
    assert work_of(library, request).inputs == inputs
    (library.root / "runs" / "a" / "edits.json").touch()
    (exports / "a.mesh.glb").touch()
    with pytest.raises(RefusedError, match=r"collider: runs/a has no a.collider.glb; make the mesh first"):
        begun(library, request)
    (exports / "a.collider.glb").touch()
    argv = begun(library, request)
    arguments = parsed(argv)
    assert arguments.edits == library.root / "runs" / "a" / "edits.json"
    assert (arguments.surface, arguments.collider) == (exports / "a.mesh.glb", exports / "a.collider.glb")
    assert arguments.verify
    only = parsed(begun(library, {**request, "edits": False, "collider": None}))
    assert (only.surface, only.collider, only.edits) == (exports / "a.mesh.glb", None, None)
    (exports / "a.collider.glb").unlink()  # a record is still shown
    assert command_line(library, work_of(library, request), Purpose.SHOW).argv == argv


def test_a_training_resumes_once_its_run_has_begun(library):
    work = work_of(library, {"command": "train", "subject": "captures/a"})
    argv = command_line(library, work, Purpose.BEGIN).argv
    out = library.root / "runs" / "a-run-2"
    out.mkdir()
    assert command_line(library, work, Purpose.CONTINUE).argv == argv
    (out / "config.json").write_text('{"format": 1}')
    resumed = command_line(library, work, Purpose.CONTINUE)
    assert resumed.argv == (*argv, "--resume")
    assert {command_line(library, resumed.work, purpose) == resumed for purpose in Purpose} == {True}
    with pytest.raises(RefusedError, match="exists already"):
        command_line(library, work, Purpose.BEGIN)


def test_work_on_a_removed_entry_can_be_shown_but_not_started(library):
    work = work_of(library, {"command": "train", "subject": "captures/a"})
    argv = command_line(library, work, Purpose.BEGIN).argv
    (library.root / "captures" / "a").rmdir()
    assert command_line(library, work, Purpose.SHOW).argv == argv
    for purpose in (Purpose.BEGIN, Purpose.CONTINUE):
        with pytest.raises(RefusedError, match="captures/a: does not exist"):
            command_line(library, work, purpose)


def test_work_follows_a_rename(library):
    work = work_of(library, {"command": "train", "subject": "captures/a", "to": "x"})
    assert work.renamed("captures/a", "captures/b") == Work("train", ("captures/b",), ("runs/x",))
    assert work.renamed("runs/x", "runs/y") == Work("train", ("captures/a",), ("runs/y",))
    assert work.renamed("scenes/x", "scenes/y") == work.renamed("runs/a", "runs/y") == work
    export = work_of(library, {"command": "convert", "subject": "runs/a", "format": "ply"}).renamed(
        "runs/a", "runs/b"
    )
    # the exported file keeps its name
    assert export == Work("convert", ("runs/b",), ("runs/b/exports/a.ply",))


SAMPLES = {
    "train": {
        "time_limit": "20m",
        "max_memory": "4GiB",
        "resolution": 2.5,
        "sky": "auto",
        "clean": True,
    },
    "sfm": {"frames": 30, "matcher": "exhaustive", "camera_model": "auto", "scale": "none"},
    "clean": {"max_loss": 0.1},
}
SUBJECTS = {
    "train": "captures/a",
    "sfm": "photos/a b",
    "doctor": "captures/a",
    "clean": "runs/a",
    "render": "runs/a",
}


@pytest.mark.parametrize("command", COMMANDS)
def test_the_manual_lists_the_options_of_a_command(command):
    """Those of a request; `resume` is a field of its own."""
    manual = (Path(__file__).parents[2] / "docs" / "STUDIO.md").read_text(encoding="utf-8")
    (row,) = (line for line in manual.splitlines() if line.startswith(f"| {command} | "))
    words = set(re.findall(r"[a-z_]+", row.partition("options ")[2]))
    assert set(offered(command)) - {"resume"} <= words


@pytest.mark.parametrize("command", COMMANDS)
def test_no_request_names_a_path(command):
    paths = [name for name, action in offered(command).items() if action.type is Path]
    assert paths == (["depth"] if command == "train" else [])


def test_depth_is_asked_for_by_a_word(library):
    def line(depth):
        return begun(library, {"command": "train", "subject": "captures/a", "options": {"depth": depth}})

    assert parsed(line("points")).depth == Path("points")
    with pytest.raises(RefusedError, match=r"options.depth: is '/etc', but has to be one of points, capture"):
        line("/etc")


def test_a_request_has_the_bounds_of_the_command(library):
    def words(**options):
        return begun(library, {"command": "train", "subject": "captures/a", "options": options})

    assert parsed(words(batch=4096, iterations=4096)).batch == 4096
    with pytest.raises(
        RefusedError, match="options.batch: is 4097, but has to be a whole number from 1 to 4096"
    ):
        words(batch=4097)
    with pytest.raises(
        RefusedError, match="options.quality: --iterations or --time-limit already says how long"
    ):
        words(quality="draft", iterations=10)


def test_the_resolution_may_be_chosen_by_the_command(library):
    options = {"resolution": "auto", "outside_masks": "empty"}
    found = parsed(begun(library, {"command": "train", "subject": "captures/a", "options": options}))
    assert found.resolution == "auto" and found.outside_masks == "empty"
    with pytest.raises(RefusedError, match="options.resolution: 'big' is not a number"):
        begun(library, {"command": "train", "subject": "captures/a", "options": {"resolution": "big"}})


def test_settings_of_the_recipe_reach_the_training(library):
    def words(settings):
        return begun(library, {"command": "train", "subject": "captures/a", "options": {"set": settings}})

    assert parsed(words({"sh_every": 300, "min_opacity": 0.01})).settings == {
        "sh_every": 300,
        "min_opacity": 0.01,
    }
    for settings, said in (
        ({"out": "/"}, "options.set: 'out' is not a setting"),
        ({"over_cap": "cut"}, "only the course's trainings change over_cap"),
        ({"sh_every": True}, "options.set.sh_every: has to be a number or a short text"),
        ({"sh_every": "9\n"}, "options.set.sh_every: has to be"),
        ({"sh_every": "nine"}, "options.set: sh_every: 'nine' is not a whole number"),
        (["sh_every=9"], "options.set: has to be an object"),
    ):
        with pytest.raises(RefusedError, match=said):
            words(settings)


@pytest.mark.parametrize("command", SAMPLES)
def test_values_reach_the_command(library, command):
    options = SAMPLES[command]
    found = vars(
        parsed(begun(library, {"command": command, "subject": SUBJECTS[command], "options": options}))
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
        {"command": "train", "subject": "captures/a", "options": {"time_limit": "9" * 40 + "s"}},
        {"command": "train", "subject": "captures/a", "options": {"max_memory": "1e999GiB"}},
        {"command": "train", "subject": "captures/a", "options": {"max_memory": "plenty"}},
        {"command": "train", "subject": "captures/a", "options": {"scale": "1e999 m"}},
        {"command": "sfm", "subject": "photos/none"},
        {"command": "convert", "subject": "scenes/none", "format": "spz"},
        {"command": "convert", "subject": "runs/a", "format": "exe"},
        {"command": "mesh", "subject": "runs/a", "format": "obj"},
        {"command": "mesh", "subject": "runs/a", "format": "mesh.glb", "options": {"voxel": 0}},
        {"command": "mesh", "subject": "runs/a", "format": "mesh.glb", "options": {"dataset": "/"}},
        {"command": "mesh", "subject": "runs/a", "format": "mesh.glb", "edits": True},
        {"command": "convert", "subject": "runs/a", "format": "spz", "to": "a/b"},
        {"command": "convert", "subject": "runs/a", "format": "spz", "edits": True},
        {"command": "convert", "subject": "runs/a", "format": "html", "surface": "gone.mesh.glb"},
        {"command": "convert", "subject": "runs/a", "format": "html", "surface": "../a.mesh.glb"},
        {"command": "convert", "subject": "runs/a", "format": "html", "surface": ["a.mesh.glb"]},
        {"command": "convert", "subject": "runs/a", "format": "html", "surface": "config.json"},
        {"command": "convert", "subject": "runs/a", "format": "html", "collider": "a.collider.glb"},
        {"command": "convert", "subject": "runs/a", "format": "spz", "surface": "a.mesh.glb"},
        {"command": "mesh", "subject": "runs/a", "format": "mesh.glb", "surface": "a.mesh.glb"},
        {"command": "train", "subject": "captures/a", "surface": "a.mesh.glb"},
        {"command": "clean", "subject": "scenes/a"},
    ],
    ids=str,
)
def test_other_requests_are_refused_in_one_line(library, request_):
    with pytest.raises(RefusedError) as caught:
        begun(library, request_)
    assert "\n" not in str(caught.value) and str(caught.value)


@pytest.mark.parametrize(
    "work",
    [
        Work("train", ("captures/a",), ("captures/b",)),
        Work("train", ("captures/a",), ("runs/b", "runs/c")),
        Work("train", ("captures/a",), ()),
        Work("train", (), ("runs/b",)),
        Work("train", ("captures/a", "captures/a/edits.json"), ("runs/b",)),
        Work("train", ("captures/a",), ("/runs/b",)),
        Work("train", ("captures/a",), ("runs/b/c",)),
        Work("train", ("captures/a",), ("runs/../x",)),
        Work("train", ("captures//a",), ("runs/b",)),
        # not in composed form
        Work("train", ("captures/a",), ("runs/e\u0301",)),
        Work("doctor", ("captures/a",), ("runs/b",)),
        Work("doctor", ("runs/a",), (), {"resolution": 2.0}),
        Work("clean", ("runs/a",), ("scenes/b/b.ply",)),
        Work("convert", ("runs/a",), ("runs/b/exports/x.ply",)),
        Work("convert", ("runs/a",), ("runs/a/x.ply",)),
        Work("convert", ("runs/a",), ("runs/a/exports/../x.ply",)),
        Work("convert", ("runs/a",), ("runs/a/exports/x.exe",)),
        Work("convert", ("runs/a",), ("runs/a/exports/.ply",)),
        Work("convert", ("runs/a",), ("runs/a/exports/e\u0301.ply",)),
        Work("convert", ("runs/a", "scenes/a/edits.json"), ("runs/a/exports/x.ply",)),
        Work("convert", ("runs/a", "runs/a/config.json"), ("runs/a/exports/x.ply",)),
        Work("convert", ("runs/a", "scenes/a/exports/x.mesh.glb"), ("runs/a/exports/x.html",)),
        Work("convert", ("runs/a", "runs/a/x.mesh.glb"), ("runs/a/exports/x.html",)),
        Work("convert", ("runs/a", "runs/a/exports/../x.mesh.glb"), ("runs/a/exports/x.html",)),
        Work("convert", ("runs/a", "runs/a/exports/x.mesh.glb"), ("runs/a/exports/x.ply",)),
        Work("convert", ("runs/a", "/etc/x.mesh.glb"), ("runs/a/exports/x.html",)),
        Work(
            "convert",
            ("runs/a", "runs/a/exports/x.mesh.glb", "runs/a/exports/y.mesh.glb"),
            ("runs/a/exports/x.html",),
        ),
        Work("render", ("runs/a",), ("runs/a/exports/x.ply",)),
        Work("render", ("runs/a",), ("runs/a/exports/x.mp4",), {"resume": True}),
    ],
    ids=str,
)
@pytest.mark.parametrize("purpose", Purpose)
def test_a_record_names_no_other_place_than_a_request_could(library, work, purpose):
    (library.root / "scenes" / "a" / "edits.json").touch()
    with pytest.raises(RefusedError) as caught:
        command_line(library, work, purpose)
    assert "\n" not in str(caught.value) and len(str(caught.value)) < 300


def test_a_training_and_jobs_that_read_its_run_wait_for_each_other(page, studio):
    (studio.library.root / "captures" / "a").mkdir()
    (studio.library.root / "runs" / "r").mkdir()
    (studio.library.root / "runs" / "r" / "config.json").write_text('{"format": 1}')
    (studio.library.root / "runs" / "same").symlink_to(studio.library.root / "runs" / "r")
    requests = (
        {"command": "clean", "subject": "runs/same"},
        {"command": "train", "subject": "captures/a", "to": "r", "resume": True},
        {"command": "convert", "subject": "runs/r", "format": "spz"},
        {"command": "render", "subject": "runs/r"},
        {"command": "doctor", "subject": "captures/a"},
    )
    for request in requests:
        assert page.post("/api/jobs", json=request).status_code == 200

    def waits():
        found = page.get("/api/jobs").json()["jobs"]
        return [[(other["job"], other["place"]) for other in job["waits_for"]] for job in found]

    expected = [[], [("000001", "runs/r")], [("000002", "runs/r")], [("000002", "runs/r")], []]
    until(lambda: waits() == expected)


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
    assert list(page.delete("/api/jobs/000001").json()) == ["trash"]
    assert [job["id"] for job in page.get("/api/jobs").json()["jobs"]] == ["000002", "000003"]


def test_no_export_replaces_another(studio):
    """Of any format, also one with two endings."""
    folder = studio.library.root / "scenes" / "a"
    exports = folder / "exports"
    exports.mkdir(parents=True)
    request = {"command": "convert", "subject": "scenes/a"}
    for name in ("a.spz", "a.compressed.ply", "a (2).compressed.ply"):
        (exports / name).touch()

    def output(**more):
        (place,) = work_of(studio.library, {**request, **more}).outputs
        return place.removeprefix("scenes/a/exports/")

    assert output(format="spz") == "a (2).spz"
    assert output(format="compressed.ply") == "a (3).compressed.ply"
    assert output(format="html") == "a.html"
    assert output(format="spz", to="b") == "b.spz"


def test_a_job_that_is_removed_from_the_list_can_be_brought_back(studio, page):
    (studio.library.root / "captures" / "a").mkdir()
    request = {"command": "doctor", "subject": "captures/a"}
    made = page.post("/api/jobs", json=request).json()
    number = page.delete(f"/api/jobs/{made['id']}").json()["trash"]
    assert page.get("/api/jobs").json()["jobs"] == []
    (thrown,) = page.get("/api/trash").json()["trash"]
    assert (thrown["kind"], thrown["name"], thrown["entry"]) == ("jobs", made["id"], None)
    other = page.post("/api/jobs", json=request).json()
    assert other["id"] > made["id"], "else the first one could not come back"
    assert page.post(f"/api/trash/{number}/restore").json()["entry"] == f"jobs/{made['id']}"
    back = page.get(f"/api/jobs/{made['id']}").json()
    assert (back["state"], back["work"], back["created"]) == ("held", made["work"], made["created"])
    assert page.get("/api/trash").json()["trash"] == []
    assert page.post(f"/api/trash/{number}/restore").status_code == 404


def test_a_job_does_not_come_back_over_another_one(studio, page):
    (studio.library.root / "captures" / "a").mkdir()
    made = page.post("/api/jobs", json={"command": "doctor", "subject": "captures/a"}).json()
    number = page.delete(f"/api/jobs/{made['id']}").json()["trash"]
    (studio.library.root / ".studio" / "jobs" / made["id"]).mkdir()
    answer = page.post(f"/api/trash/{number}/restore")
    assert (answer.status_code, answer.json()["error"]) == (
        409,
        f"job {made['id']}: exists already; remove that one first",
    )
    assert len(page.get("/api/trash").json()["trash"]) == 1
