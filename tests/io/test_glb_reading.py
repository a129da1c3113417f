"""Splats of binary glTFs of other programs, as the ratified KHR_gaussian_splatting allows them."""

import json
import struct

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from gsplat_edu.base.errors import SceneFormatError
from gsplat_edu.io.formats import read_scene, write_scene
from gsplat_edu.io.lod import tiles
from gsplat_edu.io.scene import Scene
from gsplat_edu.scene.gaussians import Gaussians, cov3d_t
from gsplat_edu.scene.sh import eval_sh

PREFIX = "KHR_gaussian_splatting:"
KINDS = {"i1": 5120, "u1": 5121, "i2": 5122, "u2": 5123, "f4": 5126}
TYPES = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}
TURN = np.diag([1.0, -1.0, -1.0])
"""From glTF's axes to this package's."""


def values(count=4, seed=0, degree=1):
    """Attributes of random splats: the numbers that a reader has to see, in float64."""
    rng = np.random.default_rng(seed)
    quats = rng.normal(size=(count, 4))
    found = {
        "POSITION": rng.normal(size=(count, 3)),
        PREFIX + "ROTATION": quats / np.linalg.norm(quats, axis=1, keepdims=True),
        PREFIX + "SCALE": rng.uniform(0.1, 1.0, (count, 3)),
        PREFIX + "OPACITY": rng.uniform(0.1, 0.9, (count, 1)),
    }
    for d in range(degree + 1):
        for k in range(2 * d + 1):
            found[f"{PREFIX}SH_DEGREE_{d}_COEF_{k}"] = rng.normal(size=(count, 3))
    return found


@pytest.mark.parametrize(
    ("nodes", "roots", "named"),
    [
        (b"{}" + b",{}" * (1 << 18), b"0", "262,145 nodes, and at most"),
        (b"{}", b"0" + b",0" * 999, "two parents"),
    ],
)
def test_more_nodes_than_a_file_may_have_are_refused_before_their_transforms(tmp_path, nodes, roots, named):
    text = b'{"asset":{"version":"2.0"},"nodes":[%b],"scenes":[{"nodes":[%b]}]}' % (nodes, roots)
    text += b" " * (-len(text) % 4)
    header = struct.pack("<4sIII4s", b"glTF", 2, 20 + len(text), len(text), b"JSON")
    (tmp_path / "a.glb").write_bytes(header + text)
    with pytest.raises(SceneFormatError, match=named):
        read_scene(tmp_path / "a.glb")


class Builder:
    """A glTF that is put together piece by piece."""

    def __init__(self):
        self.body = b""
        self.document = {
            "asset": {"version": "2.0", "generator": "somebody else"},
            "extensionsUsed": ["KHR_gaussian_splatting"],
            "scene": 0,
            "scenes": [{"nodes": [0]}],
            "nodes": [{"mesh": 0}],
            "meshes": [],
            "accessors": [],
            "bufferViews": [],
        }

    def accessor(self, array, kind="f4", normalized=False, stride=None, offset=0):
        """Store the numbers of an accessor as they are."""
        array = np.asarray(array)
        stored = array.astype("<" + kind)
        row = stored.itemsize * stored.shape[1]
        step = stride or row
        raw = np.full((len(stored), step), 0x5A, np.uint8)
        raw[:, offset : offset + row] = np.frombuffer(stored.tobytes(), np.uint8).reshape(len(stored), row)
        view = {"buffer": 0, "byteOffset": len(self.body), "byteLength": raw.size}
        if stride:
            view["byteStride"] = stride
        self.body += raw.tobytes() + bytes(-raw.size % 4)
        self.document["bufferViews"].append(view)
        entry = {"bufferView": len(self.document["bufferViews"]) - 1, "componentType": KINDS[kind]}
        entry |= {"count": len(stored), "type": TYPES[stored.shape[1]]}
        entry |= {"normalized": True} if normalized else {}
        entry |= {"byteOffset": offset} if offset else {}
        self.document["accessors"].append(entry)
        return len(self.document["accessors"]) - 1

    def primitive(self, attributes, **extension):
        kind = {"kernel": "ellipse", "colorSpace": "srgb_rec709_display", **extension}
        return {"attributes": attributes, "mode": 0, "extensions": {"KHR_gaussian_splatting": kind}}

    def splats(self, given, **extension):
        return self.primitive({name: self.accessor(array) for name, array in given.items()}, **extension)

    def mesh(self, *primitives):
        self.document["meshes"].append({"primitives": list(primitives)})
        return self

    def save(self, path):
        self.document["buffers"] = [{"byteLength": len(self.body)}]
        text = json.dumps(self.document).encode()
        text += b" " * (-len(text) % 4)
        length = 28 + len(text) + len(self.body)
        path.write_bytes(
            struct.pack("<4sIII4s", b"glTF", 2, length, len(text), b"JSON")
            + text + struct.pack("<I4s", len(self.body), b"BIN\0") + self.body
        )  # fmt: skip
        return path


def assert_shows(scene, parts, atol=1e-6):
    """Compare a scene with attributes, each with the linear map and the shift of its node, by what they look like."""
    g = scene.gaussians.map(torch.Tensor.double)
    means, shapes, colors, opacities = [], [], [], []
    rays = Rotation.random(6, random_state=1).apply([0.0, 0.0, 1.0])  # in this package's axes
    for given, A, t in parts:
        means.append((given["POSITION"] @ A.T + t) @ TURN)
        frames = (
            Rotation.from_quat(given[PREFIX + "ROTATION"]).as_matrix() * given[PREFIX + "SCALE"][:, None, :]
        )
        moved = TURN @ A @ frames
        shapes.append(moved @ moved.transpose(0, 2, 1))
        names = [name for name in given if "SH_DEGREE" in name]
        degree = round(len(names) ** 0.5) - 1
        harmonics = np.stack([given[name] for name in names], axis=1)
        # a colour seen along a ray in the world is the one along the ray turned back into the node
        back = rays @ TURN @ (A / np.cbrt(np.linalg.det(A)))
        colors.append(
            np.stack([eval_sh(degree, harmonics, np.tile(ray, (len(harmonics), 1))) for ray in back], axis=1)
        )
        opacities.append(given[PREFIX + "OPACITY"][:, 0])
    np.testing.assert_allclose(g.means, np.concatenate(means), atol=atol)
    np.testing.assert_allclose(cov3d_t(g.log_scales, g.quats), np.concatenate(shapes), atol=4 * atol)
    np.testing.assert_allclose(g.opacities, np.concatenate(opacities), atol=atol)
    sh = torch.cat([g.sh0, g.sh_rest], dim=1).numpy()
    shown = np.stack([eval_sh(g.sh_degree, sh, np.tile(ray, (len(sh), 1))) for ray in rays], axis=1)
    np.testing.assert_allclose(shown, np.concatenate(colors), atol=4 * atol)


STILL = (np.eye(3), np.zeros(3))


def quantized(array, kind, normalized):
    """Return the stored integers of an array, and the numbers that they stand for."""
    most = np.iinfo(kind).max if normalized else 1
    stored = np.round(array * most) if normalized else np.ceil(array * 3)
    return stored, stored / most


@pytest.mark.parametrize(
    ("name", "kind", "normalized"),
    [
        ("ROTATION", "i1", True),
        ("ROTATION", "i2", True),
        ("SCALE", "u1", False),
        ("SCALE", "u1", True),
        ("SCALE", "u2", False),
        ("SCALE", "u2", True),
        ("OPACITY", "u1", True),
        ("OPACITY", "u2", True),
        ("POSITION", "i2", False),
        ("POSITION", "u2", True),
    ],
)
def test_integers_that_the_extension_allows(tmp_path, name, kind, normalized):
    given, file = values(), Builder()
    full = name if name == "POSITION" else PREFIX + name
    if kind.startswith("u"):
        given[full] = np.abs(given[full])
    stored, given[full] = quantized(np.clip(given[full], -1, 1), kind, normalized)
    attributes = {key: file.accessor(array) for key, array in given.items() if key != full}
    file.mesh(file.primitive(attributes | {full: file.accessor(stored, kind, normalized)}))
    scene = read_scene(file.save(tmp_path / "a.glb"))
    if name == "ROTATION":  # a rounded quaternion is not of unit length; its direction is the rotation
        given[full] = given[full] / np.linalg.norm(given[full], axis=1, keepdims=True)
    assert_shows(scene, [(given, *STILL)])


@pytest.mark.parametrize(
    ("name", "kind", "normalized"),
    [
        ("ROTATION", "u1", True),
        ("ROTATION", "i1", False),
        ("SCALE", "i1", True),
        ("OPACITY", "u1", False),
        ("OPACITY", "i1", True),
        ("SH_DEGREE_0_COEF_0", "u1", True),
    ],
)
def test_integers_that_it_does_not_allow_are_named(tmp_path, name, kind, normalized):
    given, file = values(), Builder()
    attributes = {key: file.accessor(array) for key, array in given.items()}
    attributes[PREFIX + name] = file.accessor(np.ones_like(given[PREFIX + name]), kind, normalized)
    with pytest.raises(SceneFormatError, match=f"not supported in {PREFIX}{name}"):
        read_scene(file.mesh(file.primitive(attributes)).save(tmp_path / "a.glb"))


def test_strides_offsets_and_further_attributes(tmp_path):
    given, file = values(), Builder()
    attributes = {name: file.accessor(array, stride=24, offset=8) for name, array in given.items()}
    attributes["COLOR_0"] = file.accessor(np.full((4, 4), 200), "u1", True)
    attributes["_ID"] = file.accessor(np.full((4, 1), 7), "u2")
    attributes["_NAN"] = file.accessor(np.full((4, 1), np.nan))
    scene = read_scene(file.mesh(file.primitive(attributes)).save(tmp_path / "a.glb"))
    assert_shows(scene, [(given, *STILL)])


def test_interleaved_attributes(tmp_path):
    """All attributes share one view, 100 bytes a splat."""
    given, file = values(degree=0), Builder()
    table, at, attributes = np.zeros((4, 100), np.uint8), 0, {}
    for name, array in given.items():
        raw = array.astype("<f4")
        table[:, at : at + raw[0].nbytes] = raw.view(np.uint8).reshape(4, -1)
        file.document["accessors"].append(
            {
                "bufferView": 0,
                "byteOffset": at,
                "componentType": 5126,
                "count": 4,
                "type": TYPES[array.shape[1]],
            }
        )
        attributes[name] = len(attributes)
        at += raw[0].nbytes
    file.body = table.tobytes()
    file.document["bufferViews"] = [{"buffer": 0, "byteLength": 400, "byteStride": 100}]
    assert_shows(
        read_scene(file.mesh(file.primitive(attributes)).save(tmp_path / "a.glb")), [(given, *STILL)]
    )


def test_nodes_move_their_splats(tmp_path):
    """A hierarchy of a matrix above translation, rotation and scale; a mesh shown twice; an identity matrix."""
    one, two = values(3, seed=1, degree=3), values(2, seed=2, degree=1)
    file = Builder()
    file.mesh(file.splats(one)).mesh(file.splats(two), {"attributes": {}, "mode": 4}).mesh(
        file.splats(values(5))
    )
    R, Q = (Rotation.from_rotvec(v).as_matrix() for v in ([0.3, -0.7, 0.2], [1.1, 0.4, -0.5]))
    outer = np.eye(4)
    outer[:3, :3], outer[:3, 3] = 2.0 * R, (1.0, 2.0, 3.0)
    quat = Rotation.from_matrix(Q).as_quat()
    file.document["scenes"] = [{"nodes": [4]}, {"nodes": [0]}]
    file.document["scene"] = 1
    file.document["nodes"] = [
        {"matrix": outer.T.ravel().tolist(), "children": [1, 2]},
        {"mesh": 0, "translation": [0.5, -1.0, 4.0], "rotation": quat.tolist(), "scale": [1.5, 1.5, 1.5]},
        {"mesh": 1, "matrix": np.eye(4).ravel().tolist(), "children": [3]},
        {"mesh": 0, "scale": [0.5, 0.5, 0.5]},
        {"mesh": 2},
    ]
    scene = read_scene(file.save(tmp_path / "a.glb"))
    A, t = outer[:3, :3], outer[:3, 3]
    padded = two | {
        f"{PREFIX}SH_DEGREE_{d}_COEF_{k}": np.zeros((2, 3)) for d in (2, 3) for k in range(2 * d + 1)
    }
    parts = [(one, A @ (1.5 * Q), A @ (0.5, -1.0, 4.0) + t), (padded, A, t), (one, 0.5 * A, t)]
    assert_shows(scene, parts, atol=2e-6 * 10)


def test_no_rounding_of_a_node_that_does_not_move(tmp_path):
    given, file = values(), Builder()
    file.mesh(file.splats(given))
    plain = read_scene(file.save(tmp_path / "a.glb")).gaussians
    file.document["nodes"] = [{"mesh": 0, "matrix": np.eye(4).ravel().tolist()}]
    for name, tensor in read_scene(file.save(tmp_path / "b.glb")).gaussians.tensors().items():
        assert torch.equal(tensor, plain.tensors()[name]), name


@pytest.mark.parametrize(
    ("node", "fault"),
    [
        ({"scale": [1, 2, 1]}, "scales non-uniformly"),
        ({"scale": [-1, 1, 1]}, "mirrors"),
        ({"scale": [0, 0, 0]}, "is singular"),
        ({"matrix": [1, 0, 0, 0, 0.5, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]}, "shears"),
        ({"matrix": [1, 0, 0, 0.1, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]}, "last row"),
        ({"scale": [1e300, 1e300, 1e300]}, "absurdly large"),
        ({"translation": [float("nan"), 0, 0]}, "absurdly large"),
    ],
)
def test_transforms_that_splats_cannot_follow_are_refused_by_name(tmp_path, node, fault):
    file = Builder()
    file.mesh(file.splats(values()))
    file.document["nodes"] = [{"mesh": 0, **node}]
    with pytest.raises(SceneFormatError, match=fault) as caught:
        read_scene(file.save(tmp_path / "a.glb"))
    assert "\n" not in str(caught.value)


def test_transforms_that_overflow_together_are_refused_without_a_warning(tmp_path):
    file = Builder()
    file.mesh(file.splats(values()))
    huge = {"scale": [1e200] * 3, "rotation": [1e200] * 4}
    file.document["nodes"] = [
        {**huge, "children": [1]},
        {**huge, "children": [2]},
        {"mesh": 0, "scale": [0, 0, 0]},
    ]
    with pytest.raises(SceneFormatError, match="NaN, infinite or absurdly large"):
        read_scene(file.save(tmp_path / "a.glb"))


@pytest.mark.parametrize(
    ("change", "fault"),
    [
        (lambda d, kind: kind.update(colorSpace="lin_rec709_display"), "colorSpace lin_rec709_display"),
        (lambda d, kind: kind.update(kernel="custom"), "kernel custom"),
        (
            lambda d, kind: d.update(extensionsRequired=["EXT_meshopt_compression"]),
            "needs the extension EXT_meshopt",
        ),
        (
            lambda d, kind: d["nodes"].append({"children": [0]}) or d["scenes"][0]["nodes"].append(1),
            "two parents",
        ),
        (lambda d, kind: d.update(nodes=[{"mesh": 5}]), r"names meshes\[5\]"),
        (lambda d, kind: d.update(nodes=[{}]), "no node of its scene shows its splats"),
        (lambda d, kind: d["bufferViews"][0].update(byteStride=4), "impossible in POSITION"),
        (lambda d, kind: d["accessors"][0].update(byteOffset=10**9), "beyond the file's end in POSITION"),
        (lambda d, kind: d["accessors"][0].update(count=-1), "impossible in POSITION"),
    ],
)
def test_what_cannot_be_read_is_named(tmp_path, change, fault):
    file = Builder()
    file.mesh(file.splats(values()))
    kind = file.document["meshes"][0]["primitives"][0]["extensions"]["KHR_gaussian_splatting"]
    change(file.document, kind)
    with pytest.raises(SceneFormatError, match=fault):
        read_scene(file.save(tmp_path / "a.glb"))


def test_a_small_file_cannot_show_its_splats_a_million_times(tmp_path):
    file = Builder()
    file.mesh(*[file.splats(values(1, degree=0))] * 1000)
    file.document["nodes"] = [{"mesh": 0} for _ in range(1000)]
    file.document["scenes"] = [{"nodes": list(range(1000))}]
    with pytest.raises(SceneFormatError, match="shows its splats more than 64 times"):
        read_scene(file.save(tmp_path / "a.glb"))


def test_our_tiles_are_read(tmp_path):
    """A tile is an SPZ in a GLB: reading it gives what reading the SPZ alone gives, moved by the node if it moves."""
    generator = torch.Generator().manual_seed(0)
    shapes = [(50, 3), (50, 4), (50, 3), (50, 1, 3), (50, 8, 3), (50,)]
    parts = [torch.randn(*shape, generator=generator) for shape in shapes]
    scene = Scene(Gaussians(*parts[:4], 0.2 * parts[4], parts[5]), antialiased=True)
    (tmp_path / "tile.glb").write_bytes(tiles.glb(scene))
    tile = read_scene(tmp_path / "tile.glb")
    assert tile.antialiased is True and len(tile.gaussians) == 50 and tile.gaussians.sh_degree == 2
    # SPZ has positions in steps of 2^-12, log scales in 1 / 16, opacities and harmonics in bytes
    torch.testing.assert_close(tile.gaussians.means, scene.gaussians.means, rtol=0, atol=2**-12)
    torch.testing.assert_close(tile.gaussians.log_scales, scene.gaussians.log_scales, rtol=0, atol=1 / 16)
    torch.testing.assert_close(tile.gaussians.opacities, scene.gaussians.opacities, rtol=0, atol=1 / 255)
    torch.testing.assert_close(tile.gaussians.sh_rest, scene.gaussians.sh_rest, rtol=0, atol=0.1)


@pytest.mark.parametrize(
    "name", ["KHR_gaussian_splatting_compression_spz", "KHR_spz_gaussian_splats_compression"]
)
def test_older_drafts_of_spz_are_read_alike(tmp_path, name):
    """The first one stands at the primitive and has neither kernel nor colour space."""
    generator = torch.Generator().manual_seed(0)
    shapes = [(50, 3), (50, 4), (50, 3), (50, 1, 3), (50, 8, 3), (50,)]
    scene = Scene(Gaussians(*(torch.randn(*shape, generator=generator) for shape in shapes)))
    data = tiles.glb(scene)
    (tmp_path / "new.glb").write_bytes(data)
    size = int.from_bytes(data[12:16], "little")
    document = json.loads(data[20 : 20 + size])
    (primitive,) = document["meshes"][0]["primitives"]
    base = primitive["extensions"].pop("KHR_gaussian_splatting")
    (packed,) = base.pop("extensions").values()
    alone = name.startswith("KHR_spz")
    kinds = {name: packed} if alone else {"KHR_gaussian_splatting": {**base, "extensions": {name: packed}}}
    primitive["extensions"] = kinds
    document["extensionsUsed"] = document["extensionsRequired"] = [*kinds, *([] if alone else [name])]
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    parts = [len(text).to_bytes(4, "little"), b"JSON", text, data[20 + size :]]
    body = b"".join(parts)
    (tmp_path / "old.glb").write_bytes(data[:8] + (12 + len(body)).to_bytes(4, "little") + body)
    new, old = (read_scene(tmp_path / f"{kind}.glb").gaussians.tensors() for kind in ("new", "old"))
    assert all(torch.equal(tensor, old[name]) for name, tensor in new.items())


def test_files_of_splat_transform_are_turned_about_z(tmp_path):
    """It turns a PLY's (x, y, z) to (-x, -y, z), `Transform.PLY` in its source, with rotations and harmonics."""
    given, file = values(degree=3), Builder()
    file.mesh(file.splats(given))
    file.document["asset"]["generator"] = "splat-transform 2.7.1"
    scene = read_scene(file.save(tmp_path / "a.glb"))
    np.testing.assert_allclose(scene.gaussians.means, given["POSITION"] * (-1, -1, 1), atol=1e-6)
    # assert_shows turns about x, so that what is left is half a turn about y
    assert_shows(scene, [(given, np.diag([-1.0, 1.0, -1.0]), np.zeros(3))])


def test_splats_that_a_node_takes_beyond_float32_are_refused(tmp_path):
    given, file = values(), Builder()
    given["POSITION"][0, 0] = 1e38
    file.mesh(file.splats(given))
    file.document["nodes"] = [{"mesh": 0, "scale": [10, 10, 10]}]
    with pytest.raises(SceneFormatError, match="beyond float32"):
        read_scene(file.save(tmp_path / "a.glb"))


def test_a_scene_written_and_read_keeps_its_bits(tmp_path):
    generator = torch.Generator().manual_seed(0)
    shapes = [(9, 3), (9, 4), (9, 3), (9, 1, 3), (9, 15, 3), (9,)]
    scene = Scene(Gaussians(*(torch.randn(*shape, generator=generator) for shape in shapes)))
    write_scene(tmp_path / "a.glb", scene)
    back = read_scene(tmp_path / "a.glb").gaussians
    assert torch.equal(back.means, scene.gaussians.means) and torch.equal(
        back.sh_rest, scene.gaussians.sh_rest
    )
