"""LLFF's poses_bounds.npy: axes, precision, order of bytes, and damage."""

import numpy as np
import pytest

from data.pose_programs import CAMERAS, H, W, assert_reads, llff_rows, write_llff
from gsplat_edu.base.errors import DatasetError
from gsplat_edu.data.reader import read_capture


def seen(x, y):
    return W / 2 + 20 * x, H / 2 + 20 * y


@pytest.mark.parametrize("save", [np.ascontiguousarray, np.asfortranarray])
def test_poses_and_lens(tmp_path, save):
    write_llff(tmp_path)
    np.save(tmp_path / "poses_bounds.npy", save(llff_rows(CAMERAS)))
    assert_reads(tmp_path, "LLFF", seen)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda rows: rows[:4], "has 4 poses, but .*images 6 photos; put the photos of these poses there"),
        (lambda rows: rows[:, :15], "is not an array of 17 float numbers a row"),
        (lambda rows: rows.astype(np.int64), "is not an array of 17 float numbers a row"),
        (lambda rows: np.full_like(rows, np.nan), "has a number that is not finite"),
        (lambda rows: rows[:0], "has no rows"),
        (lambda rows: rows + 0.5, r"its size 24\.5x18\.5 is no photo's"),
    ],
)
def test_files_that_cannot_be_used(tmp_path, change, says):
    write_llff(tmp_path)
    np.save(tmp_path / "poses_bounds.npy", change(llff_rows(CAMERAS)))
    with pytest.raises(DatasetError, match=says) as caught:
        read_capture(tmp_path)
    assert "\n" not in str(caught.value)


def test_a_file_that_is_cut_off(tmp_path):
    write_llff(tmp_path)
    path = tmp_path / "poses_bounds.npy"
    path.write_bytes(path.read_bytes()[:-1])
    with pytest.raises(DatasetError, match="has not the numbers of 6 rows; copy the whole file"):
        read_capture(tmp_path)
