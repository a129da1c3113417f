"""Damaged records of jobs, blocks, stages, runs and edits, and damaged uploads, are read or refused in one line.
Records that are read are safe: command lines of jobs name only places in the library and no address, and records of
blocks and stages name only files in their folder.
"""

import functools
import json
import random
from pathlib import Path

import numpy as np
import pytest

import tiers
from blocks.test_plan import flight, under
from damage import damaged_json
from gsplat_edu.base.errors import SplatError
from gsplat_edu.blocks.plan import Block, BlockPlan, Cell, measured_area
from gsplat_edu.blocks.split import recipe_of
from gsplat_edu.blocks.task import block_options
from gsplat_edu.data.settings import DataSettings
from gsplat_edu.edits.document import parse_edits
from gsplat_edu.jobs.events import Progress, line_of, parse_line
from gsplat_edu.jobs.record import Job, JobFolder, State, Work
from gsplat_edu.runs.blocks_folder import BlocksFolder, Done
from gsplat_edu.runs.options import RunOptions
from gsplat_edu.sfm.stages import Stages
from gsplat_edu.studio.commands import command_line
from gsplat_edu.studio.library import Library
from gsplat_edu.studio.unpack import ZipLimits, unpack
from gsplat_edu.train.config import recipe
from studio.test_uploads import zipped

pytestmark = pytest.mark.fuzz

RECORDS = tiers.count("GSPLAT_EDU_FUZZ_RECORDS", 60, 20_000)
"""Damaged records per reader."""

SEEDS = range(tiers.SEED, tiers.SEED + RECORDS)


def each_damage(data):
    for seed in SEEDS:
        yield seed, damaged_json(data, np.random.default_rng(seed))


def refused(read):
    """Return whether a reader refuses its record, in one line."""
    try:
        read()
    except SplatError as error:
        assert "\n" not in str(error)
        return True
    return False


@pytest.mark.usefixtures("as_shipped")
def test_damaged_jobs(tmp_path):
    library = Library(tmp_path / "library")
    (library.root / "captures" / "toy").mkdir()
    folder = JobFolder(library.root / ".studio" / "jobs" / "000001")
    folder.path.mkdir(parents=True)
    work = Work("train", ("captures/toy",), ("runs/toy",), {"iterations": 30})
    render = functools.partial(command_line, library)
    job = Job("000001", work, (), State.QUEUED, 1.0, attempts=1, pid=77, identity="a")
    folder.write(job)
    assert folder.read(render).argv[:2] == ("train", str(library.root / "captures" / "toy"))
    read = 0
    for seed, data in each_damage(folder.record.read_bytes()):
        folder.record.write_bytes(data)
        if refused(lambda: folder.read(render)):
            continue
        read += 1
        for word in folder.read(render).argv:
            assert not word.startswith("/") or Path(word).is_relative_to(library.root), seed
            assert word not in ("--scheduler", "--workers", "--export", "--view"), seed
    assert read < RECORDS, "no damage was refused"


@pytest.mark.usefixtures("as_shipped")
def test_damaged_events():
    line = line_of(Progress("photos", 3.0, 10.0, 1.5), 1.0).encode()
    assert parse_line(line) == (1.0, Progress("photos", 3.0, 10.0, 1.5))
    read = 0
    for _, data in each_damage(line):
        try:
            parse_line(data.strip())
        except ValueError as error:
            assert "\n" not in str(error)
        else:
            read += 1
    assert read < RECORDS, "no damage was refused"


@pytest.mark.usefixtures("as_shipped")
def test_damaged_plans_and_records_of_blocks(tmp_path):
    cameras = flight(3, 3)
    area = measured_area(cameras, under(cameras, np.random.default_rng(2)))
    options = RunOptions(tmp_path / "town", tmp_path / "run", recipe(40), DataSettings())
    blocks = tuple(
        Block(Cell((0.0, 0.0), (1.0, 1.0)), ("a.png", "b.png"), ("c.png",), "ab", 70) for _ in range(2)
    )
    views = {"cameras.json": "ab", "photos.json": "cd"}
    plan = BlockPlan(str(tmp_path / "town"), (0.0, 0.0, 0.0), area, blocks, recipe_of(options), views)
    folder = BlocksFolder(tmp_path / "run")
    plan.write(folder.path)
    whole = folder.plan.read_bytes()
    for seed, data in each_damage(whole):
        folder.plan.write_bytes(data)
        if not refused(lambda: BlockPlan.read(folder.path)):
            read = BlockPlan.read(folder.path)
            for number in range(min(len(read.blocks), 2)):
                if not refused(lambda read=read, number=number: block_options(folder, read, number)):
                    one = block_options(folder, read, number)
                    assert {one.out, one.scene} == {folder.run(number).path, folder.start(number)}, seed
    done = Done(1, plan.digest(), "ab", 5, 40, 1.5, 10, "host", "x86-64", "0.1.0")
    done.write(folder)
    whole = folder.record(1).read_bytes()
    for seed, data in each_damage(whole):
        folder.record(1).write_bytes(data)
        if not refused(lambda: folder.read_done(1, plan.digest())):
            found = folder.read_done(1, plan.digest())
            assert folder.scene(1, found.iterations).is_relative_to(folder.path), seed


@pytest.mark.usefixtures("as_shipped")
def test_damaged_stages(tmp_path):
    facts = {
        "faces": {
            "panoramas": [{"name": "a.jpg", "faces": ["a_0.jpg", "a_1.jpg"], "place": [1.0, 2.0, 3.0]}]
        },
        "photos": {"names": ["a.jpg", "b/c.jpg"]},
        "matches": {"connected": 3},
        "mapping": {"folder": "models/1/0", "names": ["a"], "doubtful": [], "unclear": []},
    }
    stages = {name: {"options": {}, "facts": {"summary": "", **fact}} for name, fact in facts.items()}
    path = tmp_path / "stages.json"
    for seed, data in each_damage(json.dumps({"stages": stages}).encode()):
        for name in facts:
            path.write_bytes(data)
            if refused(lambda name=name: Stages(path, lambda line: None).finished(name, {})):
                continue
            found = Stages(path, lambda line: None).finished(name, {})
            if found is not None and name == "mapping":
                assert (tmp_path / found["folder"]).resolve().is_relative_to(tmp_path), seed
            if found is not None and name == "faces":
                names = [face for one in found["panoramas"] for face in one["faces"]]
                assert all((tmp_path / face).resolve().parent == tmp_path for face in names), seed


@pytest.mark.usefixtures("as_shipped")
def test_damaged_edits():
    camera = {"position": [0, 0, -1], "rotation": [[1, 0, 0], [0, 1, 0], [0, 0, 1]], "fx": 9, "fy": 9}
    camera |= {"cx": 5, "cy": 5, "width": 10, "height": 10}
    operations = [
        {
            "op": "select",
            "how": "add",
            "by": "brush",
            "camera": camera,
            "radius": 2,
            "points": [[1, 2], [3, 4]],
        },
        {"op": "select", "how": "replace", "by": "sphere", "center": [0, 0, 0], "radius": 1},
        {"op": "select", "how": "add", "by": "list", "reason": "alone", "runs": [0, 1, 2, 1]},
        {"op": "select", "how": "add", "by": "distance", "center": [0, 0, 0], "low": 1, "high": 2},
        {"op": "grow", "radius": 0.5},
        {"op": "delete"},
        {"op": "upright", "points": [[0, 0, 0], [1, 0, 0], [0, 0, 1]]},
    ]
    scene = {"count": 3, "sha256": "0" * 64, "origin": [0, 0, 0]}
    document = {"format": "gsplat_edu edits", "version": 1, "scene": scene, "operations": operations}
    whole = json.dumps(document).encode()
    parse_edits(whole, "edits.json")
    for _, data in each_damage(whole):
        refused(lambda data=data: parse_edits(data, "edits.json"))


@pytest.mark.usefixtures("as_shipped")
def test_damaged_uploads(tmp_path):
    """Files unpacked from damaged zip files lie in their folder and are no larger than the limits allow."""
    whole = zipped({"a.jpg": random.Random(0).randbytes(300), "b/c.jpg": bytes(1000)})
    path = tmp_path / "a.zip"
    for seed in SEEDS:
        draw, data = random.Random(seed), bytearray(whole)
        for _ in range(draw.randint(1, 4)):
            data[draw.randrange(len(data))] = draw.choice([draw.randrange(256), *b"/.\\\0\xff"])
        path.write_bytes(data[: draw.randint(1, len(data))] if draw.random() < 0.2 else data)
        into = tmp_path / f"into{seed}"
        refused(lambda into=into: unpack(path, into, ZipLimits(total=10_000)))
    assert {entry.name.rstrip("0123456789") for entry in tmp_path.iterdir()} <= {"a.zip", "into"}
