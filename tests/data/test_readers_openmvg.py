"""OpenMVG's sfm_data.json: its classes of intrinsics, points and damage."""

import numpy as np
import pytest
from PIL import Image

from data.pose_programs import CAMERAS, MVG_LENS, POINTS, assert_reads, assert_refused, write_openmvg
from gsplat_edu.base.errors import DatasetError
from gsplat_edu.data.panorama import FACES
from gsplat_edu.data.reader import read_capture

PLACE = {name: MVG_LENS[name] for name in ("focal_length", "principal_point")}


def brown(x, y, k1=0.0, k2=0.0, k3=0.0, t1=0.0, t2=0.0):
    q = x * x + y * y
    k = k1 * q + k2 * q**2 + k3 * q**3
    return (
        x + x * k + t2 * (q + 2 * x * x) + 2 * t1 * x * y,
        y + y * k + t1 * (q + 2 * y * y) + 2 * t2 * x * y,
    )


def fisheye(x, y, *k):
    r = np.hypot(x, y)
    theta = np.arctan(r)
    d = theta * (1 + sum(each * theta ** (2 * i) for i, each in enumerate(k, 1))) / r
    return x * d, y * d


@pytest.mark.parametrize(
    ("kind", "key", "numbers", "formula"),
    [
        ("pinhole", "", [], brown),
        ("pinhole_radial_k1", "disto_k1", [-0.1], brown),
        ("pinhole_radial_k3", "disto_k3", [-0.1, 0.02, -0.004], brown),
        ("pinhole_brown_t2", "disto_t2", MVG_LENS["disto_t2"], brown),
        ("fisheye", "fisheye", [-0.05, 0.01, -0.002, 0.001], fisheye),
    ],
)
def test_poses_points_and_lenses(tmp_path, kind, key, numbers, formula):
    def seen(x, y):
        a, b = formula(x, y, *numbers)
        return 20 * a + 12.4, 20 * b + 8.7

    write_openmvg(tmp_path, kind=kind, lens={**PLACE, **({key: numbers} if key else {})})
    capture = assert_reads(tmp_path, "OpenMVG", seen)
    np.testing.assert_allclose(capture.cloud.points, POINTS, rtol=0, atol=1e-12)


@pytest.mark.parametrize("nested", [False, True])
def test_panoramas(tmp_path, nested):
    size = {"width": 64, "height": 32}
    write_openmvg(tmp_path, kind="spherical", lens={"value0": size} if nested else size)
    for name, _, _ in CAMERAS:
        Image.new("RGB", (64, 32)).save(tmp_path / "images" / name)
    assert len(read_capture(tmp_path).frames) == FACES * len(CAMERAS)


@pytest.mark.parametrize(
    ("kind", "lens", "says"),
    [
        (
            "thin_prism_fisheye",
            MVG_LENS,
            "the intrinsic 'thin_prism_fisheye' has no model here; undistort with",
        ),
        ("pinhole_radial_k1", MVG_LENS, "its intrinsic lacks focal_length, principal_point or disto_k1"),
        ("pinhole", {}, "its intrinsic lacks focal_length, principal_point"),
    ],
)
def test_a_lens_without_a_model_is_named(tmp_path, kind, lens, says):
    write_openmvg(tmp_path, kind=kind, lens=lens)
    with pytest.raises(DatasetError, match=says):
        read_capture(tmp_path)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda c: c.pop("views"), "lacks 'views'"),
        (lambda c: c["extrinsics"].clear(), "has no posed view"),
        (lambda c: c["extrinsics"][0]["value"].pop("center"), "pose 10: lacks 'center'"),
        (
            lambda c: c["extrinsics"][0]["value"].update(rotation=[[1, 0, 0]]),
            "pose 10: .*has to have 3 entries",
        ),
        (lambda c: c["views"][2].update(value=4), "view 2: .* but has to be an object"),
        (lambda c: c["structure"][1]["value"].update(X=[0, 0, float("inf")]), "Infinity"),
    ],
)
def test_damaged_files_are_refused_in_one_line(tmp_path, change, says):
    write_openmvg(tmp_path)
    assert_refused(tmp_path / "sfm_data.json", change, says)
