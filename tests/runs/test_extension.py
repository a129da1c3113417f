"""Runs that are extended, that start from another scene, or that are resumed with changed photos."""

import dataclasses
import json
import os
import shutil

import numpy as np
import pytest
import torch
from PIL import Image

from gsplat_edu.base.errors import CheckpointError, DatasetError
from gsplat_edu.base.locks import locked
from gsplat_edu.cli.main import build_parser, main
from gsplat_edu.data.procedural import procedural_capture
from gsplat_edu.data.writers import write_colmap
from gsplat_edu.io.formats import write_scene
from gsplat_edu.io.ply import load_ply, save_ply
from gsplat_edu.io.scene import Scene
from gsplat_edu.options.train import options_from
from gsplat_edu.runs.folder import RunFolder
from gsplat_edu.runs.training import CaptureRun, is_finished
from gsplat_edu.train.config import BY_NAME, TrainConfig, recipe
from gsplat_edu.train.density.surgery import sorted_in_space
from gsplat_edu.train.events import StepEvent

pytestmark = pytest.mark.slow

BASE = ["--eval-every", "1000", "--save-every", "5", "--set", "densify_start=1", "densify_every=4"]
ADC = ["--strategy", "adc", "--set", "grad_threshold=5e-5"]
STRATEGIES = {
    "fast": [],  # the default
    "adc": ADC,
    "mcmc": ["--strategy", "mcmc", "--max-gaussians", "70", "--set", "mcmc_growth=1.1"],
    "none": ["--strategy", "none"],
}
VIEWS = 6


@pytest.fixture(scope="module", autouse=True)
def one_torch_thread():
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    folder = tmp_path_factory.mktemp("captures") / "egg"
    write_colmap(folder, *procedural_capture(24, VIEWS, splats=60))
    (folder / "masks").mkdir()
    for photo in (folder / "images").iterdir():
        with Image.open(photo) as file:
            Image.new("L", file.size, 255).save(folder / "masks" / photo.name)
    return folder


def train(capture, out, *options):
    return main(["train", str(capture), "--out", str(out), *BASE, *ADC, *options])


def options(capture, out, *words):
    words = ["train", str(capture), "--out", str(out), *BASE, *ADC, *words]
    return options_from(build_parser(words).parse_args(words))


def ply(out, iterations):
    return RunFolder(out).scene(iterations).read_bytes()


@pytest.fixture(scope="module")
def finished(capture, tmp_path_factory):
    """A run of 20 iterations with the milestones of the recipe for 20."""
    out = tmp_path_factory.mktemp("runs") / "egg"
    assert train(capture, out, "--iterations", "20") == 0
    return out


@pytest.fixture
def run(finished, tmp_path):
    shutil.copytree(finished, tmp_path / "run")
    return tmp_path / "run"


@pytest.fixture(scope="module")
def whole(capture, tmp_path_factory):
    """An uninterrupted run of 30 iterations with the milestones for 20."""
    short, words = recipe(20), []
    for name in ("means_rate_iterations", "sh_every", "densify_stop", "reset_every"):
        words += BY_NAME[name].with_value(short.flat()[name]).split()
    out = tmp_path_factory.mktemp("whole") / "egg"
    assert train(capture, out, "--iterations", "30", *words) == 0
    return out


def test_a_finished_run_is_extended_with_its_own_milestones(capture, finished, whole, run, capsys):
    assert train(capture, run, "--iterations", "30", "--resume") == 0
    said = capsys.readouterr().out.replace("\n", " ")
    assert "extended from 20 to 30 iterations" in said and "resuming after 20 iterations" in said
    assert ply(run, 30) == ply(whole, 30) != ply(finished, 20)
    config = RunFolder(run).read_config()
    assert config["history"] == [{"iteration": 20, "iterations_before": 20, "iterations": 30}]
    assert config["train"]["densify_stop"] == recipe(20).adc.densify_stop
    metrics = RunFolder(run).read_metrics()
    assert metrics["iterations"] == 30
    assert [line["iteration"] for line in RunFolder(run).log() if "loss" in line] == [10, 20, 30]
    assert train(capture, run, "--resume") == 0
    assert "is finished, 30 iterations; nothing to do" in capsys.readouterr().out.replace("\n", " ")


def test_an_extended_mcmc_run_equals_one_run_with_the_same_milestones(capture, tmp_path):
    """Both runs relocate (opacities start at 0.5) and grow until the shorter schedule ends, then only add noise."""

    def mcmc(out, *words):
        numbers = ["--strategy", "mcmc", "--max-gaussians", "60", "--set", "min_opacity=0.58", *BASE, *words]
        assert main(["train", str(capture), "--out", str(tmp_path / out), *numbers]) == 0

    short = recipe(20).flat()
    names = ("means_rate_iterations", "sh_every", "mcmc_stop")
    given = [word for name in names for word in BY_NAME[name].with_value(short[name]).split()]
    mcmc("extended", "--iterations", "20")
    mcmc("extended", "--iterations", "30", "--resume")
    mcmc("whole", "--iterations", "30", *given)
    assert ply(tmp_path / "extended", 30) == ply(tmp_path / "whole", 30) != ply(tmp_path / "extended", 20)
    moved = [line for line in RunFolder(tmp_path / "extended").log() if line.get("event") == "relocate"]
    assert moved[-1]["iteration"] <= 17 and any(line["num_relocated"] for line in moved)
    assert set(RunFolder(tmp_path / "extended").log()[-1]["terms"]) == {"photo", "opacity", "scale"}


@pytest.mark.parametrize("strategy", STRATEGIES)
def test_a_run_is_resumed_with_its_own_strategy_unless_another_is_named(capture, tmp_path, capsys, strategy):
    words, (whole, out) = STRATEGIES[strategy], (tmp_path / "whole", tmp_path / "cut")
    other, unnamed = "none" if strategy == "fast" else "fast", words[2:]  # without "--strategy NAME"

    def run(out, *words):
        return main(["train", str(capture), "--out", str(out), *BASE, *words])

    assert run(whole, "--iterations", "20", *words) == 0
    assert run(out, "--iterations", "20", *words, "--time-limit", "0.001s") == 0
    assert RunFolder(out).read_metrics()["iterations"] < 20
    capsys.readouterr()
    assert run(out, "--strategy", other, "--resume") == 2
    error = capsys.readouterr().err
    assert f"was started with strategy = {strategy}, not {other}" in error and error.count("\n") == 1
    if strategy != "adc":
        assert run(out, "--set", "grad_threshold=5e-5", "--resume") == 2
        assert "--set grad_threshold: only --strategy adc uses it" in capsys.readouterr().err
    assert run(out, *unnamed, "--resume") == 0
    assert ply(out, 20) == ply(whole, 20)
    assert RunFolder(out).read_config()["train"] == RunFolder(whole).read_config()["train"]
    assert RunFolder(out).read_config()["train"]["strategy"] == strategy


def test_a_longer_quality_extends_a_run_and_a_shorter_one_is_refused(capture, tmp_path, capsys, monkeypatch):
    """A quality stands for a number of iterations, which replaces that of config.json."""
    monkeypatch.setattr("gsplat_edu.train.length.UNIT", 4)
    monkeypatch.setattr("gsplat_edu.runs.thin.LENGTHS", (1,))

    def run(*words):
        return main(["train", str(capture), "--out", str(tmp_path / "run"), *BASE, *words])

    assert run() == 0 and RunFolder(tmp_path / "run").read_metrics()["iterations"] == 12
    stop = RunFolder(tmp_path / "run").read_config()["train"]["fast_stop"]
    capsys.readouterr()
    assert run("--quality", "draft", "--resume") == 2
    assert "with iterations = 12, not 4: a run can be extended, not shortened" in capsys.readouterr().err
    assert run("--quality", "high", "--resume") == 0
    train = RunFolder(tmp_path / "run").read_config()["train"]
    assert (train["iterations"], train["fast_stop"]) == (40, stop), "milestones are not scaled again"
    assert RunFolder(tmp_path / "run").read_metrics()["iterations"] == 40


def test_a_run_is_complete_once_it_is_constructed(capture, tmp_path):
    """A program may inspect a run, save it, train it in parts and finish it."""
    chosen, events = options(capture, tmp_path / "run", "--iterations", "6"), []
    assert not is_finished(chosen)
    run = CaptureRun(chosen)
    assert (run.trainer.iteration, run.seconds, len(run.dataset.train)) == (0, 0.0, VIEWS - 1)
    assert run.save().name == "iteration_0.safetensors"
    assert run.train(lambda: run.trainer.iteration >= 2, [lambda trainer, event: events.append(event)])
    with pytest.raises(CheckpointError, match="already holds a run"):
        CaptureRun(chosen)
    resumed = CaptureRun(dataclasses.replace(chosen, resume=True))
    assert resumed.trainer.iteration == 2 == len([event for event in events if isinstance(event, StepEvent)])
    assert not run.train() and run.seconds > 0.0
    run.finish()
    assert is_finished(dataclasses.replace(chosen, resume=True))


def test_an_interrupted_extension_gives_the_same_bytes(capture, whole, run):
    capture_run = CaptureRun(_resumed_options(capture, run, "--iterations", "30", "--resume"))
    trainer = capture_run.trainer
    assert capture_run.train(lambda: trainer.iteration >= 23)
    assert RunFolder(run).read_metrics()["iterations"] == 20, "the extension is not finished yet"
    assert train(capture, run, "--resume") == 0, "config.json has the new length"
    assert ply(run, 30) == ply(whole, 30)


def test_an_unfinished_run_is_extended_and_no_run_is_shortened(capture, whole, tmp_path, capsys):
    out = tmp_path / "run"
    first = CaptureRun(options(capture, out, "--iterations", "20"))
    trainer = first.trainer
    first.train(lambda: trainer.iteration >= 7)
    assert train(capture, out, "--iterations", "19", "--resume") == 2
    error = capsys.readouterr().err
    assert "started with iterations = 20, not 19: a run can be extended, not shortened" in error
    assert error.count("\n") == 1
    assert train(capture, out, "--iterations", "30", "--resume") == 0
    assert ply(out, 30) == ply(whole, 30)
    (entry,) = RunFolder(out).read_config()["history"]
    assert entry == {"iteration": 7, "iterations_before": 20, "iterations": 30}


def _resumed_options(capture, out, *words):
    from gsplat_edu.budget.planned import taken_up

    given = [
        "densify_start",
        *(["iterations"] if "--iterations" in words else []),
    ]  # BASE gives densify_start
    return taken_up(options(capture, out, *words), given)


def test_a_run_starts_from_a_run(capture, finished, tmp_path, capsys):
    out = tmp_path / "from"
    assert train(capture, out, "--iterations", "4", "--from", str(finished)) == 0
    count = RunFolder(finished).read_metrics()["num_gaussians"]
    said = capsys.readouterr().out.replace("\n", " ")
    assert f"{count} Gaussians to start from" in said
    config = RunFolder(out).read_config()
    assert config["data"]["scene"] == str(RunFolder(finished).scene(20))
    assert (config["train"]["sh_every"], config["train"]["means_rate"]) == (0, 1.6e-5)
    first = CaptureRun(options(capture, tmp_path / "x", "--iterations", "4", "--from", str(finished)))
    trainer = first.trainer
    loaded = sorted_in_space(load_ply(RunFolder(finished).scene(20)))
    for name, tensor in loaded.tensors().items():
        assert torch.equal(trainer.gaussians.tensors()[name].detach(), tensor), name
    # the scene is a better start than the points
    scores = [RunFolder(folder).read_metrics()["train"]["psnr"] for folder in (finished, out)]
    assert scores[1] > scores[0]


def test_a_run_from_a_scene_is_resumed_with_it_or_without_its_name(capture, finished, tmp_path, capsys):
    scene = tmp_path / "scene.ply"
    scene.write_bytes(ply(finished, 20))
    out = tmp_path / "run"
    first = CaptureRun(options(capture, out, "--iterations", "8", "--from", str(scene)))
    trainer = first.trainer
    first.train(lambda: trainer.iteration >= 5)
    shutil.copytree(out, tmp_path / "other")
    assert train(capture, out, "--iterations", "8", "--resume") == 0
    gaussians = load_ply(scene)
    save_ply(scene, gaussians.map(lambda tensor: tensor[:-1]))
    other = tmp_path / "other"
    assert train(capture, other, "--iterations", "8", "--resume", "--from", str(scene)) == 2
    error = capsys.readouterr().err
    assert "was not started from" in error and error.count("\n") == 1
    scene.unlink()
    assert train(capture, other, "--resume") == 0, (
        "the checkpoint has everything that the run took from the scene"
    )
    assert ply(other, 8) == ply(out, 8)
    capsys.readouterr()
    assert train(capture, finished, "--iterations", "20", "--resume", "--from", str(out)) == 2
    assert "was started from points" in capsys.readouterr().err


def test_scenes_of_other_degrees_origins_and_broken_splats(capture, finished, tmp_path, capsys):
    """The scene has degree 1, the run degree 2; the scene has a NaN and a zero quaternion; the capture is far from
    zero."""
    views, points, colors = procedural_capture(24, VIEWS, splats=60)
    shift = np.array([1e5, -2e5, 3e4])
    far = []
    for view in views:
        c = view.camera
        camera = type(c)(c.R, c.eye + shift, c.fx, c.fy, c.cx, c.cy, c.H, c.W)
        far.append(type(view)(camera, view.image, name=view.name))
    write_colmap(tmp_path / "far", far, points + shift, colors)
    near = load_ply(RunFolder(finished).scene(20))
    broken = near.map(lambda tensor: tensor.clone())
    parts = broken.tensors() | {"sh_rest": broken.sh_rest[:, :3].clone()}
    broken = type(near)(**parts)
    broken.quats[3] = 0.0
    path = tmp_path / "far.ply"
    save_ply(path, broken, shift)
    raw = bytearray(path.read_bytes())
    row = (len(raw) - raw.index(b"end_header\n") - 11) // len(near)
    at = len(raw) - row * len(near) + 5 * row
    raw[at : at + 4] = np.float32(np.nan).tobytes()
    path.write_bytes(raw)
    run = CaptureRun(
        options(
            tmp_path / "far", tmp_path / "run", "--iterations", "2", "--sh-degree", "2", "--from", str(path)
        ),
        say := _Said(),
    )
    trainer = run.trainer
    assert len(trainer.gaussians) == len(near) - 2 and "2 of" in say.text and "left out" in say.text
    assert "contains harmonics up to degree 1; the others start at zero" in say.text
    assert trainer.gaussians.sh_rest.shape[1] == 8
    # a run sorts its Gaussians, which are identified by their colours
    kept = in_order_of_colour(near.map(lambda t: t[[i for i in range(len(near)) if i not in (3, 5)]]))
    found = in_order_of_colour(trainer.gaussians.map(torch.Tensor.detach))
    assert torch.equal(found.sh0, kept.sh0) and len(torch.unique(found.sh0, dim=0)) == len(found)
    # float32 near 2e5 has steps of 2**-6, and writing rounds by half a step
    moved = torch.tensor(run.dataset.origin - shift).float()
    np.testing.assert_allclose(found.means + moved, kept.means, atol=2**-7)
    assert torch.equal(found.sh_rest[:, :3], kept.sh_rest[:, :3])
    assert not found.sh_rest[:, 3:].any()


def in_order_of_colour(gaussians):
    order = np.lexsort(gaussians.sh0.reshape(len(gaussians), -1).T.numpy())
    return gaussians.map(lambda tensor: tensor[order])


class _Said:
    text = ""

    def __call__(self, sentence):
        self.text += sentence + "\n"


def test_mismatched_antialiasing_is_reported(capture, finished, tmp_path):
    gaussians = load_ply(RunFolder(finished).scene(20))
    cases = (
        (True, [], "was trained with antialiasing, but this run trains without"),
        (False, ["--antialiased"], "was trained without antialiasing, but this run trains with"),
        (True, ["--antialiased"], None),
    )
    for i, (antialiased, words, says) in enumerate(cases):
        path, out = tmp_path / "scene.glb", tmp_path / f"run{i}"
        write_scene(path, Scene(gaussians, antialiased))
        CaptureRun(options(capture, out, "--iterations", "2", "--from", str(path), *words), say := _Said())
        assert (says in say.text) if says else ("was trained" not in say.text)


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["--max-gaussians", "10"], "more than max_gaussians = 10"),
        (["--points", "x.ply"], "not allowed with argument"),
        (["--set", "start_opacity=0.2"], "--set start_opacity: only a start from points uses it"),
    ],
)
@pytest.mark.usefixtures("as_shipped")
def test_options_that_conflict_with_a_scene_are_refused(capture, finished, tmp_path, capsys, words, says):
    try:
        code = train(capture, tmp_path / "run", "--iterations", "4", "--from", str(finished), *words)
    except SystemExit as stop:
        code = stop.code
    error = capsys.readouterr().err
    assert code == 2 and says in error and error.count("\n") == 1
    assert not (tmp_path / "run").exists()


def changed(path):
    with Image.open(path) as file:
        pixels = np.array(file)
    Image.fromarray(255 - pixels).save(path)


def copied(capture, tmp_path):
    shutil.copytree(capture, tmp_path / "moved", copy_function=shutil.copyfile)  # with new modification times
    return tmp_path / "moved"


@pytest.mark.parametrize("part", ["images", "masks"])
def test_a_photo_that_changed_before_a_resume_is_named(capture, tmp_path, capsys, part):
    """The fingerprint of older runs does not cover a photo in the middle. Touching a photo does not change it."""
    moved, out = copied(capture, tmp_path), tmp_path / "run"
    assert train(moved, out, "--iterations", "2", "--time-limit", "0.001s") == 0
    photo = moved / part / "view_003.png"
    os.utime(photo, ns=(1, 1))
    assert train(capture, out, "--iterations", "2", "--resume", "--time-limit", "0.001s") == 0
    before = photo.read_bytes()
    changed(photo)
    capsys.readouterr()
    assert train(moved, out, "--iterations", "4", "--resume") == 2
    error = capsys.readouterr().err
    assert "different photos: 1 of 6 changed since the run started, first view_003.png" in error
    assert error.count("\n") == 1
    photo.write_bytes(before)
    assert train(moved, out, "--iterations", "4", "--resume") == 0


def test_an_older_run_resumes_with_the_older_check(capture, whole, tmp_path, capsys):
    out = tmp_path / "run"
    first = CaptureRun(options(capture, out, "--iterations", "6"))
    trainer = first.trainer
    first.train(lambda: trainer.iteration >= 3)
    RunFolder(out).photos.unlink()
    config = RunFolder(out).read_config()
    del config["data"]["scene"]
    RunFolder(out).write_config(config)
    moved = copied(capture, tmp_path)
    changed(moved / "images" / "view_001.png")  # the first view of training
    assert train(moved, out, "--resume") == 2
    assert "different photos or start points" in capsys.readouterr().err
    assert train(capture, out, "--resume") == 0


def test_a_photo_that_changes_during_a_run_ends_it_with_its_state_saved(capture, tmp_path):
    moved, out = copied(capture, tmp_path), tmp_path / "run"
    words = ["--iterations", "12", "--image-memory", "0"]
    assert train(moved, tmp_path / "undisturbed", *words) == 0
    run = CaptureRun(options(moved, out, *words))
    photos = sorted((moved / "images").iterdir())
    before = [photo.read_bytes() for photo in photos]

    def stop():
        if trainer.iteration == 7 and photos[0].read_bytes() == before[0]:
            for photo in photos:
                changed(photo)
        for photo in photos:
            os.utime(photo)  # only its time changes
        return False

    trainer = run.trainer
    with pytest.raises(
        DatasetError, match=r"view_00\d\.png: has changed since it was first read; .* saved after"
    ) as e:
        run.train(stop)
    assert 7 <= trainer.iteration <= 8 and f"saved after {trainer.iteration} iterations" in str(e.value)
    assert RunFolder(out).checkpoints.joinpath(f"iteration_{trainer.iteration}.safetensors").exists()
    for photo, content in zip(photos, before, strict=True):
        photo.write_bytes(content)
    assert train(moved, out, *words, "--resume") == 0
    assert ply(out, 12) == ply(tmp_path / "undisturbed", 12)


def test_a_folder_in_use_is_refused_by_train_and_eval(capture, run, tmp_path, capsys):
    with locked("--out", run, "gsplat-edu train", pytest.fail):
        for words in (["train", str(capture), "--out", str(run), "--resume"], ["eval", str(run)]):
            assert main(words) == 2
            error = capsys.readouterr().err
            assert (
                f"is in use by `gsplat-edu train`, process {os.getpid()} on " in error
                and error.count("\n") == 1
            )
        assert main(["eval", str(run), "--out", str(tmp_path / "apart")]) == 0, "it writes to another folder"
    assert main(["eval", str(run)]) == 0
    assert json.loads((run / "metrics.json").read_text())["iterations"] == 20


def test_the_progress_names_the_photo_of_its_psnr(capture, tmp_path, capsys):
    assert train(capture, tmp_path / "run", "--iterations", "2") == 0
    lines = [line for line in capsys.readouterr().out.splitlines() if line.startswith("iteration ")]
    assert len(lines) == 2 and all("dB of view_00" in line for line in lines)


def test_the_defaults_of_a_start_from_a_scene_are_in_the_help(capsys):
    with pytest.raises(SystemExit):
        main(["train", "--help"])
    said = " ".join(capsys.readouterr().out.split())
    assert "--from SCENE|RUN" in said and "means_rate is 1.6e-05 unless --set gives it" in " ".join(
        said.split()
    )
    assert TrainConfig().means_rate == 1.6e-4
