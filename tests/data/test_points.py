"""Start points from PLY files: our own and other programs', ASCII and binary, and invalid files."""

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings, strategies as st

from gsplat_edu.base.constants import C0
from gsplat_edu.base.errors import DatasetError
from gsplat_edu.data.capture import Cloud
from gsplat_edu.data.points import finite_cloud, read_points_ply, write_points_ply

HEADER = "ply\nformat {kind} 1.0\ncomment made by hand\nelement vertex 2\n{fields}{more}end_header\n"
XYZ = "".join(f"property float {axis}\n" for axis in "xyz")
RGB = "".join(f"property uchar {name}\n" for name in ("red", "green", "blue"))


def write(tmp_path, kind, fields, body, more=""):
    path = tmp_path / "p.ply"
    path.write_bytes(HEADER.format(kind=kind, fields=fields, more=more).encode() + body)
    return path


def test_round_trip(tmp_path):
    rng = np.random.default_rng(0)
    cloud = Cloud(rng.normal(size=(50, 3)), rng.random((50, 3)))
    write_points_ply(tmp_path / "p.ply", cloud)
    back = read_points_ply(tmp_path / "p.ply")
    np.testing.assert_array_equal(back.points, cloud.points)
    np.testing.assert_allclose(back.colors, cloud.colors, rtol=0, atol=0.5 / 255 + 1e-12)


@pytest.mark.parametrize(("kind", "order"), [("binary_little_endian", "<"), ("binary_big_endian", ">")])
def test_binary(tmp_path, kind, order):
    """The columns have an unusual order, one of them is not needed, and faces follow."""
    dtype = np.dtype(
        [("z", order + "f8"), ("red", "u1"), ("green", "u1"), ("blue", "u1"), ("s", order + "i2")]
    )
    dtype = np.dtype([*dtype.descr, ("x", order + "f4"), ("y", order + "f4")])
    rows = np.array([(3, 255, 0, 51, 7, 1, 2), (-3, 0, 51, 255, 8, -1, -2)], dtype)
    names = {"f8": "double", "u1": "uchar", "i2": "int16", "f4": "float32"}
    fields = "".join(f"property {names[dtype[n].str[1:]]} {n}\n" for n in dtype.names)
    faces = "element face 1\nproperty list uchar int vertex_indices\n"
    cloud = read_points_ply(write(tmp_path, kind, fields, rows.tobytes() + b"\3" + bytes(12), faces))
    np.testing.assert_array_equal(cloud.points, [[1, 2, 3], [-1, -2, -3]])
    np.testing.assert_allclose(cloud.colors, [[1, 0, 0.2], [0, 0.2, 1]], atol=1e-12)


def test_ascii(tmp_path):
    cloud = read_points_ply(
        write(tmp_path, "ascii", XYZ + RGB, b"1 2 3 255 0 51\n-1 nan 1e3 0 0 0\n3 0 1 1\n")
    )
    np.testing.assert_array_equal(cloud.points, [[1, 2, 3], [-1, np.nan, 1000]])
    np.testing.assert_allclose(cloud.colors, [[1, 0, 0.2], [0, 0, 0]], atol=1e-12)
    clean, note = finite_cloud(cloud)
    assert len(clean.points) == 1 and str(note).startswith("1 of 2 points")


def test_colours(tmp_path):
    """Float colours are 0 to 1, f_dc are spherical harmonics, and without any colour a point is gray."""
    body = np.array([[0, 0, 0, 0.25, 0.5, 2.0]] * 2, "<f4").tobytes()
    floats = RGB.replace("uchar", "float")
    cloud = read_points_ply(write(tmp_path, "binary_little_endian", XYZ + floats, body))
    np.testing.assert_allclose(cloud.colors, [[0.25, 0.5, 1.0]] * 2)
    sh0 = "".join(f"property float f_dc_{i}\n" for i in range(3))
    cloud = read_points_ply(write(tmp_path, "binary_little_endian", XYZ + sh0, body))
    np.testing.assert_allclose(cloud.colors, [[0.5 + 0.25 * C0, 0.5 + 0.5 * C0, 1.0]] * 2)
    cloud = read_points_ply(write(tmp_path, "ascii", XYZ, b"0 0 0\n1 1 1\n"))
    np.testing.assert_array_equal(cloud.colors, np.full((2, 3), 0.5))


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "not a PLY"),
        (b"version https://git-lfs.github.com/spec/v1\n", "git lfs pull"),
        (b"ply\nformat ascii 1.0\nend_header\n", "x, y and z"),
        (HEADER.format(kind="ascii", fields=XYZ[:-17], more="").encode(), "x, y and z"),
        (HEADER.format(kind="ascii", fields=XYZ, more="").encode() + b"1 2 3\n", "truncated: 1 of 2"),
        (HEADER.format(kind="ascii", fields=XYZ, more="").encode() + b"1 2 3\n4 5\n", "cannot be read"),
        (HEADER.format(kind="ascii", fields=XYZ, more="").encode() + b"1\n4\n", "1 numbers, .* names 3"),
        (HEADER.format(kind="ascii", fields=XYZ, more="").encode() + b"1 2 3\n4 5 x\n", "cannot be read"),
        (HEADER.format(kind="binary_little_endian", fields=XYZ, more="").encode() + b"123", "truncated"),
        (
            HEADER.format(kind="ascii", fields=XYZ + "property list uchar int i\n", more="").encode(),
            "has the list i",
        ),
        (b"ply\nformat ascii 1.0\nelement face 3\nend_header\n", "no vertices"),
        (
            b"ply\nformat binary_little_endian 1.0\nelement vertex 999999999999\n"
            + XYZ.encode()
            + b"end_header\n",
            "truncated",
        ),
        (b"ply\nformat ascii 1.0\nelement vertex -2\n" + XYZ.encode() + b"end_header\n", "line 3"),
    ],
)
def test_invalid_clouds_are_refused(tmp_path, content, message):
    path = tmp_path / "p.ply"
    path.write_bytes(content)
    with pytest.raises(DatasetError, match=message) as caught:
        read_points_ply(path)
    assert "p.ply" in str(caught.value) and "\n" not in str(caught.value)


def test_a_nonfinite_colour_is_gray(tmp_path):
    floats = RGB.replace("uchar", "float")
    cloud = read_points_ply(write(tmp_path, "ascii", XYZ + floats, b"1 2 3 nan 0.5 1\n1 2 3 inf -inf 0\n"))
    np.testing.assert_array_equal(cloud.colors, [[0.5, 0.5, 1.0], [1.0, 0.0, 0.0]])


def test_the_vertices_need_not_come_first(tmp_path):
    path = tmp_path / "p.ply"
    path.write_bytes(
        b"ply\nformat ascii 1.0\nelement sensor 1\nproperty int id\nelement vertex 1\n"
        + XYZ.encode()
        + b"end_header\n7\n1 2 3\n"
    )
    np.testing.assert_array_equal(read_points_ply(path).points, [[1, 2, 3]])


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    kind=st.sampled_from(["ascii", "binary_little_endian", "binary_big_endian"]),
    flips=st.lists(st.tuples(st.floats(0, 1, exclude_max=True), st.integers(1, 255)), max_size=5),
    keep=st.floats(0, 1),
)
def test_garbled_files_end_in_a_dataset_error_or_points(tmp_path, kind, flips, keep):
    body = b"1 2 3 4 5 6\n7 8 9 10 11 12\n" if kind == "ascii" else bytes(range(200, 230))
    data = bytearray(HEADER.format(kind=kind, fields=XYZ + RGB, more="").encode() + body)
    for where, change in flips:
        data[int(where * len(data))] ^= change
    path = tmp_path / "p.ply"
    path.write_bytes(bytes(data[: round(keep * len(data))]))
    try:
        finite_cloud(read_points_ply(path))
    except DatasetError as error:
        assert "\n" not in str(error)


def test_real_files(real):
    """The fox's cloud, a Gaussian scene with SH, a mesh, and a splat file without colours but with infinities."""
    fox = read_points_ply(real("fox/points3D_aligned_derived.ply"))
    assert len(fox.points) == 1457 and 0 < fox.colors.std() < 0.5
    odd = read_points_ply(real("odd/no_colour_value_weight.ply"))
    assert len(odd.points) == 48962 and (odd.colors == 0.5).all()
    clean, _ = finite_cloud(odd)
    assert np.isfinite(clean.points).all()
    (scene,) = [p for p in real("plush_dog").glob("*.ply") if "compressed" not in p.name]
    cloud = read_points_ply(scene)
    assert len(cloud.points) == 15105 and cloud.colors.std() > 0.05
    for mesh in real("formats/ply_beetle").glob("*.ply"):
        assert len(read_points_ply(mesh).points) > 100
    with pytest.raises(DatasetError, match="git lfs pull"):
        read_points_ply(real("odd/lfs_pointer_point_cloud.ply"))
