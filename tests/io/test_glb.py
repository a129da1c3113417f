"""Binary glTF: a header of twelve bytes, a chunk of JSON and a chunk of numbers."""

import json
import struct
from dataclasses import replace

import numpy as np
import pytest
import torch

from gsplat_edu.base.errors import ArgumentError, SceneFormatError
from gsplat_edu.io import glb
from gsplat_edu.io.axes import half_turned
from gsplat_edu.io.scene import Scene
from gsplat_edu.scene.gaussians import Gaussians, cov3d_t
from gsplat_edu.scene.sh import eval_sh

WIDTHS = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}
PREFIX = "KHR_gaussian_splatting:"


def random_gaussians(count, rest):
    generator = torch.Generator().manual_seed(count + rest)
    shapes = {
        "means": (count, 3),
        "quats": (count, 4),
        "log_scales": (count, 3),
        "sh0": (count, 1, 3),
        "sh_rest": (count, rest, 3),
        "logit_opacities": (count,),
    }
    return Gaussians(**{name: 2 * torch.randn(*shape, generator=generator) for name, shape in shapes.items()})


def parse(path):
    """Parse a file as a viewer does, checking every size and offset."""
    data = path.read_bytes()
    assert struct.unpack_from("<4sII", data) == (b"glTF", 2, len(data))
    size, kind = struct.unpack_from("<I4s", data, 12)
    assert kind == b"JSON" and size % 4 == 0
    text = data[20 : 20 + size]
    document = json.loads(text)
    assert text.rstrip(b" ").endswith(b"}"), "the JSON is padded with spaces"
    if 20 + size == len(data):
        return document, {}
    start = 28 + size
    length, kind = struct.unpack_from("<I4s", data, 20 + size)
    assert kind == b"BIN\0" and length % 4 == 0 and start + length == len(data)
    assert document["buffers"] == [{"byteLength": length}]
    return document, attributes(document, data[start:])


def attributes(document, body):
    arrays, end = {}, 0
    (primitive,) = document["meshes"][0]["primitives"]
    for name, index in primitive["attributes"].items():
        accessor = document["accessors"][index]
        view = document["bufferViews"][accessor["bufferView"]]
        width = WIDTHS[accessor["type"]]
        assert accessor["componentType"] == 5126 and view["target"] == 34962
        assert view["buffer"] == 0 and view["byteOffset"] == end and "byteStride" not in view
        assert view["byteLength"] == 4 * width * accessor["count"]
        end += view["byteLength"]
        numbers = np.frombuffer(body[view["byteOffset"] : end], "<f4")
        arrays[name] = numbers.reshape(accessor["count"], width)
    assert end == len(body)
    return arrays


@pytest.mark.parametrize("count", [1, 2, 1000])
@pytest.mark.parametrize("rest", [0, 3, 8, 15])
def test_stored_values_decode_to_the_parameters(tmp_path, rest, count):
    g = random_gaussians(count, rest)
    glb.write(tmp_path / "new" / "a.glb", Scene(g))
    arrays = parse(tmp_path / "new" / "a.glb")[1]
    x, y, z = g.means.numpy().T
    np.testing.assert_array_equal(arrays["POSITION"], np.stack([x, -y, -z], axis=1))
    # One rounding to float32, 2^-24 of the number, and a margin for the roundings of NumPy and torch.
    scales, opacities = torch.exp(g.log_scales.double()), torch.sigmoid(g.logit_opacities.double())
    np.testing.assert_allclose(arrays[PREFIX + "SCALE"], scales.numpy(), rtol=2**-23)
    np.testing.assert_allclose(arrays[PREFIX + "OPACITY"][:, 0], opacities.numpy(), rtol=2**-23)
    stored = torch.tensor(arrays[PREFIX + "ROTATION"]).double()
    np.testing.assert_allclose(stored.norm(dim=1).numpy(), 1.0, rtol=1e-6)
    degrees = {0: 0, 3: 1, 8: 2, 15: 3}[rest]
    names = [f"{PREFIX}SH_DEGREE_{d}_COEF_{n}" for d in range(degrees + 1) for n in range(2 * d + 1)]
    assert set(arrays) == {"POSITION", *(PREFIX + name for name in ("ROTATION", "SCALE", "OPACITY")), *names}

    # Ellipsoids and view-dependent colours are those of the scene, rotated by half a turn about x.
    H = torch.diag(torch.tensor([1.0, -1.0, -1.0])).double()
    covariances = cov3d_t(g.log_scales.double(), g.quats.double())
    turned = cov3d_t(torch.log(torch.tensor(arrays[PREFIX + "SCALE"]).double()), stored[:, [3, 0, 1, 2]])
    largest = covariances.abs().amax(dim=(1, 2), keepdim=True)
    assert float(((turned - H @ covariances @ H) / largest).abs().max()) <= 1e-6
    direction = np.array([0.36, 0.48, 0.8])
    harmonics = np.stack([arrays[name] for name in names], axis=1).astype(np.float64)
    ours = eval_sh(degrees, g.sh.double().numpy(), np.tile(direction, (count, 1)))
    theirs = eval_sh(degrees, harmonics, np.tile(direction * (1, -1, -1), (count, 1)))
    np.testing.assert_allclose(theirs, ours, atol=1e-12)


def test_the_document_follows_the_extension(tmp_path):
    glb.write(tmp_path / "a.glb", Scene(random_gaussians(9, 3)))
    document, arrays = parse(tmp_path / "a.glb")
    assert document["asset"] == {"version": "2.0", "generator": "gsplat-edu"}
    assert document["extensionsUsed"] == ["KHR_gaussian_splatting"]
    assert "extensionsRequired" not in document
    assert document["scenes"][document["scene"]] == {"nodes": [0]}
    assert document["nodes"] == [{"mesh": 0}], "no transformation, because not every viewer rotates harmonics"
    (primitive,) = document["meshes"][0]["primitives"]
    assert primitive["mode"] == 0
    assert primitive["extensions"]["KHR_gaussian_splatting"] == {
        "kernel": "ellipse",
        "colorSpace": "srgb_rec709_display",
        "projection": "perspective",
        "sortingMethod": "cameraDistance",
    }
    accessor = document["accessors"][primitive["attributes"]["POSITION"]]
    np.testing.assert_array_equal(np.float32(accessor["min"]), arrays["POSITION"].min(axis=0))
    np.testing.assert_array_equal(np.float32(accessor["max"]), arrays["POSITION"].max(axis=0))


@pytest.mark.parametrize(
    ("facts", "extras"),
    [
        ({"antialiased": False}, {"antialiased": False}),
        ({"antialiased": True, "up": (0.0, -1.0, 0.0)}, {"up": [0.0, -1.0, 0.0], "antialiased": True}),
        ({"up": (0.6, 0.0, 0.8)}, {"up": [0.6, 0.0, 0.8]}),
    ],
)
@pytest.mark.parametrize("count", [0, 3])
def test_antialiasing_and_up_are_stored_in_extras(tmp_path, count, facts, extras):
    glb.write(tmp_path / "a.glb", Scene(random_gaussians(count, 0), **facts))
    read = parse(tmp_path / "a.glb")[0]["asset"]["extras"]
    assert json.dumps(read) == json.dumps(extras), "no entry is -0.0"


def test_an_empty_scene_is_a_file_without_a_mesh(tmp_path):
    glb.write(tmp_path / "a.glb", Scene(random_gaussians(0, 15)))
    document, arrays = parse(tmp_path / "a.glb")
    assert not arrays and not {"meshes", "accessors", "bufferViews", "buffers"} & set(document)


def test_the_same_scene_gives_the_same_bytes(tmp_path):
    g = random_gaussians(50, 8)
    glb.write(tmp_path / "a.glb", Scene(g, antialiased=True))
    glb.write(tmp_path / "b.glb", Scene(half_turned(half_turned(g)).trainable(), antialiased=True))
    assert (tmp_path / "a.glb").read_bytes() == (tmp_path / "b.glb").read_bytes()


def test_extreme_values_stay_finite(tmp_path):
    g = random_gaussians(3, 0).map(torch.Tensor.double)
    g.log_scales[:] = torch.tensor([[-800.0], [800.0], [0.0]])
    g.logit_opacities[:] = torch.tensor([-800.0, 800.0, 0.0])
    glb.write(tmp_path / "a.glb", Scene(replace(g, quats=g.quats * torch.tensor([[1e-38], [1e30], [1.0]]))))
    arrays = parse(tmp_path / "a.glb")[1]
    assert all(np.isfinite(array).all() for array in arrays.values())
    assert arrays[PREFIX + "SCALE"][:, 0].tolist() == [0.0, np.exp(np.float32(88.0)), 1.0]
    assert arrays[PREFIX + "OPACITY"][:, 0].tolist() == [0.0, 1.0, 0.5]
    np.testing.assert_allclose(np.linalg.norm(arrays[PREFIX + "ROTATION"], axis=1), 1.0, rtol=1e-6)


def test_refused_scenes_leave_the_old_file(tmp_path):
    path = tmp_path / "a.glb"
    g = random_gaussians(3, 0)
    glb.write(path, Scene(g))
    before = path.read_bytes()
    far = g.map(torch.Tensor.double)
    far.means[1] = 1e300
    for scene, message in (
        (Scene(replace(g, quats=torch.zeros(3, 4))), r"quats\[0\]: has zero length"),
        (Scene(far), r"means\[1, 0\]: is NaN or infinite"),
    ):
        with pytest.raises(ArgumentError, match=message):
            glb.write(path, scene)
    assert path.read_bytes() == before and list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("count", [0, 1, 100])
@pytest.mark.parametrize("rest", [0, 3, 8, 15])
def test_a_round_trip(tmp_path, count, rest):
    g = random_gaussians(count, rest)
    glb.write(tmp_path / "a.glb", Scene(g, True, (0.6, -0.8, 0.0)))
    scene = glb.read(tmp_path / "a.glb")
    assert scene.antialiased is True and scene.up == pytest.approx((0.6, -0.8, 0.0))
    back = scene.gaussians
    assert back.sh_degree == (g.sh_degree if count else 0), "a file without splats stores no degree"
    if not count:
        return
    assert torch.equal(back.means, g.means) and torch.equal(back.sh, g.sh)
    torch.testing.assert_close(back.quats, g.quats / g.quats.norm(dim=1, keepdim=True), rtol=0, atol=2e-7)
    # The scale is rounded to float32 (6e-8, relative), and so is its logarithm, which is at most 7 here.
    torch.testing.assert_close(back.log_scales, g.log_scales, rtol=1e-7, atol=6e-7)
    # Opacities o are off by at most 6e-8 = d, logits by d / (o (1 - o)).
    slack = 6e-8 / (g.opacities * (1 - g.opacities)) + 1e-6
    assert bool(((back.logit_opacities - g.logit_opacities).abs() < slack).all())


def test_opacities_of_zero_and_one_get_finite_logits(tmp_path):
    g = replace(random_gaussians(2, 0), logit_opacities=torch.tensor([400.0, -400.0]))
    glb.write(tmp_path / "a.glb", Scene(g))
    logits = glb.read(tmp_path / "a.glb").gaussians.logit_opacities
    assert 16 < logits[0] < 17 and -17 < logits[1] < -16


def edited(path, change):
    """Rewrite a glTF with its JSON changed."""
    data = path.read_bytes()
    size = struct.unpack_from("<I", data, 12)[0]
    document = json.loads(data[20 : 20 + size])
    change(document)
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    rest = data[20 + size :]
    path.write_bytes(
        struct.pack("<4sIII4s", b"glTF", 2, 20 + len(text) + len(rest), len(text), b"JSON") + text + rest
    )


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda d: d["accessors"][1].update(componentType=5121), "not supported"),
        (lambda d: d["accessors"][1].update(count=10**15), "beyond the file's end"),
        (lambda d: d["accessors"][1].update(count=7.0), "impossible"),
        (lambda d: d["accessors"][1].update(count=4), "different numbers of splats"),
        (lambda d: d["bufferViews"][1].update(byteStride=32), "beyond the file's end"),
        (lambda d: d["bufferViews"][1].update(byteOffset=-4), "impossible"),
        (lambda d: d["meshes"][0]["primitives"][0]["attributes"].pop(PREFIX + "SCALE"), "without KHR"),
        (
            lambda d: d["meshes"][0]["primitives"][0]["attributes"].pop(PREFIX + "SH_DEGREE_0_COEF_0"),
            "colour",
        ),
        (
            lambda d: d["meshes"][0]["primitives"][0]["attributes"].pop(PREFIX + "SH_DEGREE_1_COEF_2"),
            "without KHR",
        ),
        (lambda d: d["meshes"][0]["primitives"][0].pop("extensions"), "no splats"),
        (lambda d: d["asset"].update(extras={"antialiased": "yes"}), "antialiased is"),
        (lambda d: d["asset"].update(extras={"origin": [0, 0]}), "does not describe"),
        (lambda d: d.pop("asset"), "does not describe"),
        (lambda d: d.update(accessors="none"), "does not describe"),
    ],
)
def test_unsupported_documents_are_refused(tmp_path, change, message):
    path = tmp_path / "a.glb"
    glb.write(path, Scene(random_gaussians(5, 3)))
    edited(path, lambda document: None)
    assert len(glb.read(path).gaussians) == 5, "an edited file without a mistake is read"
    edited(path, change)
    with pytest.raises(SceneFormatError, match=message) as caught:
        glb.read(path)
    assert str(path) in str(caught.value)
