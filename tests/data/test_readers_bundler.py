"""Bundler's and VisualSFM's files: poses, lenses, points, and damage."""

import re

import numpy as np
import pytest

from data.pose_programs import CAMERAS, POINTS, H, W, assert_reads, write_bundler, write_nvm
from gsplat_edu.base.errors import DatasetError
from gsplat_edu.data.reader import read_capture


def test_bundler(tmp_path):
    def seen(x, y):
        """Its axes have y up, in the image, too; the image's origin is its middle."""
        q = x * x + y * y
        scale = 20.0 * (1 - 0.1 * q + 0.02 * q * q)
        up = scale * -y
        return W / 2 + scale * x, H / 2 - up

    write_bundler(tmp_path)
    capture = assert_reads(tmp_path, "Bundler", seen)
    np.testing.assert_allclose(capture.cloud.points, POINTS, rtol=0, atol=1e-12)
    np.testing.assert_allclose(capture.cloud.colors[0], [1, 128 / 255, 0], rtol=0, atol=1e-12)


def test_a_camera_without_focal_length_has_no_pose(tmp_path):
    write_bundler(tmp_path)
    path = tmp_path / "bundle.out"
    path.write_text(path.read_text().replace("20.0 -0.1 0.02", "0 0 0", 1))
    capture = read_capture(tmp_path)
    assert len(capture.frames) == 5 and str(capture.notes[0]) == "poses of Bundler: 5 of 6 photos"


@pytest.mark.parametrize("place", ["scene.list.txt", "list.txt", "../list.txt"])
def test_the_list_of_photos_is_found(tmp_path, place):
    write_bundler(tmp_path / "capture")
    folder = tmp_path / "capture"
    (folder / "bundle.out").rename(folder / "scene.bundle.out")
    (folder / "list.txt").rename(folder / place)
    assert len(read_capture(folder).frames) == 6


@pytest.mark.parametrize("r", [-0.15, -0.05, 0.0, 0.05, 0.15])
def test_visualsfm(tmp_path, r):
    def seen(x, y):
        """A position d belongs to the ray d (1 + r d²); bisection finds d."""
        u = np.hypot(x, y)
        low, high = np.zeros_like(u), np.full_like(u, 1.2)
        for _ in range(80):
            middle = (low + high) / 2
            below = middle * (1 + r * middle**2) < u
            low, high = np.where(below, middle, low), np.where(below, high, middle)
        return W / 2 + 20.0 * x * low / u, H / 2 + 20.0 * y * low / u

    write_nvm(tmp_path, r=r)
    capture = assert_reads(tmp_path, "VisualSFM", seen)
    np.testing.assert_allclose(capture.cloud.points, POINTS, rtol=0, atol=1e-12)


def test_a_fixed_calibration_has_the_principal_point(tmp_path):
    write_nvm(tmp_path, r=0.0, first="NVM_V3 FixedK 20 11.5 22 9.25 0")
    assert_reads(tmp_path, "VisualSFM", lambda x, y: (20 * x + 11.5, 22 * y + 9.25))


@pytest.mark.parametrize(
    ("write", "old", "new", "says"),
    [
        (write_bundler, f"6 {len(POINTS)}", "6", "is '6', but has to be 2 numbers"),
        (write_bundler, f"6 {len(POINTS)}", "6000000000000 40", "lines for 6000000000000 cameras"),
        (write_bundler, "20.0 -0.1 0.02", "20.0 nan 0.02", "camera 0 (./shot_0.png): is '20.0 nan 0.02'"),
        (write_bundler, "255 128 0", "255 128", "a colour: is '255 128', but has to be 3 numbers"),
        (write_nvm, "\n6\n", "\n6000000000000\n", "for its cameras, which are more"),
        (write_nvm, "\t20.0", "\tinf", "camera 0: is 'inf "),
        (write_nvm, " 0.0\n", "\n", "camera 0: is '20.0 "),
    ],
)
def test_damaged_files_are_refused_in_one_line(tmp_path, write, old, new, says):
    write(tmp_path)
    (path,) = (*tmp_path.glob("*.out"), *tmp_path.glob("*.nvm"))
    path.write_text(path.read_text().replace(old, new, 1))
    with pytest.raises(DatasetError, match=re.escape(says)) as caught:
        read_capture(tmp_path)
    assert str(caught.value).startswith(f"{path}") and "\n" not in str(caught.value)


def test_files_that_do_not_belong_together(tmp_path):
    write_bundler(tmp_path)
    (tmp_path / "list.txt").write_text("a.jpg\n")
    with pytest.raises(DatasetError, match=f"has {len(CAMERAS)} cameras, but its list 1 photos"):
        read_capture(tmp_path)
    (tmp_path / "list.txt").unlink()
    with pytest.raises(DatasetError, match=r"lacks its list of photos; put list\.txt beside it"):
        read_capture(tmp_path)
