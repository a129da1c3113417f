from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree

from gsplat_edu.base.constants import C0
from gsplat_edu.base.errors import ArgumentError, SceneFormatError
from gsplat_edu.io.compressed_ply import read, write
from gsplat_edu.io.formats import read_scene
from gsplat_edu.io.ply import load_ply
from gsplat_edu.io.scene import Scene
from scene_files import kept_file, matched, random_scene, refused

XYZ = [f"{end}_{axis}" for end in ("min", "max") for axis in "xyz"]
SCALES = [f"{end}_scale_{axis}" for end in ("min", "max") for axis in "xyz"]
RGB = [f"{end}_{channel}" for end in ("min", "max") for channel in "rgb"]
PACKED = ["packed_position", "packed_rotation", "packed_scale", "packed_color"]
HALF = 0.5  # The largest errors of rounding to the nearest step.


def parse(path):
    """Parse a file with a minimal reader that accepts only this package's layout."""
    header, body = path.read_bytes().split(b"end_header\n", 1)
    lines = [line for line in header.decode("ascii").splitlines() if not line.startswith("comment")]
    assert lines[:2] == ["ply", "format binary_little_endian 1.0"]
    chunks = int(lines[2].removeprefix("element chunk "))
    assert lines[3:21] == [f"property float {name}" for name in (*XYZ, *SCALES, *RGB)]
    count = int(lines[21].removeprefix("element vertex "))
    assert lines[22:26] == [f"property uint {name}" for name in PACKED]
    sh = len(lines[27:])
    if sh:
        assert lines[26] == f"element sh {count}"
        assert lines[27:] == [f"property uchar f_rest_{i}" for i in range(sh)]
    assert len(body) == 72 * chunks + (16 + sh) * count
    bounds, words = body[: 72 * chunks], body[72 * chunks : 72 * chunks + 16 * count]
    rest = body[72 * chunks + 16 * count :]
    return (
        np.frombuffer(bounds, "<f4").reshape(chunks, 6, 3),
        np.frombuffer(words, "<u4").reshape(count, 4),
        np.frombuffer(rest, "u1").reshape(count, sh),
    )


def by_hand(path, elements, order="<"):
    """Write elements as lists of (name, kind, values) per property."""
    kinds = {"f4": "float", "f8": "double", "u4": "uint", "i4": "int", "u1": "uchar"}
    form = {"<": "binary_little_endian", ">": "binary_big_endian"}[order]
    lines, body = ["ply", f"format {form} 1.0", "comment by hand"], b""
    for element, properties in elements.items():
        table = np.empty(len(properties[0][2]), dtype=[(name, order + kind) for name, kind, _ in properties])
        for name, _, values in properties:
            table[name] = values
        lines += [f"element {element} {len(table)}"]
        lines += [f"property {kinds[kind]} {name}" for name, kind, _ in properties]
        body += table.tobytes()
    path.write_bytes("\n".join([*lines, "end_header", ""]).encode() + body)


def chunk_element(bounds, kind="f4"):
    return [(name, kind, [value]) for name, value in bounds.items()]


BOUNDS = dict(zip((*XYZ, *SCALES), (-1, -2, 10, 1, 2, 20, -5, -6, -7, -1, -2, 3), strict=True))
COLORS = dict(zip(RGB, (-0.5, 0, 0, 1.5, 1, 0.5), strict=True))
WORDS = {
    "packed_position": [2047 << 21 | 0 << 11 | 2047, 0 << 21 | 1023 << 11 | 0],
    "packed_rotation": [0 << 30 | 512 << 20 | 100 << 10 | 900, 3 << 30 | 0 << 20 | 1023 << 10 | 100],
    "packed_scale": [0 << 21 | 1023 << 11 | 2047, 1024 << 21 | 0 << 11 | 0],
    "packed_color": [255 << 24 | 0 << 16 | 51 << 8 | 51, 0 << 24 | 255 << 16 | 102 << 8 | 255],
}


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("colored", [True, False])
def test_a_handmade_file_is_read(tmp_path, colored, order):
    """Properties and elements are found by name, in any order and among unknown ones."""
    chunk = chunk_element(BOUNDS | (COLORS if colored else {}), "f8" if order == ">" else "f4")
    vertex = [("extra", "u1", [1, 2]), *((name, "u4", WORDS[name]) for name in reversed(PACKED))]
    path = tmp_path / "a.compressed.ply"
    by_hand(
        path,
        {"camera": [("fov", "f4", [1.0])], "vertex": vertex, "chunk": chunk[::-1], "face": vertex},
        order,
    )
    scene = read(path)
    g = scene.gaussians
    assert (scene.antialiased, scene.up, g.sh_degree) == (None, None, 0)
    np.testing.assert_array_equal(g.means.numpy(), [[1, -2, 20], [-1, 2, 10]])  # axes are those of the file
    middle = -5 + 4 * 1024 / 2047
    np.testing.assert_allclose(g.log_scales.numpy(), [[-5, -2, 3], [middle, -6, -7]], rtol=1e-6)
    rgb = np.array([[1.0, 0.0, 0.2], [0.0, 1.0, 0.4]])
    if colored:
        rgb = np.array([[1.5, 0.0, 0.1], [-0.5, 1.0, 0.2]])
    np.testing.assert_allclose(g.sh0.numpy()[:, 0], (rgb - 0.5) / C0, rtol=1e-6, atol=1e-6)
    # 51 of 255 is 0.2; 255 is read as a quarter of a step below 1
    np.testing.assert_allclose(g.opacities.numpy(), [0.2, 1 - 0.25 / 255], rtol=1e-6)
    first, second = g.quats.double().numpy()
    code = np.sqrt(2.0) * (np.array([[512, 100, 900], [0, 1023, 100]]) / 1023 - 0.5)
    np.testing.assert_allclose(first[1:], code[0], atol=1e-7)  # w is the largest
    assert first[0] == pytest.approx(np.sqrt(1 - (code[0] ** 2).sum()), abs=1e-7)
    # z is omitted, but the other components have length 1 already
    np.testing.assert_allclose(second, [*code[1], 0.0], atol=1e-7)


@pytest.mark.parametrize("rest", [3, 8, 15])
def test_sh_bytes_are_stored_channel_by_channel(tmp_path, rest):
    codes = np.arange(2 * 3 * rest).reshape(2, 3 * rest)
    codes[0, :2], codes[1, 0] = (255, 128), 0
    sh = [(f"f_rest_{i}", "u1", codes[:, i]) for i in range(3 * rest)][::-1]
    path = tmp_path / "a.compressed.ply"
    vertex = [(name, "u4", values) for name, values in WORDS.items()]
    by_hand(path, {"chunk": chunk_element(BOUNDS), "vertex": vertex, "sh": sh})
    values = read(path).gaussians.sh_rest
    assert values.shape == (2, rest, 3) and values.is_contiguous() and values.dtype == torch.float32
    for channel in range(3):
        for k in range(rest):
            for splat in range(2):
                code = codes[splat, channel * rest + k]
                expected = {0: -4.0, 255: 4.0}.get(code, (code + 0.5) / 32 - 4)
                assert values[splat, k, channel] == expected


def check_values(path, given):
    """Check what a file holds against Gaussians in its order, each number within half a step of its chunk."""
    back = read(path).relative_to((0.0, 0.0, 0.0))
    bounds = parse(path)[0].astype(np.float64)
    low, high = np.repeat(bounds[:, 0::2], 256, axis=0), np.repeat(bounds[:, 1::2], 256, axis=0)
    extents = (high - low)[: len(given)].transpose(1, 0, 2)  # position, scale, colour
    steps = np.array([2047, 1023, 2047])
    rounding = 3e-7  # relative rounding of float32
    for name, extent in (("means", extents[0] / steps), ("log_scales", extents[1] / steps)):
        before, after = (x.tensors()[name].double().numpy() for x in (given, back))
        assert (np.abs(after - before) <= (HALF + rounding) * extent + rounding * np.abs(before)).all(), name
    before, after = (x.sh0[:, 0].double().numpy() for x in (given, back))
    assert (
        np.abs(after - before) <= HALF * extents[2] / 255 / C0 + 4 * rounding * (1 + np.abs(before))
    ).all()
    # A coefficient is read as the middle of its step of 1/32, except bytes 0 and 255, which are read as the outer ends.
    before, after = (x.sh_rest.numpy() for x in (given, back))
    assert (np.abs(after - np.clip(before, -4, 4)) <= np.where(np.abs(after) == 4, 1 / 32, 1 / 64)).all()
    before, after = (x.opacities.double().numpy() for x in (given, back))
    assert (np.abs(after - before) <= HALF / 255 + rounding).all()
    check_rotations(given.quats, back.quats)


def check_rotations(before, after):
    assert (after.norm(dim=1) - 1).abs().max() < 1e-6 if len(after) else True
    before = torch.nn.functional.normalize(before.double(), dim=1)
    after = after.double() * torch.sign((before * after).sum(dim=1, keepdim=True))
    # Three components are rounded to steps of sqrt(2) / 1023. The fourth follows from the unit length. Since it is
    # the largest, its error is at most the sum of the three.
    assert ((after - before).abs() <= 3 * HALF * np.sqrt(2) / 1023 + 1e-6).all()


@pytest.mark.parametrize("count", [0, 1, 256, 257])
@pytest.mark.parametrize("rest", [0, 3, 8, 15])
def test_a_round_trip_stays_within_half_a_step(tmp_path, rest, count):
    scene, path = random_scene(count, rest), tmp_path / "new" / "a.compressed.ply"
    write(path, scene)
    bounds, words, sh = parse(path)
    assert (len(bounds), len(words), sh.shape[1]) == ((count + 255) // 256, count, 3 * rest)
    back = read(path)
    assert (back.antialiased, back.up) == (False, (0.0, -1.0, 0.0))
    assert back.gaussians.sh_rest.shape == (count, rest, 3)
    check_values(path, matched(scene.gaussians, back.gaussians))


def with_means(means):
    """Return splats at given means whose scales encode their number as two digits of base 100."""
    number = torch.arange(len(means))
    tags = torch.stack([number // 100, 0 * number, number % 100], dim=1) / 10 - 5
    means = torch.as_tensor(np.asarray(means), dtype=torch.float32)
    return Scene(replace(random_scene(len(means), 0).gaussians, means=means, log_scales=tags))


def order_of(scene, path):
    """Return the order of the scene's splats in the file."""
    write(path, scene)
    digits = np.rint(10 * (read(path).gaussians.log_scales.double().numpy() + 5)).astype(int)
    return 100 * digits[:, 0] + digits[:, 2]


def test_splats_are_sorted_along_a_morton_curve(tmp_path):
    """Each corner of a cube has 300 splats, shuffled. x varies fastest, then y, then z; a corner keeps its order."""
    corner = np.random.default_rng(0).permutation(np.repeat(np.arange(8), 300))
    means = np.stack([corner & 1, corner >> 1 & 1, corner >> 2], axis=1)
    order = order_of(with_means(means), tmp_path / "a.compressed.ply")
    np.testing.assert_array_equal(order, np.argsort(corner, kind="stable"))


def test_chunks_are_tight(tmp_path):
    """Next to an outlier, a cluster is a single cell of the curve, and is sorted again by itself."""
    rng = np.random.default_rng(0)
    means = np.concatenate([rng.uniform(0, 1, (8 * 8 * 8 * 256, 3)), [[1e6, 1e6, 1e6]]])
    path = tmp_path / "a.compressed.ply"
    write(path, with_means(means))
    bounds, _, _ = parse(path)
    extents = bounds[:-1, 1] - bounds[:-1, 0]
    # 512 chunks of equal counts in a unit cube. Cubes would have edges of 1/8; a chunk that crosses the border of two
    # cells of the curve is longer.
    assert np.median(extents) < 0.2


def test_a_sorted_scene_keeps_its_order(tmp_path):
    scene = with_means(np.random.default_rng(0).normal(size=(5000, 3)))
    shuffled = order_of(scene, tmp_path / "a.compressed.ply")
    assert (shuffled != np.arange(5000)).mean() > 0.9
    sorted_scene = Scene(scene.gaussians.map(lambda tensor: tensor[torch.from_numpy(shuffled)]))
    nearly = np.arange(5000)
    nearly[100:120] = np.arange(119, 99, -1)
    again = Scene(sorted_scene.gaussians.map(lambda tensor: tensor[torch.from_numpy(nearly)]))
    write(tmp_path / "b.compressed.ply", again)
    check_values(tmp_path / "b.compressed.ply", again.gaussians)


@pytest.mark.parametrize("count", [1, 2, 600])
def test_all_means_in_one_point(tmp_path, count):
    scene, path = with_means(np.full((count, 3), 1234.5678)), tmp_path / "a.compressed.ply"
    write(path, scene)
    check_values(path, scene.gaussians)  # equal codes keep their order
    np.testing.assert_array_equal(
        read(path).relative_to((0, 0, 0)).means.numpy(), scene.gaussians.means.numpy()
    )


@pytest.mark.parametrize("size", [1e-45, 1e-30, 1e-7, 3e38])
def test_extents_at_the_ends_of_float32(tmp_path, size):
    means = np.random.default_rng(0).integers(-1, 2, (600, 3)) * np.float32(size)
    scene, path = with_means(means), tmp_path / "a.compressed.ply"
    order = order_of(scene, path)
    check_values(path, scene.gaussians.map(lambda tensor: tensor[torch.from_numpy(order)]))


def test_values_out_of_range_are_clamped(tmp_path):
    g = random_scene(4, 3).gaussians
    log_scales = g.log_scales.clone()
    log_scales[0], log_scales[1] = -1e30, 1e30
    sh_rest = torch.tensor([-3e38, -4.0, 4.0, 3e38])[:, None, None].repeat(1, 3, 3)
    logits = torch.tensor([-400.0, 400.0, -3e38, 3e38])
    quats = torch.tensor([[1e-38, 0, 0, 0], [3e38, 3e38, 0, 0], [-1e-45, 0, 0, 0], [0, 2, 0, -2]])
    scene = Scene(replace(g, log_scales=log_scales, sh_rest=sh_rest, logit_opacities=logits, quats=quats))
    path = tmp_path / "a.compressed.ply"
    write(path, scene)
    back = matched(read(path).gaussians, scene.gaussians)
    assert back.log_scales[0].tolist() == [-20] * 3 and back.log_scales[1].tolist() == [20] * 3
    assert back.sh_rest[:, 0, 0].tolist() == [-4, -4, 4, 4]
    edge = np.log(0.25 / 254.75)  # a quarter of a step from 0 and 1
    np.testing.assert_allclose(back.logit_opacities.numpy(), [edge, -edge, edge, -edge], rtol=1e-6)
    check_rotations(torch.tensor([[1.0, 0, 0, 0], [1, 1, 0, 0], [-1, 0, 0, 0], [0, 1, 0, -1]]), back.quats)


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("quats", 0.0, r"quats\[3\]: has zero length"),
        ("means", np.nan, r"means\[3, 0\]: is NaN or infinite"),
        ("means", 1e300, r"means\[3, 0\]: is NaN or infinite"),
    ],
)
def test_values_that_cannot_be_written_are_named(tmp_path, name, value, message):
    path = tmp_path / "a.compressed.ply"
    scene = Scene(random_scene(5).gaussians.map(torch.Tensor.double))
    scene.gaussians.tensors()[name][3] = value
    with pytest.raises(ArgumentError, match=message):
        write(path, scene)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({b"ply\n": b"PK\x03\x04\n"}, "is not a PLY: its first line is not 'ply'"),
        ({b"ply\n": b"version https://git-lfs.github.com/spec/v1\n"}, "is a Git LFS pointer"),
        ({b"binary_little_endian": b"ascii"}, "is a compressed splat PLY in ASCII"),
        ({b"element vertex 300": b"element point 300"}, "vertex lacks packed_position, packed_rotation,"),
        ({b"element chunk 2": b"element block 2"}, "chunk lacks min_x, min_y,"),
        ({b"packed_scale": b"packed_size"}, "vertex lacks packed_scale; give another file"),
        ({b"max_scale_y": b"max_size_y"}, "chunk lacks max_scale_y; give another file"),
        ({b"float max_b": b"float max_blue"}, "chunk lacks max_b; give another file"),
        ({b"uint packed_color": b"float packed_color"}, "packed_color is not of type uint"),
        ({b"uint packed_color": b"list uchar uint packed_color"}, "packed_color is not of type uint"),
        ({b"element chunk 2": b"element chunk 3"}, "has 3 chunks of 256 for 300 splats"),
        ({b"element vertex 300": b"element vertex 200"}, "has 2 chunks of 256 for 200 splats"),
        ({b"element sh 300": b"element sh 299"}, "has SH coefficients for 299 of 300 splats"),
        ({b"f_rest_8": b"f_rest_9"}, "sh has 9 properties f_rest_*, but SH degrees 1-3 have 9, 24, 45"),
        ({b"f_rest_8": b"rest_8"}, "sh has 8 properties f_rest_*, but"),
        ({b"uchar f_rest_8": b"char f_rest_8"}, "sh has properties f_rest_* that are not uchar"),
        ({b"element sh 300": b"element vertex 300"}, "is not a line of a PLY header"),
        (
            {
                b"vertex 300": b"vertex 25600000000",
                b"sh 300": b"sh 25600000000",
                b"chunk 2": b"chunk 100000000",
            },
            "of 100000000 rows of chunk are present",
        ),
        (
            {b"element chunk": b"element a %d\nproperty int b\nelement chunk" % 10**30},
            "more than any file holds",
        ),
        ({b"element chunk": b"element a 1\nproperty list uchar int b\nelement chunk"}, "has the list b"),
        ({b"gsplat_edu up 0.0": b"gsplat_edu up x"}, "is not a direction"),
    ],
)
def test_damage_is_named(tmp_path, changes, message):
    path = tmp_path / "a.compressed.ply"
    write(path, random_scene(300, 3))
    data = path.read_bytes()
    for old, new in changes.items():
        assert old in data
        data = data.replace(old, new, 1)
    path.write_bytes(data)
    assert message in refused(path)


@pytest.mark.parametrize(
    ("place", "value"), [(0, np.nan), (4, np.inf), (8, -np.inf), (10, np.nan), (14, np.inf), (17, -np.inf)]
)
def test_bounds_that_are_not_finite_are_named(tmp_path, place, value):
    path = tmp_path / "a.compressed.ply"
    write(path, random_scene(300, 0))
    data = bytearray(path.read_bytes())
    start = data.index(b"end_header\n") + 11 + 72 + 4 * place
    data[start : start + 4] = np.float32(value).tobytes()
    path.write_bytes(data)
    assert f"chunk 1: {[*XYZ, *SCALES, *RGB][place]} is {np.float64(value)}; " in refused(path)


def test_bounds_beyond_float32_are_named(tmp_path):
    path = tmp_path / "a.compressed.ply"
    vertex = [(name, "u4", values) for name, values in WORDS.items()]
    by_hand(path, {"chunk": chunk_element(BOUNDS | {"max_y": 1e300}, "f8"), "vertex": vertex})
    assert "chunk 0: max_y is 1e+300; " in refused(path)
    # This bound is within float32, but the SH coefficients of such colours are not.
    by_hand(path, {"chunk": chunk_element(BOUNDS | COLORS | {"max_r": 3e38}), "vertex": vertex})
    with pytest.raises(SceneFormatError, match="1 splats have NaN or infinite values"):
        read_scene(path)


def test_a_file_by_supersplat_matches_its_source_and_ours(tmp_path):
    """SuperSplat compressed a PLY, and our compressed file of this PLY has the same numbers."""
    theirs = kept_file("plush_dog/point_cloud_29999_clean.compressed.ply")
    original = Scene(load_ply(kept_file("plush_dog/point_cloud_29999_clean.ply")))
    scene = read(theirs)
    assert (len(scene.gaussians), scene.gaussians.sh_degree) == (15_105, 3)
    check_values(theirs, matched(original.gaussians, scene.gaussians))
    ours = tmp_path / "a.compressed.ply"
    write(ours, original)
    for a, b in zip(parse(ours), parse(theirs), strict=True):
        np.testing.assert_array_equal(a, b)


def test_a_scene_without_sh():
    scene = read(kept_file("formats/biker.compressed.ply"))
    assert (len(scene.gaussians), scene.gaussians.sh_degree) == (152_746, 0)
    assert bool(scene.gaussians.finite_rows().all())


@pytest.mark.parametrize("near", [2_000, 2_048, 2_050])
def test_a_far_sky_does_not_coarsen_the_scene(tmp_path, near):
    """A chunk with splats of both would round the near ones to 600 / 2047 world units."""
    scene, rng = random_scene(near, rest=0), np.random.default_rng(0)
    away = rng.normal(size=(700, 3))
    away = 300.0 * away / np.linalg.norm(away, axis=1, keepdims=True)
    sky = replace(random_scene(700, rest=0).gaussians, means=torch.tensor(away, dtype=torch.float32))
    both = replace(scene, gaussians=type(sky).concatenated([sky, scene.gaussians]))
    errors = {}
    for name, one in (("alone", scene), ("with a sky", both)):
        write(tmp_path / "x.compressed.ply", one)
        found = read(tmp_path / "x.compressed.ply").gaussians.means.numpy()
        distances, _ = cKDTree(found).query(scene.gaussians.means.numpy())
        errors[name] = distances
    assert np.quantile(errors["with a sky"], 0.85) < 1.5 * np.quantile(errors["alone"], 0.85)
    centre = np.linalg.norm(scene.gaussians.means.numpy(), axis=1) < 1.0
    assert errors["with a sky"][centre].max() < 2 * errors["alone"].max()
