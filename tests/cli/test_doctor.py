import dataclasses
import os
import shlex
import shutil
from pathlib import Path

import numpy as np
import pytest

import gsplat_edu.cli.main as command_line
from gsplat_edu.budget.plan import Limits, plan
from gsplat_edu.data.dataset import DataSettings, load_dataset
from gsplat_edu.data.procedural import procedural_capture
from gsplat_edu.data.writers import write_colmap, write_transforms
from gsplat_edu.io.ply import save_ply
from gsplat_edu.options.train import options_from
from gsplat_edu.render.settings import RenderSettings
from gsplat_edu.runs.folder import RunFolder
from gsplat_edu.scene.views import View
from splats import splats_on


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    """A clean capture, and the views, points and colours it was written from."""
    folder = tmp_path_factory.mktemp("made") / "capture"
    views, points, colors = procedural_capture(64, 24)
    write_colmap(folder, views, points, colors)
    return folder, views, points, colors


@pytest.fixture
def doctor(capsys):
    """Run the command; return its exit code and its output, including any error line."""

    def call(*words):
        try:
            code = command_line.main(["doctor", *map(str, words)])
        except SystemExit as end:
            code = end.code
        printed = capsys.readouterr()
        return code, printed.err or printed.out

    return call


def test_a_clean_capture_fits_on_a_screen_and_ends_with_advice(doctor, capture):
    folder, *_ = capture
    code, said = doctor(folder, "--no-forecast")
    lines = said.splitlines()
    assert code == 0 and len(lines) <= 24 and "warning" not in said
    assert "COLMAP: 24 photos of 64x48; 200 points" in said
    assert (
        lines[-4] == "what to do:" and lines[-3] == f"  1. train: gsplat-edu train {folder} --out out/capture"
    )


def test_the_recommended_training_uses_the_given_options(doctor, capture):
    """A forecast for 800 iterations at half size used to end with the command for 30,000 iterations at full size."""
    folder, *_ = capture
    code, said = doctor(folder, "--no-forecast", "--iterations", "800", "--resolution", "2")
    words = next(line for line in said.splitlines() if "train: " in line).partition("train: ")[2]
    assert code == 0
    assert words == f"gsplat-edu train {folder} --iterations 800 --resolution 2 --out out/capture"
    assert "--quality draft" not in said
    _, said = doctor(folder, "--no-forecast")
    assert f"gsplat-edu train {folder} --quality draft --out out/capture_draft" in said


def test_faults_are_named_and_the_exit_code_stays_0(doctor, capture, tmp_path):
    _, views, points, colors = capture
    write_colmap(tmp_path, views, points, colors)
    (tmp_path / "images" / "view_003.png").write_bytes(b"")
    (tmp_path / "images" / "view_005.png").unlink()
    code, said = doctor(tmp_path)
    assert code == 0
    assert "unusable: 1 of 23 photos" in said and "view_003.png" in said
    assert "1 missing image of 24 listed, first view_005.png" in said
    # A forecast reads the capture as training would, so it fails in the same way.
    assert (
        "forecast   none, because training would fail" in said and "view_003.png: cannot be decoded" in said
    )


def test_hopeless_captures_end_with_1(doctor, capture, tmp_path):
    _, views, points, colors = capture
    write_transforms(tmp_path / "a", [View(views[0].camera, view.image, name=view.name) for view in views])
    code, said = doctor(tmp_path / "a")
    assert code == 1 and "fatal      no parallax: all cameras are at one place" in said
    assert "what to do:\n  1. walk while you take the photos" in said and "forecast" not in said

    write_colmap(tmp_path / "b", views, points, colors)
    for photo in (tmp_path / "b" / "images").iterdir():
        photo.write_bytes(b"\x89PNG")
    code, said = doctor(tmp_path / "b")
    assert code == 1 and "0 of 24 photos can be used" in said


def test_bad_input_is_one_line_and_2(doctor, capture, tmp_path):
    (tmp_path / "empty").mkdir()
    for words, text in (
        ([tmp_path / "gone"], "does not exist; give a dataset folder or a run folder"),
        ([tmp_path / "empty"], "is not a capture"),
        ([capture[0], "--resolution", "0.5"], "resolution"),
        ([capture[0], "--no-forecast", "--iterations", "0"], "iterations"),
        ([capture[0], "--backend", "abacus"], "abacus"),
        ([capture[0], "--backend", "torch"], "--no-forecast"),
    ):
        code, said = doctor(*words)
        assert code == 2 and said.count("\n") == 1 and text in said


def test_the_forecast_comes_before_the_advice(doctor, capture):
    code, said = doctor(capture[0], "--iterations", "200")
    assert code == 0
    lines = said.splitlines()
    first = next(i for i, line in enumerate(lines) if line.startswith("forecast"))
    assert "200 iterations" in said and first < lines.index("what to do:") and len(lines) <= 24


def test_the_forecast_is_that_of_a_training_without_options(doctor, capture, tmp_path):
    """Without --iterations, doctor forecasts the standard length of the fast recipe, and as many Gaussians as `train`
    plans."""
    code, said = doctor(capture[0])
    assert code == 0
    assert "for 3,000 iterations on cpu" in said and f"200 to {64 * 48:,} Gaussians" in said
    options = options_from(
        command_line.build_parser(["train"]).parse_args(
            ["train", str(capture[0]), "--out", str(tmp_path / "x")]
        )
    )
    chosen = plan(options, Limits())
    assert (chosen.iterations, chosen.max_gaussians) == (3_000, 64 * 48)


@pytest.fixture(scope="module")
def run(capture, tmp_path_factory):
    """A run of the capture whose scene is the start points."""
    folder, _, points, colors = capture
    made = RunFolder(tmp_path_factory.mktemp("made") / "run")
    data = {**dataclasses.asdict(DataSettings(test_every=6)), "path": str(folder), "points": None}
    made.write_config(
        {
            "version": "0",
            "data": data,
            "train": {"iterations": 70},
            "render": dataclasses.asdict(RenderSettings(depth=False)),
            "origin": [0.0, 0.0, 0.0],
            "backend": "cpu",
        }
    )
    save_ply(made.scene(30), splats_on(points, colors))
    dataset = load_dataset(folder, DataSettings(test_every=6))
    made.write_cameras(dataset.train, dataset.test)
    return made


def pasted(said):
    """Return the commands in an output, split as a shell would split them."""
    lines = [line.partition("gsplat-edu ") for line in said.splitlines()]
    return [shlex.split(words) for _, found, words in lines if found]


def test_commands_can_be_pasted(doctor, capture, run, tmp_path, monkeypatch):
    """Commands used to contain the placeholders CAPTURE and RUN, and did not quote names with blanks or quotes."""
    monkeypatch.chdir(tmp_path)
    place = Path("it's a $(place) & more")
    shutil.copytree(capture[0], place / "capture one")
    shutil.copytree(run.path, place / "run; one")
    config = run.read_config()
    data = config["data"] | {"path": str((place / "capture one").resolve()), "resolution": 40.0}
    train = {"iterations": 30, "background": [1.0, 1.0, 1.0], "strategy": "fast", "alpha_background": "fixed"}
    config |= {"data": data | {"test_every": 0}, "train": train}
    RunFolder(place / "run; one").write_config(config)
    said = [doctor(place / "capture one", "--no-forecast")[1], doctor(place / "run; one")[1]]
    commands = [words for text in said for words in pasted(text)]
    assert {words[0] for words in commands} >= {"train", "render"} and len(commands) >= 5
    for words in commands:
        parsed = command_line.build_parser(words).parse_args(words)
        assert parsed.command == words[0]
        # The path exists, or the previous command would create it.
        assert (str(place) in words[1] and Path(words[1]).exists()) or words == ["doctor", "out/capture one"]
        assert "RUN" not in words and "CAPTURE" not in words
    renders = next(words for words in commands if words[0] == "render")
    assert command_line.main([*renders, "--frames", "2"]) == 0 and Path("orbit.mp4").is_file()
    longer = next(words for words in commands if "--iterations" in words)
    assert "--strategy" not in longer, "the default is left out"
    assert longer[longer.index("--resolution") + 1] == "40"
    assert longer[longer.index("--test-every") + 1] == "0", "an option of value 0 is kept"
    assert longer[longer.index("--background") + 1 :][:3] == ["1", "1", "1"]
    assert command_line.main([*longer, "--iterations", "2"]) == 0 and Path("out/run; one_3000").is_dir()
    # The advice repeats the recipe of the run. A run without a stored recipe was trained by adc.
    for changes, strategy in (
        ({"strategy": "mcmc", "max_gaussians": 300, "refine": "poses", "surface": True}, "mcmc"),
        ({"strategy": None}, "adc"),
    ):
        changed = {key: value for key, value in (train | changes).items() if value is not None}
        RunFolder(place / "run; one").write_config(config | {"train": changed})
        longer = next(words for words in pasted(doctor(place / "run; one")[1]) if "30000" in words)
        assert longer[longer.index("--strategy") + 1] == strategy
        for name in ("max_gaussians", "refine", "surface"):
            flag, value = f"--{name.replace('_', '-')}", changes.get(name)
            assert (flag in longer) == (name in changes), (
                "settings are repeated where they are not the default"
            )
            assert value in (None, True) or longer[longer.index(flag) + 1] == str(value)


def test_the_proposed_output_folder_does_not_exist_yet(doctor, capture, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "out" / "capture").mkdir(parents=True)
    assert f"train {capture[0]} --out out/capture_2" in doctor(capture[0], "--no-forecast")[1]


def test_an_exposure_jump_is_named_before_and_after_training(doctor, capture, run, tmp_path):
    """One photo is 0.7 stops brighter. The warning used to disappear once a trained scene fitted that photo."""
    _, views, points, colors = capture
    jumped = [
        View(v.camera, np.clip(v.image * (1.25 if i == 3 else 1.0), 0, 255).astype(np.uint8), name=v.name)
        for i, v in enumerate(views)
    ]
    write_colmap(tmp_path / "capture", jumped, points, colors)
    shutil.copytree(run.path, tmp_path / "run")
    config = run.read_config()
    data = config["data"] | {"path": str(tmp_path / "capture")}
    RunFolder(tmp_path / "run").write_config(config | {"data": data})
    for said in (doctor(tmp_path / "capture", "--no-forecast")[1], doctor(tmp_path / "run")[1]):
        lines = [line for line in said.splitlines() if line.startswith("warning    exposure")]
        assert any("view_003.png" in line for line in lines), said


def test_a_run_is_examined(doctor, run):
    code, said = doctor(run.path)
    lines = said.splitlines()
    assert code == 0 and len(lines) <= 24 and lines[-4] == "what to do:"
    assert (
        "30 iterations, 200 splats" in said
        and "unfinished: the scene was saved at iteration 30 of 70" in said
    )
    assert "4 views, PSNR" in said and "20 views, PSNR" in said

    _, said = doctor(run.path, "--all-views")
    values = [float(line.split()[0]) for line in said.splitlines() if " dB  t" in line]
    assert len(values) == 24 and values == sorted(values)


def test_a_dataset_that_moved_is_named(doctor, run, capture, tmp_path):
    config = run.read_config()
    moved = RunFolder(tmp_path / "moved")
    moved.write_config({**config, "data": {**config["data"], "path": "/gone"}})
    assert doctor(moved.path)[0] == 2, "a run without a scene is an error"
    moved.scene(5).parent.mkdir(parents=True)
    moved.scene(5).write_bytes(run.scene(30).read_bytes())
    code, said = doctor(moved.path)
    assert code == 2 and "/gone: the run's dataset no longer exists" in said
    assert doctor(moved.path, "--dataset", capture[0])[0] == 0


def real(name):
    shared = Path(__file__).parents[3] / "shared" / "data"
    folder = Path(os.environ.get("GSPLAT_EDU_DATA", shared)) / name
    if not folder.exists():
        pytest.skip(f"{name} is not on this machine; see GSPLAT_EDU_DATA")
    return folder


def test_snowmiku97(doctor):
    """Checked by eye: two photos have motion blur; automatic exposure brightens the far side of the toy (3944, 3945),
    and a bed and a wall of which the photographer's shadow darkens a half (4028).
    """
    code, said = doctor(real("snowmiku97"), "--no-forecast")
    blurred, exposure = (
        "\n".join(x for x in said.splitlines() if f"warning    {n}" in x) for n in ("blur", "expo")
    )
    assert code == 0
    assert "2 of 97" in blurred and "003946" in blurred and "004020" in blurred
    assert all(f"{name}.jpg (+" in exposure for name in ("003945", "003944", "004028"))
    assert said.count("warning") == 2


def test_fox(doctor):
    code, said = doctor(real("fox"), "--no-forecast")
    assert code == 0 and "17 missing images of 67 listed" in said and said.count("warning") == 1


def test_truck11(doctor):
    """Its focal lengths are wrong; with the correct ones, about 385 px, every point would be visible."""
    code, said = doctor(real("truck11"), "--no-forecast")
    assert code == 0 and said.count("warning") == 3
    for words in (
        "11 photos are few",
        "fx is 1198 px and fy 501.4",
        "9.5 % of the points lie outside every camera's view",
    ):
        assert words in said, words


def test_help_shows_an_example(doctor, capsys):
    code, said = doctor("--help")
    assert code == 0 and "example: gsplat-edu doctor " in said


def test_the_findings_do_not_depend_on_the_distance_from_the_origin(doctor, capture, tmp_path):
    """Map coordinates stay in float64, so the findings are the same."""
    _, views, points, colors = capture
    away = np.array([431000.0, 5400000.0, 300.0])
    moved = [
        View(dataclasses.replace(v.camera, eye=v.camera.eye + away), v.image, name=v.name) for v in views
    ]
    write_colmap(tmp_path, moved, points + away, colors)
    code, said = doctor(tmp_path, "--no-forecast")
    assert code == 0 and "warning" not in said
