"""Point clouds of scanners: what other programs write is read, thinned, coloured, and refused if it lies elsewhere."""

import subprocess
import sys

import laspy
import numpy as np
import pye57
import pyproj
import pytest
from pye57 import libe57

import gsplat_edu.cli.main as command_line
from gsplat_edu.base.errors import DatasetError
from gsplat_edu.data.capture import Cloud
from gsplat_edu.data.point_files import read_points
from gsplat_edu.data.points import read_points_ply, write_points_ply
from gsplat_edu.data.procedural import procedural_capture
from gsplat_edu.data.scale import Scale, write_scale
from gsplat_edu.data.visible_cloud import colored, thinned
from gsplat_edu.data.writers import write_colmap, write_transforms
from gsplat_edu.runs.folder import RunFolder
from gsplat_edu.scene.earth import EARTH_CENTRED, Earth, converted
from lab.captures.room import room_capture

FAR = np.array([500_000.25, 5_400_000.5, 120.0])
"""Coordinates of a map, which float32 cannot hold to the centimetre."""


@pytest.fixture
def cloud():
    rng = np.random.default_rng(3)
    return Cloud(rng.uniform(-2, 2, (300, 3)) + FAR, rng.integers(0, 256, (300, 3)) / 255.0)


def write_las(path, cloud, colored=True, bits=16):
    header = laspy.LasHeader(point_format=2 if colored else 0, version="1.2")
    header.offsets, header.scales = FAR, np.full(3, 1e-4)
    file = laspy.LasData(header)
    file.x, file.y, file.z = cloud.points.T
    if colored:
        whole = np.round(cloud.colors * (65535 if bits == 16 else 255)).astype(np.uint16)
        file.red, file.green, file.blue = whole.T
    file.write(path)


class E57(pye57.E57):
    """An E57 whose header names a system, which pye57 leaves empty."""

    system = ""

    def write_default_header(self):
        file = self.image_file
        file.extensionsAdd("", libe57.E57_V1_0_URI)
        self.root.set("formatName", libe57.StringNode(file, "ASTM E57 3D Imaging Data File"))
        self.root.set("guid", libe57.StringNode(file, "{0}"))
        self.root.set("versionMajor", libe57.IntegerNode(file, libe57.E57_FORMAT_MAJOR))
        self.root.set("versionMinor", libe57.IntegerNode(file, libe57.E57_FORMAT_MINOR))
        self.root.set("coordinateMetadata", libe57.StringNode(file, self.system))
        self.root.set("data3D", libe57.VectorNode(file, True))


def write_e57(path, clouds, colored=True, system=None, origin=FAR):
    """Each scan lies around its own origin, and its pose moves it to its place."""
    kind = pye57.E57 if system is None else type("Placed", (E57,), {"system": system})
    with kind(str(path), mode="w") as file:
        for cloud in clouds:
            data = dict(
                zip(("cartesianX", "cartesianY", "cartesianZ"), (cloud.points - origin).T, strict=True)
            )
            if colored:
                whole = np.round(255 * cloud.colors).astype(np.uint8)
                data |= dict(zip(("colorRed", "colorGreen", "colorBlue"), whole.T, strict=True))
            file.write_scan_raw(data, rotation=np.array([1.0, 0, 0, 0]), translation=origin)


def write_pcd(path, cloud, way):
    """Write x y z as float64 and the colours packed into a float32, as the Point Cloud Library does."""
    r, g, b = np.round(255 * cloud.colors).astype(np.uint32).T
    packed = ((r << 16) | (g << 8) | b).astype("<u4").view("<f4")
    table = np.zeros(len(r), [("x", "<f8"), ("y", "<f8"), ("z", "<f8"), ("rgb", "<f4")])
    table["x"], table["y"], table["z"] = cloud.points.T
    table["rgb"] = packed
    header = (
        "# .PCD v0.7 - Point Cloud Data file format\nVERSION 0.7\nFIELDS x y z rgb\nSIZE 8 8 8 4\nTYPE F F F F\n"
        f"COUNT 1 1 1 1\nWIDTH {len(r)}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {len(r)}\nDATA {way}\n"
    )
    rows = "".join(f"{x!r} {y!r} {z!r} {c!r}\n" for x, y, z, c in table.tolist()).encode()
    path.write_bytes(header.encode() + (rows if way == "ascii" else table.tobytes()))


@pytest.mark.parametrize(
    ("name", "write", "accuracy"),
    [
        ("scan.las", write_las, 1e-4),
        ("scan.laz", write_las, 1e-4),
        ("bytes.las", lambda path, cloud: write_las(path, cloud, bits=8), 1e-4),
        # its writer stores float32 around the origin of each scan: half a step at 2 units
        ("scan.e57", lambda path, cloud: write_e57(path, [cloud]), 2.0 * 2**-24),
        ("ascii.pcd", lambda path, cloud: write_pcd(path, cloud, "ascii"), 1e-9),
        ("binary.pcd", lambda path, cloud: write_pcd(path, cloud, "binary"), 1e-9),
        ("points.ply", write_points_ply, 1e-9),
        ("named wrongly.txt", write_las, 1e-4),
    ],
)
def test_points_and_colours_are_read_in_double(tmp_path, cloud, name, write, accuracy):
    write(tmp_path / name, cloud)
    found = read_points(tmp_path / name)
    np.testing.assert_allclose(found.points, cloud.points, rtol=0, atol=accuracy)
    np.testing.assert_allclose(found.colors, cloud.colors, atol=1e-4)
    assert found.scan == (name != "points.ply")


def test_scans_of_an_e57_are_joined_and_those_without_colour_have_none(tmp_path, cloud):
    other = Cloud(cloud.points + 1.0, cloud.colors)
    write_e57(tmp_path / "a.e57", [cloud, other])
    found = read_points(tmp_path / "a.e57")
    np.testing.assert_allclose(found.points, np.concatenate([cloud.points, other.points]), atol=1e-9)
    write_e57(tmp_path / "b.e57", [cloud], colored=False)
    assert read_points(tmp_path / "b.e57").colors is None
    write_las(tmp_path / "c.las", cloud, colored=False)
    assert read_points(tmp_path / "c.las").colors is None
    assert (read_points(tmp_path / "c.las").cloud.colors == 0.5).all()


@pytest.mark.parametrize("name", ["a.las", "a.laz", "a.e57", "a.pcd"])
@pytest.mark.parametrize("kept", [0.3, 0.9])
def test_a_truncated_file_costs_one_line(tmp_path, cloud, name, kept):
    path = tmp_path / name
    if name == "a.pcd":
        write_pcd(path, cloud, "binary")
    elif name == "a.e57":
        write_e57(path, [cloud])
    else:
        write_las(path, cloud)
    path.write_bytes(path.read_bytes()[: int(kept * path.stat().st_size)])
    with pytest.raises(DatasetError, match=r"a\.\w+: cannot be read as") as caught:
        read_points(path)
    assert "\n" not in str(caught.value)


def test_what_cannot_be_read_says_what_to_do(tmp_path, cloud):
    write_pcd(tmp_path / "a.pcd", cloud, "binary_compressed")
    with pytest.raises(DatasetError, match="DATA binary_compressed: save it as binary or ascii"):
        read_points(tmp_path / "a.pcd")
    write_las(tmp_path / "none.las", Cloud(cloud.points[:0], cloud.colors[:0]))
    with pytest.raises(DatasetError, match="holds no points"):
        read_points(tmp_path / "none.las")


@pytest.mark.own_process
def test_without_the_library_a_line_names_the_extra(tmp_path, cloud):
    write_las(tmp_path / "a.las", cloud)
    words = "import sys; sys.modules['laspy'] = None\nfrom gsplat_edu.data.point_files import read_points\n"
    words += "from pathlib import Path\ntry: read_points(Path(sys.argv[1]))\nexcept Exception as error: print(error)"
    said = subprocess.run(
        [sys.executable, "-c", words, str(tmp_path / "a.las")], capture_output=True, text=True, check=True
    )
    assert (
        "a.las: needs laspy, which is not installed: pip install" in said.stdout and "[scans]" in said.stdout
    )


def test_thinning_is_even_and_keeps_given_points():
    """A dense cluster loses points, and sparse points stay."""
    rng = np.random.default_rng(1)
    dense, sparse = rng.uniform(0, 0.01, (5_000, 3)), rng.uniform(-1, 1, (200, 3))
    points = np.concatenate([dense, sparse])
    kept = thinned(points, 400)
    assert 300 < len(kept) <= 400 and (np.diff(kept) > 0).all()
    assert (kept >= 5_000).sum() > 190
    assert thinned(points, 10_000).tolist() == list(range(5_200))


def test_points_take_the_colours_of_the_nearest_photo():
    views, points, colors = room_capture(96, 72, 24)
    found = colored(points, views)
    assert np.median(np.abs(found - colors)) < 0.05


def trained(capsys, capture, out, *words, code=0):
    few = ("--iterations", "2", "--backend", "cpu", "--trust-poses")
    assert command_line.main(["train", str(capture), "--out", str(out), *few, *map(str, words)]) == code
    printed = capsys.readouterr()
    return printed.err if code else printed.out


@pytest.fixture
def capture(tmp_path):
    """A capture without points, far from the origin, and its points."""
    views, points, _ = procedural_capture(32, 8, splats=60)
    write_transforms(tmp_path / "capture", views)
    points = np.repeat(points, 20, axis=0) + np.random.default_rng(5).normal(0, 0.01, (20 * len(points), 3))
    return tmp_path / "capture", points


def test_a_training_starts_from_a_scan(tmp_path, capsys, capture):
    folder, points = capture
    behind = np.array([[0.0, 90.0, 0.0]])
    header = laspy.LasHeader(point_format=0, version="1.2")
    header.scales = np.full(3, 1e-4)
    file = laspy.LasData(header)
    file.x, file.y, file.z = np.concatenate([points, behind]).T
    file.write(tmp_path / "scan.las")
    out = trained(capsys, folder, tmp_path / "run", "--points", tmp_path / "scan.las")
    assert f"training starts from {len(points):,} of {len(points) + 1:,} points that the photos see" in out
    assert "coloured by the photos" in out
    kept = read_points_ply(tmp_path / "run" / "points.ply")
    np.testing.assert_allclose(kept.points, points, atol=1e-4)
    assert len(np.unique(kept.colors, axis=0)) > 50
    assert RunFolder(tmp_path / "run").read_config()["data"]["points"].endswith("points.ply")
    (tmp_path / "scan.las").unlink()  # a resumed run has its points
    trained(capsys, folder, tmp_path / "run", "--resume", "--iterations", 3)


def test_few_points_are_enough_if_the_photos_see_them(tmp_path, capsys, capture):
    folder, points = capture
    write_pcd(
        tmp_path / "few.pcd", Cloud(np.concatenate([points[:30], FAR[None]]), np.full((31, 3), 0.5)), "binary"
    )
    out = trained(capsys, folder, tmp_path / "run", "--points", tmp_path / "few.pcd")
    assert "training starts from 30 of 31 points that the photos see" in out


def test_a_scan_in_other_coordinates_is_refused(tmp_path, capsys, capture):
    folder, points = capture
    header = laspy.LasHeader(point_format=0, version="1.2")
    header.offsets, header.scales = FAR, np.full(3, 1e-3)
    file = laspy.LasData(header)
    file.x, file.y, file.z = (points + FAR).T
    file.write(tmp_path / "map.las")
    err = trained(capsys, folder, tmp_path / "run", "--points", tmp_path / "map.las", code=2)
    assert "map.las: the photos see 0 of" in err and "middle is at (500000, 5.4e+06, 120.0" in err
    assert err.count("\n") == 1 and not (tmp_path / "run").exists()


@pytest.fixture
def placed(tmp_path):
    """A capture of COLMAP, which may say where on earth it is, and its points."""
    views, points, colors = procedural_capture(32, 8, splats=60)
    write_colmap(tmp_path / "placed", views, points, colors)
    return tmp_path / "placed", points


def write_mapped(path, places, crs):
    """Write a LAS or an E57 that names its system."""
    if path.suffix == ".e57":
        text, cloud = pyproj.CRS(crs).to_wkt("WKT1_GDAL"), Cloud(places, np.full(places.shape, 0.5))
        write_e57(path, [cloud], False, text, np.floor(places.min(axis=0)))
        return
    header = laspy.LasHeader(point_format=6, version="1.4")
    header.offsets, header.scales = np.floor(places.min(axis=0)), np.full(3, 1e-4)
    header.add_crs(pyproj.CRS(crs))
    file = laspy.LasData(header)
    file.x, file.y, file.z = places.T
    file.write(path)


@pytest.mark.parametrize(
    ("crs", "name"), [("EPSG:32633", "map.las"), ("EPSG:4978", "map.las"), ("EPSG:32633", "map.e57")]
)
def test_a_scan_in_another_reference_system_is_moved_to_a_capture_that_knows_its_place(
    tmp_path, capsys, placed, crs, name
):
    folder, points = placed
    earth = Earth.at_place(47.0, 15.3, 400.0)
    places = converted(points @ earth.rows[:, :3].T + earth.rows[:, 3], EARTH_CENTRED, crs)
    write_mapped(tmp_path / name, places, crs)
    assert read_points(tmp_path / name).crs == crs
    err = trained(capsys, folder, tmp_path / "run", "--points", tmp_path / name, code=2)
    assert f"{name}: the photos see 0 of" in err  # nobody knows where the capture is
    write_scale(folder, Scale("m", "GPS", earth=earth))
    out = trained(capsys, folder, tmp_path / "run", "--points", tmp_path / name)
    assert f"that the photos see, moved from {crs} to the capture's coordinates" in out
    np.testing.assert_allclose(read_points_ply(tmp_path / "run" / "points.ply").points, points, atol=2e-4)


@pytest.mark.parametrize("system", ["", " ", "nowhere", 'LOCAL_CS["site"]', "EPSG:32633 garbage"])
def test_an_e57_without_a_system_that_has_a_code_is_read_without_one(tmp_path, cloud, system):
    write_e57(tmp_path / "a.e57", [cloud], system=system)
    assert read_points(tmp_path / "a.e57").crs is None


def test_heights_above_the_sea_keep_their_system(tmp_path, cloud):
    write_e57(tmp_path / "a.e57", [cloud], system=pyproj.CRS("EPSG:32633+5773").to_wkt("WKT1_GDAL"))
    assert read_points(tmp_path / "a.e57").crs == "EPSG:32633+5773"


def test_the_system_of_a_scan_that_lies_elsewhere_is_named(tmp_path, capsys, placed):
    folder, points = placed
    write_scale(folder, Scale("m", "GPS", earth=Earth.at_place(47.0, 8.0, 400.0)))
    write_mapped(tmp_path / "map.las", points + FAR, "EPSG:32633")
    err = trained(capsys, folder, tmp_path / "run", "--points", tmp_path / "map.las", code=2)
    assert "map.las: the photos see 0 of" in err and ", moved from EPSG:32633 to the capture's" in err
    assert err.count("\n") == 1


def test_a_far_scan_in_the_direction_of_a_photo_is_refused(tmp_path, capsys, capture):
    """All photos that look that way show the points, as one dot."""
    folder, points = capture
    views, _, _ = procedural_capture(32, 8, splats=60)
    write_points_ply(
        tmp_path / "p.ply", Cloud(points + 1e6 * views[1].camera.R[2], np.full(points.shape, 0.5))
    )
    err = trained(capsys, folder, tmp_path / "run", "--points", tmp_path / "p.ply", code=2)
    assert "p.ply: the photos see 0 of" in err and err.count("\n") == 1 and not (tmp_path / "run").exists()


def test_a_coloured_ply_elsewhere_is_refused_and_starts_no_training(tmp_path, capsys, capture):
    folder, points = capture
    write_points_ply(tmp_path / "p.ply", Cloud(points + FAR, np.full(points.shape, 0.5)))
    err = trained(capsys, folder, tmp_path / "run", "--points", tmp_path / "p.ply", code=2)
    assert (
        "p.ply: the photos see 0 of" in err
        and "bring them into the coordinates of the capture's poses" in err
    )
    assert err.count("\n") == 1 and not (tmp_path / "run").exists()


def test_a_coloured_ply_stays_as_it_is(tmp_path, capsys, capture):
    folder, points = capture
    write_points_ply(tmp_path / "p.ply", Cloud(points, np.full(points.shape, 0.5)))
    trained(capsys, folder, tmp_path / "run", "--points", tmp_path / "p.ply")
    assert not (tmp_path / "run" / "points.ply").exists()
