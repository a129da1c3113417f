import tracemalloc

import numpy as np
import pytest
import torch

from gsplat_edu.base import headroom, ply_table
from gsplat_edu.base.errors import NotEnoughMemoryError, SceneFormatError, ShapeError
from gsplat_edu.io import ply
from gsplat_edu.io.formats import read_scene, write_scene
from gsplat_edu.io.ply import load_ply, read, save_ply, write
from gsplat_edu.io.scene import Scene
from gsplat_edu.scene.gaussians import Gaussians
from scene_files import kept_file, refused


def random_gaussians(count, rest):
    generator = torch.Generator().manual_seed(0)
    shapes = {
        "means": (count, 3),
        "quats": (count, 4),
        "log_scales": (count, 3),
        "sh0": (count, 1, 3),
        "sh_rest": (count, rest, 3),
        "logit_opacities": (count,),
    }
    return Gaussians(**{name: torch.randn(*shape, generator=generator) for name, shape in shapes.items()})


def parse(path):
    """Read the file as a viewer does, by the names in its header."""
    header, body = path.read_bytes().split(b"end_header\n", 1)
    lines = header.decode("ascii").splitlines()
    assert lines[:2] == ["ply", "format binary_little_endian 1.0"]
    count = int(lines[2].removeprefix("element vertex "))
    names = [line.removeprefix("property float ") for line in lines[3:]]
    table = np.frombuffer(body, dtype=[(name, "<f4") for name in names])
    assert len(table) == count
    return names, table


@pytest.mark.parametrize("rest", [0, 3, 8, 15])
def test_properties_have_inrias_names_and_order(tmp_path, rest):
    gaussians = random_gaussians(7, rest)
    save_ply(tmp_path / "new" / "scene.ply", gaussians)
    names, table = parse(tmp_path / "new" / "scene.ply")
    expected = ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"]
    expected += [f"f_rest_{i}" for i in range(3 * rest)]
    expected += ["opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]
    assert names == expected

    np.testing.assert_array_equal(table["y"], gaussians.means[:, 1].numpy())
    np.testing.assert_array_equal(table["ny"], 0)
    np.testing.assert_array_equal(table["f_dc_2"], gaussians.sh0[:, 0, 2].numpy())
    np.testing.assert_array_equal(table["opacity"], gaussians.logit_opacities.numpy())
    np.testing.assert_array_equal(table["scale_1"], gaussians.log_scales[:, 1].numpy())
    np.testing.assert_array_equal(table["rot_0"], gaussians.quats[:, 0].numpy())
    for channel in range(3):
        for k in range(rest):
            values = table[f"f_rest_{channel * rest + k}"]
            np.testing.assert_array_equal(values, gaussians.sh_rest[:, k, channel].numpy())


def test_a_failed_write_leaves_the_old_file(tmp_path):
    resource = pytest.importorskip("resource", reason="Windows has no limit on the size of files")
    path = tmp_path / "scene.ply"
    save_ply(path, random_gaussians(2, 0))
    before = path.read_bytes()

    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (400, limits[1]))  # the header fits, the rows do not
    try:
        with pytest.raises(OSError, match="too large"):
            save_ply(path, random_gaussians(5, 15))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path], "no temporary file is left"


def assert_equal(a, b):
    for name, tensor in a.tensors().items():
        other = b.tensors()[name]
        assert other.dtype == torch.float32 and other.is_contiguous(), name
        np.testing.assert_array_equal(
            tensor.numpy().view(np.uint32), other.numpy().view(np.uint32), err_msg=name
        )


@pytest.mark.parametrize("count", [0, 1, 9])
@pytest.mark.parametrize("rest", [0, 3, 8, 15])
def test_a_round_trip_is_exact_to_the_bit(tmp_path, rest, count):
    gaussians = random_gaussians(count, rest)
    if count:
        gaussians.means[0, 1] = -0.0
    save_ply(tmp_path / "a.ply", gaussians)
    assert_equal(gaussians, load_ply(str(tmp_path / "a.ply")))


def test_an_origin_is_stored_in_a_comment(tmp_path):
    gaussians = random_gaussians(5, 0)
    save_ply(tmp_path / "plain.ply", gaussians)
    save_ply(tmp_path / "zero.ply", gaussians, (0, 0, 0))
    assert (tmp_path / "plain.ply").read_bytes() == (tmp_path / "zero.ply").read_bytes()

    origin = (1234.5678, -0.1, 3e5)
    save_ply(tmp_path / "moved.ply", gaussians, origin)
    assert b"comment gsplat_edu origin 1234.5678 -0.1 300000.0\n" in (tmp_path / "moved.ply").read_bytes()
    scene = read(tmp_path / "moved.ply")
    assert scene.origin == origin and torch.equal(scene.gaussians.means, gaussians.means)
    with pytest.raises(ShapeError, match="origin"):
        save_ply(tmp_path / "moved.ply", gaussians, (1, 2))


@pytest.mark.parametrize("words", ["1 2", "a b c", "nan 0 0", "1e31 0 0", "0 0 0 0"])
def test_a_malformed_origin_is_refused(tmp_path, words):
    save_ply(tmp_path / "a.ply", random_gaussians(2, 0), (7.0, 0.0, 0.0))
    data = (tmp_path / "a.ply").read_bytes().replace(b"origin 7.0 0.0 0.0", f"origin {words}".encode())
    (tmp_path / "a.ply").write_bytes(data)
    assert "is not an origin" in refused(tmp_path / "a.ply")


def written(path, table, form="binary_little_endian", newline="\n", before=b"", extra_header=()):
    """Write a structured table as a PLY in the given format."""
    kinds = {"f4": "float", "f8": "double", "u1": "uchar", "i4": "int32"}
    lines = ["ply", f"format {form} 1.0", "comment made by hand", "obj_info none", *extra_header]
    lines += [f"element vertex {len(table)}"]
    lines += [f"property {kinds[table.dtype[name].str[1:]]} {name}" for name in table.dtype.names]
    lines += ["element face 1", "property list uchar int vertex_indices", "end_header", ""]
    if form == "ascii":
        rows = "".join(" ".join(repr(v.item()) for v in row) + newline for row in table)
        body = rows.encode() + b"3 0 0 0\n"
    else:
        order = ">" if form == "binary_big_endian" else "<"
        body = before + table.astype(table.dtype.newbyteorder(order)).tobytes() + b"\x03" + bytes(12)
    path.write_bytes(newline.join(lines).encode() + body)


def shuffled_table(gaussians, kind="f4", more=()):
    """Return the columns of a scene without normals, in random order, between unknown columns."""
    columns = {
        **{n: gaussians.means[:, i] for i, n in enumerate("xyz")},
        **{f"rot_{i}": gaussians.quats[:, i] for i in range(4)},
        **{f"scale_{i}": gaussians.log_scales[:, i] for i in range(3)},
        **{f"f_dc_{i}": gaussians.sh0[:, 0, i] for i in range(3)},
        "opacity": gaussians.logit_opacities,
    }
    rest = gaussians.sh_rest.shape[1]
    columns |= {f"f_rest_{c * rest + k}": gaussians.sh_rest[:, k, c] for c in range(3) for k in range(rest)}
    names = [str(name) for name in np.random.default_rng(1).permutation(list(columns))]
    fields = [("red", "u1"), *((name, kind) for name in names), *((name, "f8") for name in more)]
    table = np.zeros(len(gaussians), dtype=fields)
    table["red"] = 200
    for name in names:
        table[name] = columns[name].numpy()
    return table


@pytest.mark.parametrize("newline", ["\n", "\r\n"])
@pytest.mark.parametrize("kind", ["f4", "f8"])
@pytest.mark.parametrize("form", ["ascii", "binary_little_endian", "binary_big_endian"])
def test_any_property_order_byte_order_and_unknown_properties_are_read(tmp_path, form, kind, newline):
    """ASCII is lossless too, because it has the shortest decimal that is read back as the same number."""
    gaussians = random_gaussians(6, 8)
    written(tmp_path / "a.ply", shuffled_table(gaussians, kind, more=("segment",)), form, newline)
    assert_equal(gaussians, load_ply(tmp_path / "a.ply"))


def test_an_element_before_the_vertices_is_skipped(tmp_path):
    gaussians = random_gaussians(3, 0)
    header = ("element camera 2", "property double f", "property uchar id")
    written(tmp_path / "b.ply", shuffled_table(gaussians), before=bytes(18), extra_header=header)
    assert_equal(gaussians, load_ply(tmp_path / "b.ply"))


@pytest.mark.parametrize("form", ["ascii", "binary_little_endian"])
def test_absurd_counts_allocate_nothing(tmp_path, form):
    path = tmp_path / "a.ply"
    written(path, shuffled_table(random_gaussians(3, 0)), form)
    whole = path.read_bytes()
    for count in (10**10, 10**30):
        path.write_bytes(whole.replace(b"element vertex 3", b"element vertex %d" % count))
        message = refused(path)
        assert "truncated" in message or "rows of vertex" in message or "more than any file holds" in message
    chunk = b"element chunk %d\nproperty int a\nelement vertex 3" % 10**30
    path.write_bytes(whole.replace(b"element vertex 3", chunk))
    assert "element chunk of" in refused(path)


@pytest.mark.parametrize("form", ["ascii", "binary_big_endian"])
@pytest.mark.parametrize(("value", "text"), [(np.nan, "nan"), (-np.inf, "-inf"), (1e300, "inf")])
def test_values_that_are_not_finite_are_named(tmp_path, form, value, text):
    table = shuffled_table(random_gaussians(5, 3), "f8", more=("unused",))
    table["unused"] = np.nan  # this property is not read
    table["scale_1"][3] = value
    written(tmp_path / "a.ply", table, form)
    assert f"vertex 3: scale_1 is {text} (1 such vertices in all)" in refused(tmp_path / "a.ply")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ((b"ply\n", b"PK\x03\x04\n"), "is not a PLY: its first line is not 'ply'"),
        ((b"ply\n", b"version https://git-lfs.github.com/spec/v1\n"), "is a Git LFS pointer"),
        (
            (b"format binary_little_endian", b"format text"),
            "line 2: 'format text 1.0' is not a line of a PLY header",
        ),
        ((b"format binary_little_endian 1.0", b"comment"), "its header names no format"),
        ((b"element vertex 3", b"element vertex -3"), "'element vertex -3' is not a line"),
        ((b"element vertex 3", b"element point 3"), "is a PLY without vertices"),
        ((b"element vertex 3", b"comment"), "belongs to no element"),
        ((b"property float x\n", b"property real x\n"), "'property real x' is not a line"),
        ((b"property float x\n", b"property float y\n"), "property y appears twice"),
        ((b"property float x\n", b"property list uchar int x\n"), "has the list x"),
        (
            (b"property float opacity", b"property float transparency"),
            "is not a splat scene: lacks opacity; export",
        ),
        (
            (b"property float f_rest_8", b"property float f_rest_9"),
            "has 9 properties f_rest_*, but SH degrees",
        ),
        (
            (b"property float f_rest_8", b"property float rest"),
            "has 8 properties f_rest_*, but SH",
        ),
        ((b"end_header", b"comment" + b" long" * 2000), "is not a line of a PLY header"),
        ((b"end_header\n", b"comment\n" * 11000), "no end_header in 10000 lines"),
    ],
)
def test_damage_is_named(tmp_path, change, message):
    path = tmp_path / "a.ply"
    written(path, shuffled_table(random_gaussians(3, 3)))
    whole = path.read_bytes()
    assert change[0] in whole
    path.write_bytes(whole.replace(*change, 1))
    assert message in refused(path)


@pytest.mark.parametrize(("old", "new"), [(b" 200", b" two"), (b"200 ", b""), (b"200 ", b"1 200 ")])
def test_malformed_ascii_rows_are_refused(tmp_path, old, new):
    path = tmp_path / "a.ply"
    written(path, shuffled_table(random_gaussians(3, 0)), "ascii")
    header, body = path.read_bytes().split(b"end_header\n")
    body = body.replace(b"200 ", b"1.0 200 ", 1) if old == b" 200" else body
    path.write_bytes(header + b"end_header\n" + body.replace(old, new, 1))
    assert "rows of vertex" in refused(path)


def test_a_trained_scene_from_another_program():
    gaussians = load_ply(kept_file("plush_dog/point_cloud_29999_clean.ply"))
    assert (len(gaussians), gaussians.sh_degree) == (15_105, 3)
    assert float(gaussians.quats.norm(dim=1).min()) >= 0.36 and float(gaussians.logit_opacities.max()) == 400


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("odd/lfs_pointer_point_cloud.ply", "is a Git LFS pointer"),
        ("odd/no_colour_value_weight.ply", "is not a splat scene: lacks f_dc_0, f_dc_1, f_dc_2, opacity;"),
        ("formats/ply_beetle/beetle.ascii.ply", "is a mesh, not a splat scene: lacks f_dc_0"),
        ("formats/ply_beetle/beetle.binary.ply", "is a mesh, not a splat scene: lacks f_dc_0"),
        ("fox/points3D_aligned_derived.ply", "is a point cloud, not a splat scene: lacks f_dc_0"),
    ],
)
def test_real_files_that_are_not_scenes_are_refused(name, message):
    assert message in refused(kept_file(name))


@pytest.mark.parametrize("antialiased", [None, False, True])
@pytest.mark.parametrize("up", [None, (0.0, -1.0, 0.0), (0.6, 0.0, 0.8)])
def test_antialiasing_and_up_are_kept_in_comments(tmp_path, antialiased, up):
    path = tmp_path / "scene.ply"
    write(path, Scene(random_gaussians(3, 3), antialiased, up))
    scene = read(path)
    assert scene.antialiased is antialiased
    assert scene.up == (None if up is None else pytest.approx(up, abs=1e-15))
    assert_equal(scene.gaussians, random_gaussians(3, 3))


@pytest.mark.parametrize(
    ("lines", "antialiased"),
    [
        (["SplatRenderMode: mip"], True),  # Brush
        (["Exported from Brush", "SH degree: 3", "SplatRenderMode: default"], False),
        (["antialiased 1"], True),  # Postshot
        (["antialiased 0"], False),
        (["gsplat_edu antialiased 1"], True),  # older versions of this package
        (["  SPLATRENDERMODE:  MIP  "], True),
        (["antialiased 1", "SplatRenderMode: default"], False),  # the last comment wins
        (["SplatRenderMode: default", "antialiased 1"], True),
        (["SplatRenderMode: 2dgs"], None),
        (["antialiased 2", "antialiased", "antialiased 1 2", "not antialiased 1"], None),
        ([], None),
    ],
)
@pytest.mark.parametrize("suffix", [".ply", ".compressed.ply"])
def test_antialiasing_comments_of_other_programs_are_read(tmp_path, suffix, lines, antialiased):
    path = tmp_path / f"scene{suffix}"
    write_scene(path, Scene(random_gaussians(3, 3)))
    comment = "".join(f"comment {line}\n" for line in lines).encode()
    path.write_bytes(path.read_bytes().replace(b"element", comment + b"element", 1))
    assert read_scene(path).antialiased is antialiased


@pytest.mark.parametrize("suffix", [".ply", ".compressed.ply"])
@pytest.mark.parametrize(
    ("antialiased", "lines"),
    [
        (True, [b"comment SplatRenderMode: mip", b"comment antialiased 1"]),
        (False, [b"comment SplatRenderMode: default", b"comment antialiased 0"]),
        (None, []),
    ],
)
def test_antialiasing_is_written_as_other_programs_read_it(tmp_path, suffix, antialiased, lines):
    path = tmp_path / f"scene{suffix}"
    write_scene(path, Scene(random_gaussians(3, 3), antialiased))
    header = path.read_bytes().partition(b"end_header\n")[0]
    assert [line for line in header.splitlines() if line.startswith(b"comment")] == lines


@pytest.mark.parametrize("up", ["up 1 2", "up a b c", "up 0 0 0", "up nan 0 0", "up inf 0 0"])
def test_a_malformed_up_comment_is_refused(tmp_path, up):
    path = tmp_path / "scene.ply"
    save_ply(path, random_gaussians(1, 0))
    data = path.read_bytes().replace(b"element", f"comment gsplat_edu {up}\nelement".encode(), 1)
    path.write_bytes(data)
    with pytest.raises(SceneFormatError, match="is not a direction"):
        read(path)
    path.write_bytes(data.replace(b"comment gsplat_edu", b"comment another"))
    assert read(path).up is None


def test_infinite_logits_become_opaque_or_transparent(tmp_path):
    """Programs that store opacities in bytes write infinite logits for 0 and 1."""
    path = tmp_path / "scene.ply"
    save_ply(path, random_gaussians(3, 0))
    data = bytearray(path.read_bytes())
    rows = np.frombuffer(data, "<f4", offset=data.index(b"end_header\n") + 11).reshape(3, 17)
    rows[:2, 9] = np.inf, -np.inf
    path.write_bytes(data)
    gaussians = load_ply(path)
    assert gaussians.opacities[:2].tolist() == [1.0, pytest.approx(0.0, abs=1e-30)]
    assert gaussians.logit_opacities[2] == random_gaussians(3, 0).logit_opacities[2]
    rows[2, 9] = np.nan
    path.write_bytes(data)
    with pytest.raises(SceneFormatError, match="vertex 2: opacity is nan"):
        load_ply(path)


@pytest.mark.parametrize("count", [0, 3, 6, 7])
def test_writing_in_several_blocks_gives_the_same_file(tmp_path, monkeypatch, count):
    gaussians, origin = random_gaussians(count, 8), (1e6, -2.0, 0.1)
    save_ply(tmp_path / "one.ply", gaussians, origin)
    one = load_ply(tmp_path / "one.ply")
    monkeypatch.setattr(ply, "BLOCK", 3)
    monkeypatch.setattr(ply_table, "BLOCK", 3)
    save_ply(tmp_path / "many.ply", gaussians, origin)
    assert (tmp_path / "many.ply").read_bytes() == (tmp_path / "one.ply").read_bytes()
    for name, tensor in load_ply(tmp_path / "one.ply").tensors().items():
        assert torch.equal(tensor, one.tensors()[name]), name


def test_values_that_are_not_finite_are_counted_over_all_blocks(tmp_path, monkeypatch):
    monkeypatch.setattr(ply_table, "BLOCK", 2)
    table = shuffled_table(random_gaussians(9, 3), "f4")
    table["f_dc_1"][4], table["rot_2"][8] = np.nan, np.inf
    written(tmp_path / "a.ply", table, "binary_little_endian")
    assert "vertex 4: f_dc_1 is nan (2 such vertices in all)" in refused(tmp_path / "a.ply")


def test_opening_a_scene_takes_little_more_than_its_parameters(tmp_path):
    """Besides the parameters, reading holds blocks of rows, of columns and of float64 means; three copies of all
    would take 140 MiB."""
    save_ply(tmp_path / "large.ply", random_gaussians(200_000, 15))
    rows = tmp_path / "large.ply"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(ply_table, "BLOCK", 10_000)
        tracemalloc.start()
        read(rows)
        most = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
    assert most < 1.25 * 200_000 * 59 * 4


def test_a_digit_and_a_space_become_eight_bytes_of_memory(tmp_path, monkeypatch):
    path, names = tmp_path / "a.ply", shuffled_table(random_gaussians(1, 0)).dtype.names
    header = ["ply", "format ascii 1.0", "element vertex 1000", *(f"property float {name}" for name in names)]
    path.write_text("\n".join([*header, "end_header", *1_000 * [" ".join("1" * len(names))], ""]))
    monkeypatch.setattr(headroom, "WORTH_ASKING", 0)
    memory = [5 * path.stat().st_size, 3 * path.stat().st_size]
    monkeypatch.setattr(headroom, "available_memory", lambda: memory[-1])
    with pytest.raises(NotEnoughMemoryError, match="needs .* of memory"):
        read(path)
    memory.pop()
    assert len(read(path).gaussians) == 1_000
