"""Runs in blocks: the bytes do not depend on who trains a block, blocks are ordinary runs, mistakes are one line."""

import json
import resource
import shutil
from dataclasses import replace

import msgspec
import numpy as np
import pytest
from PIL import Image

from block_runs import RECIPE
from gsplat_edu.blocks.merge import finished_blocks, merged
from gsplat_edu.blocks.plan import BlockPlan
from gsplat_edu.cli.main import main
from gsplat_edu.io.ply import load_ply
from gsplat_edu.runs.blocks_folder import BlocksFolder
from gsplat_edu.runs.dataset import run_dataset
from gsplat_edu.train.length import planned_iterations
from systems import needs_posix

pytestmark = pytest.mark.slow


def scene(folder):
    return (folder / "point_cloud" / "iteration_40" / "point_cloud.ply").read_bytes()


@pytest.fixture
def run(split, tmp_path):
    """A split capture whose blocks are not trained yet."""
    shutil.copytree(split, tmp_path / "run")
    return tmp_path / "run"


def test_a_command_for_each_block_gives_the_bytes_of_one_command_for_all(city, run, serial, capsys):
    for number in (2, 0, 3, 1):  # in any order
        assert main(["block", str(run), str(number)]) == 0
    before = [BlocksFolder(run).record(number).read_bytes() for number in range(4)]
    assert main(["block", str(run), "1"]) == 0 and "is finished; nothing to do" in capsys.readouterr().out
    assert main(["merge", str(run)]) == 0
    assert scene(run) == scene(serial)
    words = ["train", str(city), "--out", str(run), "--blocks", "4", *RECIPE, "--resume"]
    assert main(words) == 0 and "is finished, 4 blocks; nothing to do" in capsys.readouterr().out
    assert [BlocksFolder(run).record(number).read_bytes() for number in range(4)] == before
    assert main([*words[:-1]]) == 2 and "already holds a run; add --resume" in capsys.readouterr().err


@needs_posix
@pytest.mark.parametrize("part", ["blocks", "point_cloud", "coarse"])
def test_nothing_is_trained_or_merged_through_a_link(city, run, tmp_path, capsys, part):
    mine, link = tmp_path / "mine", run / part
    if link.exists():
        link.rename(mine)
    mine.mkdir(exist_ok=True)
    link.symlink_to(mine)
    before = {path: path.read_bytes() for path in mine.rglob("*") if path.is_file()}
    words = ["train", str(city), "--out", str(run), "--blocks", "4", *RECIPE, "--resume"]
    for command in (["block", str(run), "0"], ["merge", str(run)], words):
        assert main(command) == 2
        error = capsys.readouterr().err
        assert f"{link} is a link that leads out of {run}" in error and error.count("\n") == 1
    assert {path: path.read_bytes() for path in mine.rglob("*") if path.is_file()} == before


def test_coarse_model_and_blocks_get_their_own_recipes(split):
    plan, coarse = BlockPlan.read(split), json.loads((split / "coarse" / "config.json").read_text())
    assert coarse["data"]["resolution"] == 2.0 and plan.recipe["data"]["resolution"] is None
    assert (coarse["train"]["iterations"], plan.recipe["train"]["iterations"]) == (30, 40)
    assert coarse["train"]["max_gaussians"] == 750, "a quarter of the pixels, a quarter of the Gaussians"
    assert all(750 < block.max_gaussians <= 3000 for block in plan.blocks)


def test_each_block_keeps_the_gaussians_of_its_cell(serial):
    plan, folder = BlockPlan.read(serial), BlocksFolder(serial)
    whole = load_ply(serial / "point_cloud" / "iteration_40" / "point_cloud.ply").means.numpy()
    cells = json.loads((serial / "metrics.json").read_text())["blocks"]["cells"]
    assert sum(cell["gaussians"] for cell in cells) == len(whole)
    first = 0
    for number, (block, cell) in enumerate(zip(plan.blocks, cells, strict=True)):
        part = whole[first : first + cell["gaussians"]]
        assert block.core.holds(plan.area.ground.coordinates(part)).all()
        done = folder.read_done(number, plan.digest())
        trained = load_ply(folder.scene(number, done.iterations)).means.numpy()
        inside = block.core.holds(plan.area.ground.coordinates(trained))
        np.testing.assert_array_equal(part, trained[inside])
        assert 0 < inside.sum() < len(trained), "a block also trains Gaussians around its cell"
        first += cell["gaussians"]


def test_merged_run_and_blocks_are_ordinary_runs(serial, tmp_path):
    block = serial / "blocks" / "block_01"
    dataset = run_dataset(json.loads((block / "config.json").read_text()))
    plan = BlockPlan.read(serial)
    assert tuple(view.name for view in dataset.train) == plan.blocks[1].train
    assert tuple(view.name for view in dataset.test) == plan.blocks[1].test
    copy = tmp_path / "copy"
    shutil.copytree(serial, copy)
    for folder in (copy, copy / "blocks" / "block_01"):
        before = json.loads((folder / "metrics.json").read_text())
        assert main(["eval", str(folder)]) == 0
        after = json.loads((folder / "metrics.json").read_text())
        assert after["test"] == before["test"]
    report = (copy / "report.html").read_text()
    assert "<h2>Blocks</h2>" in report and "Along the cuts" in report


def test_a_merged_run_cannot_be_resumed(city, serial, capsys):
    assert main(["train", str(city), "--out", str(serial), "--resume", "--iterations", "90"]) == 2
    assert "is merged from blocks" in capsys.readouterr().err


def test_a_missing_photo_stops_its_blocks_and_loses_nothing(city, run, serial, capsys):
    plan = BlockPlan.read(run)
    counts = {
        name: sum(name in block.train for block in plan.blocks)
        for block in plan.blocks
        for name in block.train
    }
    name = min(counts, key=lambda name: (counts[name], name))
    number = next(i for i, block in enumerate(plan.blocks) if name in block.train)
    other = next(i for i, block in enumerate(plan.blocks) if name not in block.train)
    photo, away = city / "images" / name, city / f"away_{name}"
    photo.rename(away)
    try:
        assert main(["block", str(run), str(number)]) == 2
        (line,) = capsys.readouterr().err.splitlines()
        assert name in line and "missing here" in line
        assert main(["block", str(run), str(other)]) == 0, "a block that does not need it is trained"
    finally:
        away.rename(photo)
    assert main(["merge", str(run)]) == 2
    assert f"3 of 4 blocks are not trained yet: {', '.join(str(n) for n in range(4) if n != other)}" in (
        capsys.readouterr().err
    )
    assert main(["block", str(run), str(number)]) == 0
    done, known = (
        BlocksFolder(folder).read_done(number, BlockPlan.read(folder).digest()) for folder in (run, serial)
    )
    assert done.sha256 == known.sha256


def test_a_photo_or_a_camera_changed_after_the_split_is_named_before_anything_is_written(
    city, run, serial, tmp_path, capsys
):
    capture = tmp_path / "capture"
    shutil.copytree(city, capture)
    plan = BlockPlan.read(run)
    name, other = next(
        (name, i)
        for name in plan.blocks[0].train
        for i, block in enumerate(plan.blocks)
        if name not in (*block.train, *block.test)
    )
    photo, original = capture / "images" / name, (city / "images" / name).read_bytes()
    with Image.open(photo) as image:
        image.rotate(180).save(photo)
    words = ["--data", str(capture)]
    assert main(["block", str(run), "0", *words]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "is not as it was split: different photos: 1 of" in line and f"first {name}" in line
    assert not (run / "blocks" / "block_00").exists()
    assert main(["block", str(run), str(other), *words]) == 0, "a block without that photo is trained"
    photo.write_bytes(original)
    assert main(["block", str(run), "0", *words]) == 0, "the restored photo is accepted"
    finished = tmp_path / "finished"
    shutil.copytree(serial, finished)
    photo.write_bytes((city / "images" / plan.blocks[0].test[0]).read_bytes())
    assert main(["merge", str(finished), *words]) == 2
    assert f"first {name}" in capsys.readouterr().err
    (run / "photos.json").write_text("{}")
    third = next(i for i in range(4) if i not in (0, other))
    assert main(["block", str(run), str(third), *words]) == 2
    assert "photos.json: is missing or not as it was split" in capsys.readouterr().err


def test_a_plan_or_a_record_from_elsewhere_opens_no_other_file(serial, tmp_path, capsys):
    copy = tmp_path / "copy"
    shutil.copytree(serial, copy)
    folder, plan = BlocksFolder(copy), BlockPlan.read(copy)
    record = json.loads(folder.record(1).read_text())
    for change in (
        {"scene": "../../outside.ply"},
        {"iterations": "../../outside"},
        {"seconds": 1e400},
        {"host": "x" * 2000},
    ):
        folder.record(1).write_text(json.dumps(record | change))
        assert main(["merge", str(copy)]) == 2
        assert "block_01.json: is damaged" in capsys.readouterr().err
    for number in range(4):
        folder.record(number).unlink()
    for capture in ("//server/share", "\\\\server\\share", "a\0b"):
        replace(plan, capture=capture).write(copy)
        assert main(["block", str(copy), "0"]) == 2
        assert "plan.json: capture: is not a path of this computer" in capsys.readouterr().err
    blocks = (replace(plan.blocks[0], iterations=10**400), *plan.blocks[1:])
    replace(plan, blocks=blocks).write(copy)
    assert main(["block", str(copy), "0"]) == 2
    assert "recipe is damaged (iterations: is a number of 401 digits, but" in capsys.readouterr().err
    replace(plan, recipe=plan.recipe | {"backend": "tcp://192.0.2.1:1"}).write(copy)
    assert main(["block", str(copy), "0"]) == 2
    assert "recipe is damaged (backend: is" in capsys.readouterr().err


def test_a_full_disk_is_one_line_and_the_block_can_be_resumed(run, serial, capsys):
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (60_000, limits[1]))  # a checkpoint is larger
    try:
        assert main(["block", str(run), "2"]) == 2
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    (line,) = capsys.readouterr().err.splitlines()
    assert "block_02" in line
    assert BlocksFolder(run).read_done(2, BlockPlan.read(run).digest()) is None
    assert main(["block", str(run), "2"]) == 0
    done, known = (
        BlocksFolder(folder).read_done(2, BlockPlan.read(folder).digest()) for folder in (run, serial)
    )
    assert done.sha256 == known.sha256


def test_changed_or_damaged_files_are_named(serial, tmp_path, capsys):
    copy = tmp_path / "copy"
    shutil.copytree(serial, copy)
    folder = BlocksFolder(copy)
    done = folder.read_done(3, BlockPlan.read(copy).digest())
    with folder.scene(3, done.iterations).open("ab") as file:
        file.write(b"x")
    assert main(["merge", str(copy)]) == 2
    assert "block_03" in (error := capsys.readouterr().err) and "was changed after the training" in error
    msgspec.structs.replace(done, plan="another").write(folder)
    assert main(["merge", str(copy)]) == 2 and "belongs to another plan" in capsys.readouterr().err
    folder.record(3).write_text("{")
    assert main(["block", str(copy), "3"]) == 2 and "block_03.json: is damaged" in capsys.readouterr().err
    folder.record(3).unlink()
    shutil.rmtree(copy / "blocks" / "block_03")
    folder.start(3).write_bytes(b"x")
    assert main(["block", str(copy), "3"]) == 2 and "not as it was split" in capsys.readouterr().err
    assert main(["block", str(copy), "4"]) == 2 and "blocks 0 to 3" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "problem"),
    [
        (["--blocks", "0"], "--blocks: is 0, but has to be auto or a number from 1 to 256"),
        (["--blocks", "some"], "--blocks: is some, but has to be"),
        (["--workers", "2"], "--workers: has an effect only with --blocks"),
        (["--until", "split"], "--until: has an effect only with --blocks"),
        (
            ["--blocks", "2", "--until", "split", "--export", "a.spz"],
            "--export: does not go with --until split; give it to",
        ),
        (
            ["--blocks", "2", "--until", "split", "--workers", "2"],
            "--workers: does not go with --until split",
        ),
        (["--blocks", "2", "--time-limit", "1h"], "--time-limit: does not go with --blocks"),
        (["--blocks", "2", "--view"], "--view: does not go with --blocks"),
        (["--blocks", "2", "--workers", "0"], "--workers: is 0"),
        (
            ["--blocks", "2", "--workers", "2", "--scheduler", "tcp://a:1"],
            "--workers: --scheduler has workers",
        ),
        (
            ["--blocks", "2", "--coarse-iterations", "5", "--from", "SCENE"],
            "--coarse-iterations: --from gives",
        ),
    ],
)
def test_mistakes_are_one_line(city, serial, tmp_path, capsys, words, problem):
    words = [str(serial) if word == "SCENE" else word for word in words]
    assert main(["train", str(city), "--out", str(tmp_path / "run"), *words]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert problem in line and not (tmp_path / "run").exists()


def test_other_options_are_refused_on_resuming(city, run, capsys):
    words = ["train", str(city), "--out", str(run), "--blocks", "4", *RECIPE, "--resume", "--seed", "7"]
    assert main(words) == 2
    assert "was made with train.seed = 0, not 7" in capsys.readouterr().err


def test_fewer_blocks_are_made_if_they_would_have_too_few_views(city, serial, tmp_path, capsys):
    words = ["train", str(city), "--out", str(tmp_path / "run"), "--from", str(serial), "--until", "split"]
    arguments = [*words, "--strategy", "adc", "--iterations", "10", "--blocks", "6", "--min-views", "25"]
    assert main(arguments) == 0
    plan = BlockPlan.read(tmp_path / "run")
    assert 1 < len(plan.blocks) < 6 and min(len(block.train) for block in plan.blocks) >= 25
    assert (
        f"6 blocks would have fewer than 25 training views: the capture is split into {len(plan.blocks)}"
        in (capsys.readouterr().out.replace("\n", " "))
    )


def test_merging_keeps_the_cap_of_the_whole_scene(serial):
    """If the blocks exceed the cap, the Gaussians that cover least are removed, and the others keep their order."""
    plan, folder = BlockPlan.read(serial), BlocksFolder(serial)
    records = finished_blocks(folder, plan)
    whole, counts = merged(folder, plan, records)
    cap = sum(counts) - 100
    tight = replace(plan, recipe=plan.recipe | {"train": plan.recipe["train"] | {"max_gaussians": cap}})
    kept, fewer = merged(folder, tight, records)
    assert len(kept) == sum(fewer) == cap and all(a <= b for a, b in zip(fewer, counts, strict=True))
    rows = {row.tobytes(): i for i, row in enumerate(whole.means.numpy())}
    places = [rows[row.tobytes()] for row in kept.means.numpy()]
    assert places == sorted(places)
    covers = [
        scene.opacities.log() + scene.log_scales.sort(dim=1).values[:, 1:].sum(dim=1)
        for scene in (whole, kept)
    ]
    gone = np.delete(covers[0].numpy(), places)
    assert gone.max() <= covers[1].min() + 1e-6


def test_each_block_has_the_length_that_follows_from_its_views(city, tmp_path, monkeypatch):
    monkeypatch.setattr("gsplat_edu.train.length.UNIT", 16)
    monkeypatch.setattr("gsplat_edu.train.length.PLANNED_VIEWS", 10)
    out = tmp_path / "run"
    words = [
        "--blocks",
        "4",
        "--until",
        "split",
        "--min-views",
        "5",
        "--quality",
        "draft",
        "--sh-degree",
        "0",
    ]
    words += ["--appearance", "none", "--sky", "none", "--transients", "none", "--refine", "none"]
    assert main(["train", str(city), "--out", str(out), *words]) == 0
    plan = BlockPlan.read(out)
    lengths = [planned_iterations("draft", len(block.train)) for block in plan.blocks]
    assert [block.iterations for block in plan.blocks] == lengths and min(lengths) > 16
    assert main(["block", str(out), "0"]) == 0
    trained = json.loads((out / "blocks" / "block_00" / "config.json").read_text())["train"]
    assert trained["iterations"] == BlocksFolder(out).read_done(0, plan.digest()).iterations == lengths[0]
    assert trained["fast_stop"] == pytest.approx(0.6 * lengths[0], abs=2), "the schedule ends with the block"
