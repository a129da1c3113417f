"""A small city, split once; the tests train its blocks in copies of that folder."""

from pathlib import Path

import pytest

from block_runs import RECIPE
from gsplat_edu.cli.main import main
from lab.captures.city import City, write_city


@pytest.fixture(scope="session")
def city(tmp_path_factory) -> Path:
    """The capture: 36 photos from the air."""
    folder = tmp_path_factory.mktemp("city")
    write_city(folder, City(photos=36, width=32, points=40))
    return folder


@pytest.fixture(scope="session")
def split(city, tmp_path_factory) -> Path:
    """The capture, split into four blocks that are not trained yet."""
    folder = tmp_path_factory.mktemp("split") / "run"
    assert main(["train", str(city), "--out", str(folder), "--blocks", "4", "--until", "split", *RECIPE]) == 0
    return folder


@pytest.fixture(scope="session")
def serial(city, tmp_path_factory) -> Path:
    """The run of one command that splits the capture, trains the blocks one after the other, and merges them."""
    folder = tmp_path_factory.mktemp("serial") / "run"
    assert main(["train", str(city), "--out", str(folder), "--blocks", "4", *RECIPE]) == 0
    return folder
