"""Pix4D's calibrated_cameras.json: poses, lenses, its list of photos and damage."""

import json

import pytest

from data.pose_programs import OPF_LENS, assert_reads, assert_refused, write_opf
from data.test_readers_openmvg import brown
from gsplat_edu.base.errors import DatasetError
from gsplat_edu.data.reader import read_capture


def seen(x, y):
    a, b = brown(x, y, *OPF_LENS["radial_distortion"], *OPF_LENS["tangential_distortion"])
    return 20 * a + 12.4, 20 * b + 8.7


@pytest.mark.parametrize("folder", ["", "opf"])
def test_poses_and_lenses(tmp_path, folder):
    write_opf(tmp_path)
    (tmp_path / folder).mkdir(exist_ok=True)
    for path in tmp_path.glob("*.json"):
        path.rename(tmp_path / folder / path.name)
    assert_reads(tmp_path, "Pix4D", seen)


def test_the_list_of_photos_is_asked_for(tmp_path):
    write_opf(tmp_path)
    (tmp_path / "camera_list.json").unlink()
    with pytest.raises(DatasetError, match=r"lacks its list of photos; put camera_list\.json beside it"):
        read_capture(tmp_path)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda c: c.pop("cameras"), "lacks 'cameras'"),
        (lambda c: c["cameras"].clear(), "has no calibrated camera"),
        (lambda c: c["cameras"][0].update(id=9), "camera 9 is not in the camera list"),
        (lambda c: c["cameras"][0].pop("position"), "lacks 'position'"),
        (lambda c: c["cameras"][0].update(orientation_deg=[1, 2]), "has to have 3 entries"),
        (lambda c: c["sensors"].clear(), "its sensor is not in the file"),
        (
            lambda c: c["sensors"][0]["internals"].update(type="fisheye"),
            "the lens 'fisheye' has no model here",
        ),
    ],
)
def test_damaged_files_are_refused_in_one_line(tmp_path, change, says):
    write_opf(tmp_path)
    assert_refused(tmp_path / "calibrated_cameras.json", change, says)


@pytest.mark.parametrize("swap", [False, True])
def test_the_reference_frame_says_where_on_earth_the_scene_is(tmp_path, swap):
    write_opf(tmp_path)
    move = {"scale": [1.0, 1.0, 1.0], "shift": [-500000.0, -4600000.0, -100.0], "swap_xy": swap}
    frame = {"format": "application/opf-scene-reference-frame+json", "version": "1.0"}
    path = tmp_path / "scene_reference_frame.json"
    path.write_text(json.dumps({**frame, "crs": {"definition": "EPSG:32633"}, "base_to_canonical": move}))
    earth = read_capture(tmp_path).scale.earth
    east, north = (4600000.0, 500000.0) if swap else (500000.0, 4600000.0)
    said = f"{east:.2f} east, {north:.2f} north, 100.00 up in EPSG:32633"
    assert earth.place_of((0, 0, 0)).startswith(said)
    path.write_text(json.dumps({**frame, "crs": {"definition": "Arbitrary (m)"}, "base_to_canonical": move}))
    assert read_capture(tmp_path).scale is None
    move["scale"][1] = 0
    path.write_text(json.dumps({**frame, "crs": {"definition": "EPSG:32633"}, "base_to_canonical": move}))
    with pytest.raises(DatasetError, match=r"scene_reference_frame\.json: its scale is 0"):
        read_capture(tmp_path)
