"""Metashape's cameras: the chunk's transform, sensors, the order of p1 and p2, rigs, and real files."""

import re
from xml.etree import ElementTree

import numpy as np
import pytest

from data.pose_programs import CAMERAS, MS_LENS, H, W, assert_reads, write_metashape
from gsplat_edu.base.errors import DatasetError
from gsplat_edu.data.reader import layout_of, read_capture
from gsplat_edu.data.readers.metashape import read
from gsplat_edu.scene.earth import earth_centred, local_axes


def seen(x, y, k4=0.0):
    """The manual's formulas; p1 stands before r² + 2 x², other than in OpenCV."""
    q = x * x + y * y
    d = 1 - 0.1 * q + 0.02 * q**2 - 0.004 * q**3 + k4 * q**4
    a = d * x + 0.003 * (q + 2 * x * x) + 2 * -0.002 * x * y
    b = d * y - 0.002 * (q + 2 * y * y) + 2 * 0.003 * x * y
    return W / 2 + 0.4 + 20 * a + 1.5 * a, H / 2 - 0.3 + 20 * b


def test_frame_sensors(tmp_path):
    write_metashape(tmp_path)
    assert_reads(tmp_path, "Metashape", seen)


def test_fisheye_sensors(tmp_path):
    def wide(x, y):
        r = np.hypot(x, y)
        return seen(x * np.arctan(r) / r, y * np.arctan(r) / r, k4=0.001)

    write_metashape(tmp_path, kind="fisheye", lens={**MS_LENS, "k4": 0.001})
    assert_reads(tmp_path, "Metashape", wide)


def test_a_component_has_its_own_transform(tmp_path):
    write_metashape(tmp_path)
    path = tmp_path / "cameras.xml"
    text = path.read_text()
    transform = "<transform><rotation" + text.rpartition("<transform><rotation")[2].partition("</chunk>")[0]
    component = f'<components><component id="7">{transform}</component></components>'
    wrong = "<transform><scale>9</scale></transform>"
    text = text.replace(transform, wrong).replace("</sensors>", f"</sensors>{component}")
    path.write_text(text.replace('sensor_id="1"', 'sensor_id="1" component_id="7"'))
    assert_reads(tmp_path, "Metashape", seen)


def test_cameras_without_a_transform_are_left_out_and_slaves_are_named(tmp_path):
    more = '<camera id="8" sensor_id="1" label="unaligned"/>'
    write_metashape(tmp_path, more=f'<group>{more}<camera id="9" master_id="0" label="right_0"/></group>')
    notes = list(map(str, read_capture(tmp_path).notes))
    assert notes[0] == "poses of Metashape: 6 of 6 photos"
    assert "right_0 (it is a slave of a rig, for which Metashape exports no pose; export" in notes[1]


SYSTEMS = {
    "geographic": 'GEOGCS["WGS 84",DATUM["World Geodetic System 1984"],AUTHORITY["EPSG","4326"]]',
    "projected": 'PROJCS["UTM",GEOGCS["WGS 84",DATUM["World Geodetic System 1984"]],AUTHORITY["EPSG","32632"]]',
}


@pytest.mark.parametrize("system", SYSTEMS)
def test_earth_centred_poses_become_east_north_and_up(tmp_path, system):
    place = (47.3769, 8.5417, 408.0)
    axes, zero = local_axes(*place[:2]), earth_centred([place])[0]
    there = [(name, R @ axes, axes.T @ eye + zero) for name, R, eye in CAMERAS]
    write_metashape(tmp_path, there)
    path = tmp_path / "cameras.xml"
    path.write_text(path.read_text().replace("</chunk>", f"<reference>{SYSTEMS[system]}</reference></chunk>"))
    capture = read_capture(tmp_path)
    eyes = np.stack([frame.eye for frame in sorted(capture.frames, key=lambda each: each.name)])
    truth = np.stack([eye for _, _, eye in sorted(CAMERAS)])
    # seven digits before the point leave 1e-9 m; over a few metres, axes of places turn by less than 1e-6
    np.testing.assert_allclose(eyes, truth - truth.mean(axis=0), atol=1e-5)
    for eye, expected in zip(eyes, truth, strict=True):
        np.testing.assert_allclose(
            capture.scale.earth.rows @ [*eye, 1.0], axes.T @ expected + zero, atol=1e-6
        )
    assert capture.scale.unit == "m"


def test_a_local_system_stays_as_it_is(tmp_path):
    write_metashape(tmp_path)
    path = tmp_path / "cameras.xml"
    local = '<reference>LOCAL_CS["Local Coordinates (m)",LOCAL_DATUM["WGS 84"]]</reference>'
    path.write_text(path.read_text().replace("</chunk>", f"{local}</chunk>"))
    assert read_capture(tmp_path).scale is None
    assert_reads(tmp_path, "Metashape", seen)


@pytest.mark.parametrize(
    ("values", "says"),
    [
        (
            {"lens": {**MS_LENS, "b2": 0.2}},
            "a lens with b2 (skew) has no model here; export undistorted photos",
        ),
        ({"lens": {**MS_LENS, "k4": 0.2}}, "a lens of type frame with k4 has no model here"),
        ({"kind": "equisolid_fisheye"}, "sensors of type 'equisolid_fisheye' have no model here"),
        ({"lens": {}}, "focal length fx is 0, but must be positive"),
    ],
)
def test_a_lens_without_a_model_is_named(tmp_path, values, says):
    write_metashape(tmp_path, **values)
    with pytest.raises(DatasetError, match=re.escape(says)) as caught:
        read_capture(tmp_path)
    assert "cameras.xml, photo shot_0: " in str(caught.value)


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ("<f>20.0</f>", "<f>nan</f>", "sensor 1, f: is 'nan', but has to be 1 numbers"),
        ("<scale>2.5", "<scale>-2.5", "chunk, scale: is -2.5, but has to be positive"),
        ('"shot_0"><transform>', '"shot_0"><transform>1 ', "camera shot_0, transform: is '1 "),
        ("</document>", "", "is not XML (no element found"),
        ("<document", "<!DOCTYPE d [<!ENTITY a 'b'>]><document", "has a document type, which is refused"),
        ("<camera id", "<photo id", "is not XML (mismatched tag"),
    ],
)
def test_damaged_files_are_refused_in_one_line(tmp_path, old, new, says):
    write_metashape(tmp_path)
    path = tmp_path / "cameras.xml"
    path.write_text(path.read_text().replace(old, new, 1))
    with pytest.raises(DatasetError, match=re.escape(says)) as caught:
        read_capture(tmp_path)
    assert str(caught.value).startswith(str(path)) and "\n" not in str(caught.value)


def test_a_file_without_poses_says_what_to_do(tmp_path):
    write_metashape(tmp_path, cameras=[])
    assert layout_of(tmp_path) == "Metashape"
    with pytest.raises(DatasetError, match=r"has no posed camera; align the photos, then File > Export"):
        read_capture(tmp_path)


@pytest.mark.parametrize(("name", "count", "gps"), [("road", 78, 78), ("railway", 191, 0)])
def test_real_files(real, name, count, gps):
    """Centres lie where GPS saw the drone, and it looked down at a world with z up."""
    path = real("poses") / "metashape" / f"{name}.xml"
    poses = read(path)
    assert len(poses.shots) == count and poses.without == ()
    assert np.mean([shot.R[2, 2] for shot in poses.shots]) < -0.5
    places = {
        camera.get("label"): [float(reference.get(axis)) for axis in "xyz"]
        for camera in ElementTree.parse(path).iter("camera")
        if (reference := camera.find("reference")) is not None and reference.get("x")
    }
    off = [np.linalg.norm(shot.eye - places[shot.name]) for shot in poses.shots if shot.name in places]
    assert len(off) == len(places) == gps and (not off or np.median(off) < 0.02)
