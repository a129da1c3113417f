"""Meshes in files: what is written is read back, and files of any program are read or refused in one line."""

import json
import re
import struct

import numpy as np
import pytest
from PIL import Image

import tiers
from gsplat_edu.base.errors import ArgumentError, SceneFormatError
from gsplat_edu.io.mesh_files import MESH_FORMATS, mesh_format_of, mesh_losses, read_mesh, write_mesh
from gsplat_edu.io.mesh_glb import linear, write_parts
from gsplat_edu.scene.earth import Earth
from gsplat_edu.scene.mesh import Mesh, Texture

pytestmark = pytest.mark.fuzz

SUFFIXES = [found.suffix for found in MESH_FORMATS if found.reader]
SEEDS = range(tiers.SEED, tiers.SEED + tiers.count("GSPLAT_EDU_FUZZ", 150, 20_000))
WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}
KINDS = {5123: "<u2", 5125: "<u4", 5126: "<f4"}


def some_mesh(colors=False, texture=False, float32=True, count=40):
    """A random mesh that uses all its vertices. Its colours have 8 bits."""
    rng = np.random.default_rng(count)
    vertices = rng.normal(size=(count, 3))
    if float32:
        vertices = vertices.astype(np.float32).astype(np.float64)
    faces = np.concatenate([np.arange(count // 3 * 3), np.arange(count - 3, count)]).reshape(-1, 3)
    shades = (rng.integers(0, 256, (count, 3)) / 255).astype(np.float32) if colors else None
    image = None
    if texture:
        uvs = rng.random((len(faces), 3, 2), dtype=np.float32)
        image = Texture(rng.integers(0, 256, (16, 32, 3), dtype=np.uint8), uvs)
    return Mesh(vertices, faces, shades, image)


def chunks(path):
    """Check a GLB as its specification asks, and return its JSON and the values of each accessor."""
    data = path.read_bytes()
    assert struct.unpack_from("<4sII", data) == (b"glTF", 2, len(data)) and len(data) % 4 == 0
    size, kind = struct.unpack_from("<I4s", data, 12)
    assert kind == b"JSON" and size % 4 == 0
    document = json.loads(data[20 : 20 + size])
    length, kind = struct.unpack_from("<I4s", data, 20 + size)
    body = data[28 + size :]
    assert kind == b"BIN\0" and length % 4 == 0 and length == len(body)
    assert document["buffers"] == [{"byteLength": length}]
    end = 0
    for view in document["bufferViews"]:
        assert end <= view["byteOffset"] < end + 4 and view["byteOffset"] % 4 == 0
        end = view["byteOffset"] + view["byteLength"]
    assert end <= length
    values = []
    for accessor in document["accessors"]:
        view = document["bufferViews"][accessor["bufferView"]]
        width, dtype = WIDTHS[accessor["type"]], np.dtype(KINDS[accessor["componentType"]])
        row = width * dtype.itemsize
        assert view["byteLength"] == accessor["count"] * row
        assert row % 4 == 0 or view["target"] == 34963
        found = np.frombuffer(body, dtype, accessor["count"] * width, view["byteOffset"])
        values.append(found.reshape(-1, width))
    return document, values, body


@pytest.mark.parametrize("suffix", SUFFIXES)
@pytest.mark.parametrize("extra", ["nothing", "colors", "texture"])
def test_what_is_written_is_read_back(tmp_path, suffix, extra):
    mesh = some_mesh(**({} if extra == "nothing" else {extra: True}))
    path = tmp_path / "deep" / f"a mesh{suffix}"
    write_mesh(path, mesh)
    first = path.read_bytes()
    write_mesh(path, mesh)
    assert path.read_bytes() == first
    found = read_mesh(path)
    assert np.array_equal(found.vertices, mesh.vertices) and np.array_equal(found.faces, mesh.faces)
    if extra == "colors":
        assert np.array_equal(np.rint(255 * found.colors), np.rint(255 * mesh.colors))
        assert suffix == ".glb" or np.array_equal(found.colors, mesh.colors)
    assert (found.colors is None) == (extra != "colors")
    stored = extra == "texture" and suffix != ".ply"
    assert (found.texture is not None) == stored
    assert mesh_losses(path, mesh) == (
        [f"{path}: PLY cannot store the texture; write a .glb or .obj"]
        if extra == "texture" and not stored
        else []
    )
    if stored:
        assert np.array_equal(found.texture.uvs, mesh.texture.uvs)
        assert np.array_equal(found.texture.image, mesh.texture.image)
    assert not [file for file in path.parent.iterdir() if file.name.startswith(".")]


def test_text_and_ply_keep_doubles_and_gltf_keeps_float32_relative_to_an_origin(tmp_path):
    far = some_mesh(float32=False)
    far = Mesh(far.vertices + 4e6, far.faces)
    for suffix in (".ply", ".obj"):
        write_mesh(tmp_path / f"far{suffix}", far)
        assert np.array_equal(read_mesh(tmp_path / f"far{suffix}").vertices, far.vertices)
        assert mesh_losses(f"far{suffix}", far) == []
    write_mesh(tmp_path / "far.glb", far, up=(0.0, 0.6, 0.8))
    found = read_mesh(tmp_path / "far.glb").vertices
    # float32 rounds coordinates below 8 to 2^-22; double rounds the turned sum with 4e6 to 2^-30, a few times
    assert np.abs(found - far.vertices).max() < 2**-21
    assert not np.array_equal(far.vertices.astype(np.float32), far.vertices), "float32 alone rounds to 0.25"
    both = some_mesh(colors=True, texture=True)
    assert "multiply" in mesh_losses("x.glb", both)[0] and mesh_losses("x.obj", both) == []


def test_gltf_is_turned_and_in_metres(tmp_path):
    mesh = Mesh(np.array([[0.0, -100, 0], [200, 0, 0], [0, 0, 300]]), np.array([[0, 1, 2]]))
    write_mesh(tmp_path / "known.glb", mesh, "cm")
    document, values, _ = chunks(tmp_path / "known.glb")
    assert document["asset"]["extras"] == {"unit": "m"}
    assert np.allclose(values[0], [[0, 1, 0], [2, 0, 0], [0, 0, -3]])
    normal = mesh.face_normals()[0] * [1, -1, -1]
    assert np.allclose(values[1], normal / np.linalg.norm(normal))
    assert np.allclose(read_mesh(tmp_path / "known.glb").vertices, mesh.vertices / 100)
    assert np.allclose(read_mesh(tmp_path / "known.glb", "mm").vertices, mesh.vertices * 10)
    write_mesh(tmp_path / "unknown.glb", mesh)
    assert np.array_equal(read_mesh(tmp_path / "unknown.glb", "mm").vertices, mesh.vertices)
    for suffix in (".ply", ".obj"):
        write_mesh(tmp_path / f"known{suffix}", mesh, "cm")
        assert np.array_equal(read_mesh(tmp_path / f"known{suffix}").vertices, mesh.vertices)
        assert np.allclose(read_mesh(tmp_path / f"known{suffix}", "m").vertices, mesh.vertices / 100)


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_a_mesh_says_where_on_earth_it_is(tmp_path, suffix):
    """A GLB is in metres, so that its place on earth is that of these."""
    mesh, earth = some_mesh(), Earth.at_place(47.0, 8.0, 400.0, np.diag([0.01, 0.01, 0.01]))
    path = tmp_path / f"a{suffix}"
    write_mesh(path, mesh, "cm", up=(0.0, 0.0, 1.0), earth=earth)
    found = mesh_format_of(path).read(path)
    assert found.unit == ("m" if suffix == ".glb" else "cm")
    for before, after in zip(mesh.vertices, found.mesh.vertices, strict=True):
        np.testing.assert_allclose(
            found.earth.rows @ [*after, 1], earth.rows @ [*before, 1], rtol=0, atol=1e-7
        )
    write_mesh(path, mesh, "cm")
    assert mesh_format_of(path).read(path).earth is None


def test_parts_of_a_collider_say_where_on_earth_they_are(tmp_path):
    earth = Earth.at_place(47.0, 8.0, 400.0)
    write_parts(tmp_path / "a.glb", [("one", some_mesh())], "m", (0.0, 0.0, 1.0), earth)
    assert mesh_format_of("a.glb").read(tmp_path / "a.glb").earth == earth


def test_a_damaged_place_on_earth_is_refused_in_one_line(tmp_path):
    mesh, earth = some_mesh(), Earth.at_place(47.0, 8.0, 400.0)
    for suffix in SUFFIXES:
        path = tmp_path / f"a{suffix}"
        write_mesh(path, mesh, earth=earth)
        path.write_bytes(path.read_bytes().replace(b"EPSG:4978", b"EPSG 4978"))
        with pytest.raises(SceneFormatError, match="place on earth") as caught:
            read_mesh(path)
        assert "\n" not in str(caught.value) and str(path) in str(caught.value)


@pytest.mark.parametrize("count", [9, 70_000])
def test_gltf_keeps_its_rules(tmp_path, count):
    """Bounds of positions, normals of length 1, a type of indices that is wide enough, linear colours."""
    mesh = some_mesh(colors=True, count=count)
    write_mesh(tmp_path / "a.glb", mesh)
    document, (points, normals, colors, corners), _ = chunks(tmp_path / "a.glb")
    (primitive,) = document["meshes"][0]["primitives"]
    assert primitive["attributes"] == {"POSITION": 0, "NORMAL": 1, "COLOR_0": 2}
    accessors = document["accessors"]
    assert np.array_equal(np.float32(accessors[0]["min"]), points.min(axis=0))
    assert np.array_equal(np.float32(accessors[0]["max"]), points.max(axis=0))
    assert np.allclose(np.linalg.norm(normals, axis=1), 1, atol=1e-6)
    assert accessors[2]["normalized"] is True and accessors[2]["componentType"] == 5123
    assert np.abs(colors[:, :3] / 65535 - linear(mesh.colors)).max() < 1e-5 and (colors[:, 3] == 65535).all()
    assert accessors[3]["componentType"] == (5123 if count < 65535 else 5125)
    assert corners.max() == count - 1
    assert document["extensionsUsed"] == ["KHR_materials_unlit"]


def test_eight_linear_bits_would_merge_dark_colours():
    levels = linear(np.arange(256) / 255)
    assert len(np.unique(np.rint(255 * levels))) == 183 and len(np.unique(np.rint(65535 * levels))) == 256


def test_a_texture_is_embedded(tmp_path):
    mesh = some_mesh(texture=True, colors=True)
    for jpeg, kind, start in ((None, "image/png", b"\x89PNG"), (90, "image/jpeg", b"\xff\xd8")):
        write_mesh(tmp_path / "a.glb", mesh, jpeg=jpeg)
        document, values, body = chunks(tmp_path / "a.glb")
        assert document["images"][0]["mimeType"] == kind
        view = document["bufferViews"][document["images"][0]["bufferView"]]
        assert body[view["byteOffset"] :].startswith(start)
        assert "COLOR_0" not in document["meshes"][0]["primitives"][0]["attributes"]
        assert values[2].shape == (mesh.faces.size, 2)


def test_a_vertex_at_a_seam_is_repeated_and_joined_again(tmp_path):
    square = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    uvs = square[faces][..., :2].astype(np.float32)
    uvs[1, 0] = 0.5
    mesh = Mesh(square, faces, None, Texture(np.zeros((4, 4, 3), np.uint8), uvs))
    write_mesh(tmp_path / "a.glb", mesh)
    assert len(chunks(tmp_path / "a.glb")[1][0]) == 5
    found = read_mesh(tmp_path / "a.glb")
    assert np.array_equal(found.vertices, square) and np.array_equal(found.texture.uvs, uvs)


def test_an_obj_and_its_files_appear_together(tmp_path, monkeypatch):
    write_mesh(tmp_path / "a b#c.obj", some_mesh(texture=True))
    assert sorted(file.name for file in tmp_path.iterdir()) == ["a b#c.obj", "a_b_c.mtl", "a_b_c.png"]
    before = {file: file.read_bytes() for file in tmp_path.iterdir()}

    def full(self, file, *_, **__):
        file.write_bytes(b"half")
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Image.Image, "save", full)
    with pytest.raises(OSError, match="No space"):
        write_mesh(tmp_path / "a b#c.obj", some_mesh(texture=True, count=9))
    assert {file: file.read_bytes() for file in tmp_path.iterdir()} == before


SQUARE = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\n"


@pytest.mark.parametrize(
    ("text", "faces"),
    [
        (SQUARE + "f 1 2 3 4\n", [[0, 1, 2], [0, 2, 3]]),
        (SQUARE + "f -4 -3 -2\n", [[0, 1, 2]]),
        ("v 0 0 0 # one\r\n# two\r\nv 1 0 0\r\n\r\nv 1 1 0\r\nf 1/1/1 2//2 3/3\r\nvt 0 0\r\n", [[0, 1, 2]]),
        ("v 0 0 0\nv 1 0 0\nv 1 1 0\nf 1 \\\n 2 \\\n 3\n", [[0, 1, 2]]),
        ("f 1 2 3\nv 0 0 0 1\nv 1 0 0 1\nv 1 1 0 1\n", [[0, 1, 2]]),
        ("o x\ng y\ns off\nvn 0 0 1\nl 1 2\n" + SQUARE + "f 1//1 2//1 3//1\n", [[0, 1, 2]]),
        # concave: the diagonal from the first corner lies outside
        ("v 0 0 0\nv 1 1 0\nv 0 3 0\nv -1 1 0\nv 0 1.8 0\nf 2 3 4 5\n", [[1, 2, 4], [2, 3, 4]]),
    ],
)
def test_obj_files_of_other_programs(tmp_path, text, faces):
    path = tmp_path / "a.obj"
    path.write_bytes(text.encode())
    assert read_mesh(path).faces.tolist() == faces


PLY = "ply\nformat ascii 1.0\nelement vertex {}\nproperty float x\nproperty float y\nproperty float z\n"
FACES = "element face {}\nproperty list uchar int vertex_index\nend_header\n"


def test_concave_and_bent_polygons_keep_their_area(tmp_path):
    star = [
        (np.cos(a) * r, np.sin(a) * r) for a, r in zip(np.arange(10) * np.pi / 5, [2, 0.7] * 5, strict=True)
    ]
    area = 0.5 * abs(sum(a[0] * b[1] - a[1] * b[0] for a, b in zip(star, star[1:] + star[:1], strict=True)))
    lines = PLY.format(10) + FACES.format(1) + "".join(f"{x} {y} 0\n" for x, y in star[1:] + star[:1])
    (tmp_path / "a.ply").write_text(lines + "10 0 1 2 3 4 5 6 7 8 9\n")
    mesh = read_mesh(tmp_path / "a.ply")
    normals = mesh.face_normals()
    assert len(mesh.faces) == 8 and (normals[:, 2] > 0).all()
    assert normals[:, 2].sum() / 2 == pytest.approx(area, rel=1e-9)


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("mixed", [False, True])
def test_binary_ply_files_of_other_programs(tmp_path, order, mixed):
    """Another byte order, other number types, further elements and properties, polygons of several sizes."""
    name = {"<": "little", ">": "big"}[order]
    header = (
        f"ply\r\nformat binary_{name}_endian 1.0\r\ncomment x\r\nelement camera 1\r\nproperty double f\r\n"
        "element vertex 5\r\nproperty short y\r\nproperty int x\r\nproperty ushort red\r\nproperty ushort green\r\n"
        "property ushort blue\r\nproperty double z\r\nelement face 2\r\nproperty uchar flag\r\n"
        "property list uint ushort vertex_indices\r\nproperty list uchar float texcoord\r\nend_header\r\n"
    )
    points = [(0, 0, 0), (2, 0, 0), (2, 2, 0), (0, 2, 0), (1, 3, 0.5)]
    body = struct.pack(order + "d", 50.0)
    for x, y, z in points:
        body += struct.pack(order + "hiHHHd", y, x, 65535, 0, 13107, z)
    polygons = [(0, 1, 2, 3), (2, 4, 3)] if mixed else [(0, 1, 2), (2, 4, 3)]
    for corners in polygons:
        body += struct.pack(f"{order}BI{len(corners)}HB2f", 7, len(corners), *corners, 2, 0.5, 0.25)
    (tmp_path / "a.ply").write_bytes(header.encode() + body)
    mesh = read_mesh(tmp_path / "a.ply")
    assert np.array_equal(mesh.vertices, points)
    assert mesh.faces.tolist() == ([[0, 1, 2], [0, 2, 3]] if mixed else [[0, 1, 2]]) + [[2, 4, 3]]
    assert np.allclose(mesh.colors, [[1, 0, 0.2]] * 5)
    for cut in (1, 12, 40):
        (tmp_path / "a.ply").write_bytes((header.encode() + body)[:-cut])
        with pytest.raises(SceneFormatError, match=r"truncated: \d of [25] rows of"):
            read_mesh(tmp_path / "a.ply")


TRIANGLE = "0 0 0\n1 0 0\n0 1 0\n"


@pytest.mark.parametrize(
    ("suffix", "text", "words"),
    [
        (".obj", "v 0,5 0 0\n", "line 1: '0,5' has a decimal comma"),
        (".obj", SQUARE + "f 1 2\n", "line 5: the face has 2 corners"),
        (".obj", SQUARE + "f 1 2 9\n", "line 5: the face names vertex 8, but there are 4"),
        (".obj", SQUARE + "f -5 2 3\n", "line 5: names number -5, but there are 4 so far"),
        (".obj", SQUARE + "f 0 2 3\n", "line 5: names number 0"),
        (".obj", SQUARE + "f a 2 3\n", "line 5: 'a' is not a corner"),
        (".obj", SQUARE + "f 1 2 3" + " 1" * 400, "has 403 corners"),
        (".obj", SQUARE, "has no faces"),
        (".obj", "hello\n", "has no vertices; it is no OBJ"),
        (".obj", "v 1 2\n", "line 1: a vertex of 2 numbers"),
        (".obj", SQUARE + "v 0 nan 0\nf 1 2 3\n", r"line 5: the vertex is at \(0, nan, 0\)"),
        (".obj", "version https://git-lfs\n", "git lfs pull"),
        (".ply", PLY.format(3) + FACES.format(1) + TRIANGLE + "3 0 1 3\n", "face 0 names vertex 3, but there are 3"),
        (".ply", PLY.format(3) + FACES.format(1) + TRIANGLE + "3 0 1 -1\n", "face 0 names vertex -1"),
        (".ply", PLY.format(3) + FACES.format(1) + TRIANGLE + "2 0 1\n", "face 0 has 2 corners"),
        (".ply", PLY.format(3) + FACES.format(1) + TRIANGLE + "4 0 1 2\n", "line 13: is too short for a face"),
        (".ply", PLY.format(3) + FACES.format(1) + TRIANGLE + "3 0 1 2 3\n", "line 13: has 5 numbers"),
        (".ply", PLY.format(3) + FACES.format(2) + TRIANGLE + "3 0 1 2\n", "truncated: 1 of 2 rows of face"),
        (".ply", PLY.format(3) + FACES.format(1) + TRIANGLE.replace("1 0", "1,5 0"), "line 11: '1,5' has a decimal"),
        (".ply", PLY.format(3) + FACES.format(1) + TRIANGLE.replace("1 0", "inf 0") + "3 0 1 2\n", "vertex 1 is at"),
        (".ply", PLY.format(3) + FACES.format(0) + TRIANGLE, "has no faces"),
        (".ply", PLY.format(3) + "end_header\n" + TRIANGLE, "has no faces"),
        (".ply", "ply\nformat ascii 1.0\nelement face 1\nend_header\n", "has no vertices with x, y and z"),
        (".ply", "solid\n", "not a PLY"),
        (".glb", "solid\n", "is not a binary glTF"),
    ],
)  # fmt: skip
def test_what_is_wrong_is_said_in_one_line(tmp_path, suffix, text, words):
    path = tmp_path / f"wrong{suffix}"
    path.write_text(text)
    with pytest.raises(SceneFormatError, match=words) as caught:
        read_mesh(path)
    assert str(path) in str(caught.value) and "\n" not in str(caught.value)


def glb_of(tmp_path, change, body=None):
    """Write a GLB, change its JSON, and return its path."""
    path = tmp_path / "a.glb"
    write_mesh(path, some_mesh(colors=True))
    document, _, stored = chunks(path)
    change(document)
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    body = stored if body is None else body
    parts = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(body), b"BIN\0") + body
    path.write_bytes(struct.pack("<4sII", b"glTF", 2, 12 + len(parts)) + parts)
    return path


def test_nodes_move_and_mirror_their_meshes(tmp_path):
    def change(document):
        half = np.sqrt(0.5)
        document["nodes"] = [
            {"children": [2, 1], "translation": [10, 0, 0]},
            {"mesh": 0, "matrix": [2, 0, 0, 0, 0, 2, 0, 0, 0, 0, 2, 0, 0, 0, 0, 1]},
            {"mesh": 0, "rotation": [0, 0, half, half], "scale": [-1, 1, 1]},
        ]
        document["asset"]["generator"] = "another program"

    plain = some_mesh()
    mesh = read_mesh(glb_of(tmp_path, change))
    x, y, z = (plain.vertices * [1, -1, -1]).T
    count = len(x)
    assert np.allclose(mesh.vertices[:count] * [1, -1, -1], np.stack([10 - y, -x, z], axis=1))
    assert np.allclose(mesh.vertices[count:] * [1, -1, -1], np.stack([10 + 2 * x, 2 * y, 2 * z], axis=1))
    assert np.array_equal(mesh.faces[: len(plain.faces)], plain.faces[:, ::-1])
    assert np.allclose(read_mesh(tmp_path / "a.glb", "mm").vertices, 1000 * mesh.vertices)


@pytest.mark.parametrize(
    ("words", "change"),
    [
        ("needs the extension KHR_draco", lambda d: d.update(extensionsRequired=["KHR_draco_mesh_compression"])),
        ("does not exist, or has two parents", lambda d: d["nodes"][0].update(children=[0])),
        ("nodes|node 7", lambda d: d["scenes"][0].update(nodes=[7])),
        ("mode 0, not of triangles", lambda d: d["meshes"][0]["primitives"][0].update(mode=0)),
        ("beyond the file's end", lambda d: d["accessors"][0].update(count=10**9)),
        ("offset that is impossible", lambda d: d["bufferViews"][0].update(byteOffset=-4)),
        ("type that is not supported", lambda d: d["accessors"][3].update(componentType=5126)),
        ("in another file", lambda d: d["buffers"][0].update(uri="a.bin")),
        (r"names accessors\[99\]", lambda d: d["meshes"][0]["primitives"][0].update(indices=99)),
        ("different numbers", lambda d: d["accessors"][2].update(count=3)),
        ("no mesh of triangles", lambda d: d.update(nodes=[{}])),
        ("more than 64 times", lambda d: d["meshes"][0].update(primitives=d["meshes"][0]["primitives"] * 2000)),
        ("does not describe", lambda d: d["meshes"][0].update(primitives=3)),
        ("no position", lambda d: d["nodes"][0].update(scale=[1e300, 1, 1])),
    ],
)  # fmt: skip
def test_a_gltf_that_is_wrong_or_not_supported(tmp_path, words, change):
    path = glb_of(tmp_path, change)
    with pytest.raises(SceneFormatError, match=words) as caught:
        read_mesh(path)
    assert str(path) in str(caught.value) and "\n" not in str(caught.value)


def test_a_texture_elsewhere_is_not_followed(tmp_path):
    path = tmp_path / "deep" / "a.obj"
    write_mesh(path, some_mesh(texture=True))
    assert read_mesh(path).texture is not None
    (tmp_path / "a.png").write_bytes((path.parent / "a.png").read_bytes())
    for name in ("../a.png", "/etc/hostname", "gone.png"):
        (path.parent / "a.mtl").write_text(f"newmtl textured\nmap_Kd {name}\n")
        assert read_mesh(path).texture is None
    (path.parent / "a.mtl").write_text("newmtl textured\nmap_Kd a.obj\n")
    with pytest.raises(SceneFormatError, match=r"a\.obj: the image on it cannot be decoded"):
        read_mesh(path)


@pytest.mark.parametrize(
    ("words", "call"),
    [
        ("unknown mesh format; known are .glb, .ply, .obj", lambda p: mesh_format_of(p / "a.stl")),
        ("no faces", lambda p: write_mesh(p / "a.ply", Mesh(np.zeros((1, 3)), np.zeros((0, 3), np.int64)))),
        ("unit: is 'inch'", lambda p: write_mesh(p / "a.ply", some_mesh(), "inch")),
        ("unit: is 'inch'", lambda p: read_mesh(p / "a.ply", "inch")),
        ("jpeg: is 100", lambda p: write_mesh(p / "a.glb", some_mesh(), jpeg=100)),
        ("beyond float32", lambda p: write_mesh(p / "a.glb", Mesh(np.eye(3) * 1e200, np.array([[0, 1, 2]])))),
    ],
)
def test_wrong_calls_are_named(tmp_path, words, call):
    with pytest.raises(ArgumentError, match=re.escape(words)):
        call(tmp_path)
    assert not list(tmp_path.iterdir())
