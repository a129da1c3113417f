"""`gsplat-edu train`: options become a recipe, and bad input is a one-line error."""

import dataclasses
import json
from argparse import ArgumentTypeError

import pytest
from PIL import Image

from gsplat_edu.base.errors import ArgumentError, CheckpointError
from gsplat_edu.cli.main import build_parser, main
from gsplat_edu.data.procedural import procedural_capture
from gsplat_edu.data.writers import write_colmap, write_transforms
from gsplat_edu.options.train import options_from
from gsplat_edu.options.values import bytes_text, seconds_text
from gsplat_edu.runs.folder import RunFolder
from gsplat_edu.runs.identity import check_options
from gsplat_edu.runs.training import document
from gsplat_edu.train.config import ONLY_WITH, SETTINGS, TrainConfig, recipe
from gsplat_edu.train.length import QUALITIES


def parsed(words):
    return build_parser(words).parse_args(words)


def options(*words):
    return options_from(parsed(["train", "somewhere", "--out", "run", *words]))


def test_without_options_the_recipe_is_fast_with_3000_iterations():
    chosen = options()
    assert chosen.config == recipe(3_000, strategy="fast")
    assert (chosen.config.strategy, chosen.config.iterations) == ("fast", 3_000)
    assert chosen.config.max_gaussians is None, "the cap is planned from the capture"
    assert chosen.data_settings.background is None, "photos keep their alpha"
    assert options("--iterations", "500").config == recipe(500, strategy="fast")


def test_the_other_recipes_are_those_of_their_papers():
    assert options("--strategy", "adc").config == TrainConfig() == recipe()
    mcmc = options("--strategy", "mcmc", "--max-gaussians", "500").config
    assert mcmc == recipe(strategy="mcmc", max_gaussians=500) and mcmc.iterations == 30_000


def test_options_reach_the_recipe():
    words = "--iterations 7000 --strategy mcmc --max-gaussians 500 --seed 3 --antialiased --white-background"
    words += " --set mcmc_stop=4000 jacobian_limit=none --random-background --set opacities_rate=0.025"
    chosen = options(*words.split())
    assert chosen.config == recipe(
        7_000,
        strategy="mcmc",
        max_gaussians=500,
        seed=3,
        antialiased=True,
        background=(1.0, 1.0, 1.0),
        mcmc_stop=4_000,
        jacobian_limit=None,
        random_background=True,
        opacities_rate=0.025,
    )
    assert chosen.data_settings.background is None, "photos keep their alpha for random backgrounds"


def test_set_takes_several_settings_and_the_last_value_counts():
    words = ["--set", "sh-every=7", "min_opacity=0.03", "--set", "sh_every=9"]
    assert options(*words).config == recipe(3_000, strategy="fast", sh_every=9, min_opacity=0.03)


def test_the_other_strategies_and_colours():
    assert options("--strategy", "none").config.strategy == "none"
    colored = options("--background", "0.1", "0.2", "0.3")
    assert colored.config.background == colored.data_settings.background == (0.1, 0.2, 0.3)
    assert colored.config.alpha_background == "fixed"
    both = options("--white-background", "--set", "alpha_background=random")
    assert both.config.background == (1.0, 1.0, 1.0)
    assert both.data_settings.background is None
    window = ["--no-rescale", "--set", "densify_start=26000", "densify_stop=28000"]
    late = options("--strategy", "adc", *window).config
    assert late.adc.densify_stop == 28_000, "the window of a strategy that is not used is not checked"


def test_the_quality_is_the_length_of_the_fast_recipe():
    lengths = {name: options("--quality", name).config.iterations for name in QUALITIES}
    assert lengths == {"draft": 1_000, "standard": 3_000, "high": 10_000}, (
        "planned anew once the capture is read"
    )
    assert options().config == options("--strategy", "fast").config == options("--quality", "standard").config
    config, full = options("--iterations", "300").config, recipe(strategy="fast")
    assert config.iterations == 300 and 100 * config.fast.full_size == full.fast.full_size
    assert 100 * config.sh_every == full.sh_every
    for words, said in (
        (["--quality", "best"], "--quality: is 'best', but has to be one of draft, standard, high"),
        (["--strategy", "adc", "--quality", "high"], "--quality: is the length of --strategy fast"),
        (["--quality", "high", "--iterations", "9"], "--quality: --iterations or --time-limit"),
        (["--quality", "high", "--time-limit", "9m"], "--quality: --iterations or --time-limit"),
        (["--strategy", "adc", "--set", "fast_stop=9"], "--set fast_stop: only --strategy fast uses it"),
        (["--set", "densify_stop=9"], "--set densify_stop: only --strategy adc uses it"),
    ):
        with pytest.raises(ArgumentError, match=said):
            options(*words)


def test_the_help_names_every_setting_and_how_to_give_it(capsys):
    with pytest.raises(SystemExit):
        main(["train", "--help-all"])
    said = capsys.readouterr().out
    for setting in SETTINGS:
        way = f"  {setting.name}=" if setting.settable else f"--{setting.name.replace('_', '-')}"
        assert (way in said) == (setting.only != "course"), setting.name
    assert "example: gsplat-edu train" in said


def test_config_json_has_flat_names(tmp_path):
    """The config of an `mcmc` run. Resuming compares configurations key by key."""
    flat = {
        "iterations": 700, "tempo": "", "seed": 0,
        "means_rate": 0.00016, "means_rate_final": 1.6e-06, "means_rate_iterations": 700,
        "quats_rate": 0.001, "scales_rate": 0.005, "sh0_rate": 0.0025, "sh_rest_rate": 0.000125, "opacities_rate": 0.05,
        "adam_eps": 1e-15, "ssim_weight": 0.2, "sh_degree": 3, "sh_every": 23, "view_order": "shuffled",
        "background": [1.0, 1.0, 1.0], "random_background": False, "antialiased": False, "jacobian_limit": 1.3,
        "start_opacity": 0.1, "start_scale": 1.0, "strategy": "mcmc", "max_gaussians": 90, "over_cap": "strongest",
        "densify_start": 12, "densify_stop": 350, "densify_every": 100, "grad_threshold": 0.0002, "percent_dense": 0.01,
        "split_shrink": 1.6, "min_opacity": 0.005, "prune_scale": 0.1, "reset_every": 0,
        "reset_opacity": 0.01, "mcmc_stop": 583, "mcmc_start_opacity": 0.5, "mcmc_start_scale": 0.1, "mcmc_growth": 1.1,
        "mcmc_noise": 500000.0, "mcmc_opacity_weight": 0.01, "mcmc_scale_weight": 0.01,
    }  # fmt: skip
    words = "--iterations 700 --strategy mcmc --max-gaussians 90 --set mcmc_growth=1.1 --white-background"
    found = json.loads(json.dumps(document(options(*words.split()))))
    newer = {name for name in found["train"] if name.startswith("fast_")} | {
        "alpha_background",
        "appearance",
        "batch",
        "sky",
        "refine",
        "pose_spread",
        "lens_rate",
        "transients",
        "outside_masks",
        "region",
        "surface",
        *ONLY_WITH["surface"],
        *ONLY_WITH["depth"],
    }
    assert {name: value for name, value in found["train"].items() if name not in newer} == flat
    folder = RunFolder(tmp_path)
    folder.write_config(found | {"train": {**found["train"], "grad_threshold": 0.1}})
    check_options(folder, found)
    folder.write_config(found | {"train": {k: v for k, v in found["train"].items() if k != "mcmc_noise"}})
    with pytest.raises(CheckpointError, match="was started with mcmc_noise = None, not 500000.0"):
        check_options(folder, found)
    config = TrainConfig().changed(**flat | {"background": tuple(flat["background"])})
    now = options(*words.split()).config
    newer = {"fast": now.fast, "surface_start": now.surface_start, "alpha_background": "fixed"}
    assert dataclasses.replace(config, **newer) == now and config.mcmc.growth == 1.1


@pytest.mark.parametrize(
    ("text", "seconds"), [("90", 90), ("90s", 90), ("1.5m", 90), ("1h30m", 5400), ("2h", 7200)]
)
def test_durations(text, seconds):
    assert seconds_text(text) == seconds


@pytest.mark.parametrize("limit", [["--max-memory", "4GiB"], ["--time-limit", "20m"]])
def test_mcmc_leaves_its_cap_to_the_plan_if_there_is_one(limit):
    words = ["train", "capture", "--out", "run", "--strategy", "mcmc", *limit]
    assert options_from(build_parser(["train"]).parse_args(words)).config.max_gaussians is None


@pytest.mark.parametrize(
    ("text", "size"), [("4GiB", 4 * 2**30), ("500MB", 500e6), ("1e9", 1e9), ("0", 0), ("3k", 3000)]
)
def test_sizes(text, size):
    assert bytes_text(text) == size


@pytest.mark.parametrize(
    "text", ["1e999GiB", "1e300T", "2000000000G", "-1", "nan", "inf", f"{'9' * 400}", "4 apples"]
)
def test_sizes_that_no_machine_has_are_refused(text):
    with pytest.raises(ArgumentTypeError, match="is not a size"):
        bytes_text(text)


@pytest.mark.parametrize("text", [f"{'9' * 400}s", f"{'9' * 400}h1s", "1e9", "inf", "nan", "0", "3000000h"])
def test_durations_that_no_training_has_are_refused(text):
    with pytest.raises(ArgumentTypeError, match="is not a duration"):
        seconds_text(text)


@pytest.mark.parametrize("number", ["inf", "nan", "1e999", "-inf"])
@pytest.mark.parametrize(
    "words", ["train x --out y --resolution", "mesh x y.ply --voxel", "clean x --max-loss"]
)
def test_numbers_are_finite(words, number, capsys):
    with pytest.raises(SystemExit):
        parsed(f"{words}={number}".split())
    assert f"{number!r} is not a number" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "named"),
    [
        (["--iterations", "0"], "iterations"),
        (["--strategy", "best"], "strategy"),
        (["--strategy", "mcmc"], "--max-gaussians"),
        (["--strategy", "mcmc", "--time-limit", "9s", "--iterations", "9"], "--max-gaussians"),
        (["--time-limit", "soon"], "--time-limit"),
        (["--image-memory", "much"], "--image-memory"),
        (["--resolution", "-2"], "resolution"),
        (["--test-every", "1"], "--test-every: "),
        (["--backend", "gpu"], "backend"),
        (["--max-gaussians", "0"], "--max-gaussians: "),
        (["--set", "densify_start=20000"], "--set fast_stop: "),
        (["--strategy", "adc", "--set", "densify_start=20000"], "densify_stop"),
        (["--image-memory", "1e400"], "--image-memory"),
        (["--set", "means_rate=none"], "--set: means_rate: 'none' is not a number"),
        (["--set", "mcmc_noise=1"], "--set mcmc_noise"),
        (
            ["--set", "grad_threshold=1e-4"],
            "--set grad_threshold: only --strategy adc uses it; leave it out or choose",
        ),
        (["--strategy", "none", "--set", "reset_every=5"], "--set reset_every"),
        (["--background", "1", "1", "2", "--white-background"], "--background"),
        (["--set", "grad_treshold=1"], "'grad_treshold' is not a setting; did you mean grad_threshold?"),
        (["--set", "warp=1"], "'warp' is not a setting; --help-all lists the settings"),
        (["--set", "sh_every"], "'sh_every' is not NAME=VALUE"),
        (["--set", "sh_every=2.5"], "sh_every: '2.5' is not a whole number"),
        (["--set", "batch=2"], "batch has an option: give --batch"),
        (["--set", "over_cap=cut"], "only the course's trainings change over_cap"),
        (["--set", "min_opacity=3"], "--set min_opacity: is 3"),
        (["--sh-every", "9"], "did you mean --set sh_every=VALUE?"),
        (["--set", "opacities_rate=fast"], "--set: opacities_rate"),
    ],
)
@pytest.mark.usefixtures("as_shipped")
def test_options_out_of_range_cost_one_line(tmp_path, capsys, words, named):
    try:
        code = main(["train", str(tmp_path), "--out", str(tmp_path / "run"), *words])
    except SystemExit as stop:  # raised by argparse
        code = stop.code
    said = capsys.readouterr().err
    assert code == 2 and named in said and said.count("\n") == 1
    assert not (tmp_path / "run").exists(), "nothing was started"


def _nothing(folder):
    folder.mkdir()


def _photos_only(folder):
    (folder / "images").mkdir(parents=True)
    Image.new("RGB", (8, 6)).save(folder / "images" / "a.png")


def _no_images(folder):
    write_colmap(folder, *CAPTURE)
    for file in (folder / "images").iterdir():
        file.unlink()


def _corrupt_jpeg(folder):
    write_colmap(folder, *CAPTURE)
    photo = folder / "images" / "view_002.png"
    Image.open(photo).save(photo.with_suffix(".jpg"))
    photo.write_bytes(photo.with_suffix(".jpg").read_bytes()[:-200])


def _mask_of_another_size(folder):
    write_colmap(folder, *CAPTURE)
    (folder / "masks").mkdir()
    Image.new("L", (8, 6), 255).save(folder / "masks" / "view_001.png")


def _nan_poses(folder):
    write_transforms(folder, *CAPTURE)
    file = folder / "transforms.json"
    meta = json.loads(file.read_text())
    for frame in meta["frames"]:
        frame["transform_matrix"][0][3] = float("nan")
    file.write_text(json.dumps(meta))


def _syntax_error(folder):
    write_transforms(folder, *CAPTURE)
    (folder / "transforms.json").write_text('{\n  "frames": [,\n')


CAPTURE = procedural_capture(16, 3, splats=20)
FAULTS = {
    _nothing: "is empty",
    _photos_only: "poses",
    _no_images: "view_000.png",
    _corrupt_jpeg: "view_002.png",
    _mask_of_another_size: "view_001.png",
    _nan_poses: "its pose",
    _syntax_error: "line 2",
}


@pytest.mark.parametrize("make", FAULTS, ids=lambda make: make.__name__)
@pytest.mark.usefixtures("as_shipped")
def test_a_capture_that_cannot_be_used_costs_one_line(tmp_path, capsys, make):
    make(tmp_path / "capture")
    code = main(["train", str(tmp_path / "capture"), "--out", str(tmp_path / "run"), "--iterations", "2"])
    said = capsys.readouterr().err
    assert code == 2 and FAULTS[make] in said and said.count("\n") == 1, said
    assert not (tmp_path / "run").exists(), "nothing was started"


def test_one_photo_is_enough(tmp_path):
    views, points, colors = procedural_capture(16, 3, splats=20)
    write_colmap(tmp_path / "capture", views[:1], points, colors)
    assert (
        main(["train", str(tmp_path / "capture"), "--out", str(tmp_path / "run"), "--iterations", "5"]) == 0
    )
    metrics = json.loads((tmp_path / "run" / "metrics.json").read_text())
    assert metrics["train"]["num_images"] == 1 and metrics["test"]["num_images"] == 0


def test_a_scene_is_exported_and_the_psnr_of_each_file_is_reported(tmp_path, capsys):
    write_colmap(tmp_path / "capture", *procedural_capture(24, 6, splats=40))
    files = [tmp_path / "out" / "scene.spz", tmp_path / "scene.html"]
    words = [
        "train",
        tmp_path / "capture",
        "--out",
        tmp_path / "run",
        "--iterations",
        "5",
        "--export",
        *files,
        tmp_path / "points.laz",
    ]
    assert main([str(word) for word in words]) == 0
    said = capsys.readouterr().out
    metrics = json.loads((tmp_path / "run" / "metrics.json").read_text())
    assert [entry["path"] for entry in metrics["exports"]] == [str(path) for path in files]
    assert f"wrote {tmp_path / 'points.laz'}: the centres of the splats as points" in said
    for entry, path in zip(metrics["exports"], files, strict=True):
        assert entry["psnr"] > 30 and entry["num_views"] == 6 and entry["num_bytes"] == path.stat().st_size
        assert f"{path}: PSNR {entry['psnr']:.2f} dB over 6 views" in said
        assert str(path) in (tmp_path / "run" / "report.html").read_text()


def test_an_impossible_export_is_reported_before_training(tmp_path, capsys):
    write_colmap(tmp_path / "capture", *procedural_capture(24, 6, splats=40))
    words = ["train", tmp_path / "capture", "--out", tmp_path / "run", "--export", tmp_path / "scene.obj"]
    assert main([str(word) for word in words]) == 2
    said = capsys.readouterr().err
    assert "--export: " in said and "known are" in said and said.count("\n") == 1
    assert not (tmp_path / "run").exists()
