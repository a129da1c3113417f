"""Spark, in Chromium, reads what we write with the same values, and we the RAD of all its encodings."""

import base64
import json
import struct
import zlib
from pathlib import Path

import numpy as np
import pytest
import torch

from browsers import chromium
from gsplat_edu.base.constants import C0
from gsplat_edu.io.formats import read_scene, write_scene
from gsplat_edu.io.rad import IN_CHUNK
from scene_files import matched, random_scene, refused

NPM = Path(__file__).parents[1] / "npm" / "node_modules"

SITE = "http://spark.test/"

PAGE = """<!doctype html>
<script type="importmap">
{"imports": {"three": "/three/build/three.module.js", "three/addons/": "/three/examples/jsm/"}}
</script>
<script type="module">globalThis.spark = await import("/@sparkjsdev/spark/dist/spark.module.js");</script>
"""

READ = """async ([bytes, fileName]) => {
  const fileBytes = Uint8Array.from(atob(bytes), (c) => c.charCodeAt(0));
  const splats = new spark.PackedSplats({ fileBytes, fileName });
  await splats.initialized;
  const found = [];
  splats.forEachSplat((i, center, scales, quat, opacity, color) =>
    found.push([...center, ...scales, quat.w, quat.x, quat.y, quat.z, opacity, ...color]),
  );
  return { found, degree: splats.getNumSh() };
}"""


@pytest.fixture(scope="module")
def spark():
    """Return a function that reads a file with Spark: its splats as rows, and their SH degree."""
    if not (NPM / "@sparkjsdev" / "spark").is_dir():
        pytest.skip("spark is not installed: npm ci --prefix tests/npm")

    def answer(route):
        path = route.request.url.removeprefix(SITE)
        if not path:
            route.fulfill(body=PAGE, content_type="text/html")
        elif (NPM / path).is_file():
            route.fulfill(path=NPM / path, content_type="text/javascript")
        else:
            route.fulfill(status=404)

    with chromium() as tabs:
        tab = tabs.new_page()
        tab.route(f"{SITE}**", answer)
        tab.goto(SITE)
        tab.wait_for_function("globalThis.spark !== undefined")

        def read(path):
            told = tab.evaluate(READ, [base64.b64encode(path.read_bytes()).decode(), path.name])
            return np.array(told["found"]), told["degree"]

        yield read


@pytest.mark.parametrize("name", ["a.ply", "a.compressed.ply", "a.splat", "a.ksplat", "a.sog", "a.rad"])
def test_it_reads_what_we_write(tmp_path, spark, name):
    """It packs a splat into 16 bytes: positions as halves, 8 bits a logarithm of a scale, a colour and an opacity."""
    write_scene(tmp_path / name, random_scene(400))
    rows, degree = spark(tmp_path / name)
    ours = read_scene(tmp_path / name).gaussians
    assert len(rows) == len(ours) and degree == ours.sh_degree
    np.testing.assert_allclose(rows[:, :3], ours.means.numpy(), rtol=2.0**-11, atol=1e-6)
    assert np.abs(np.log(rows[:, 3:6]) - ours.log_scales.numpy()).max() <= 21 / 254 / 2 + 1e-3
    turns = torch.nn.functional.normalize(ours.quats, dim=1).numpy()
    assert np.abs((rows[:, 6:10] * turns).sum(axis=1)).min() >= 1 - 5e-4
    assert np.abs(rows[:, 10] - ours.opacities.numpy()).max() <= 0.75 / 255
    colors = (C0 * ours.sh0[:, 0] + 0.5).clamp(0, 1).numpy()
    assert np.abs(rows[:, 11:] - colors).max() <= 0.75 / 255


def test_it_refuses_version_4_of_spz(tmp_path, spark):
    """docs/FORMATS.md says so; if this fails, it no longer does."""
    write_scene(tmp_path / "a.spz", random_scene(4))
    with pytest.raises(Exception, match="Invalid gzip header"):
        spark(tmp_path / "a.spz")


def with_json(magic, value):
    text = json.dumps(value).encode()
    return magic + struct.pack("<I", len(text)) + text + bytes(-len(text) % 8)


def rad_file(properties, count, *, degree=1, **header):
    """Return a RAD of one chunk, from each property's name, encoding, further fields and bytes."""
    payload, listed = b"", []
    for name, encoding, further, data in properties:
        packed = zlib.compress(data, wbits=-15)
        place = {"offset": len(payload), "bytes": len(packed), "compression": "gz"}
        listed.append({"property": name, "encoding": encoding, **place, **further})
        payload += packed + bytes(-len(packed) % 8)
    known = {"version": 1, "count": count, "maxSh": degree}
    chunk = {**known, "base": 0, "payloadBytes": len(payload), "properties": listed}
    chunk |= {"lodTree": True} if header.get("lodTree") else {}
    body = with_json(b"RADC", chunk) + struct.pack("<Q", len(payload)) + payload
    where = [{"offset": 0, "bytes": len(body)}]
    about = {**known, "type": "gsplat", "chunkSize": IN_CHUNK, "allChunkBytes": len(body), "chunks": where}
    return with_json(b"RAD0", about | header) + body


def quantized(count=50, seed=0):
    """Return bytes of splats as Spark's converter writes them, and the values that they stand for."""
    draw = np.random.default_rng(seed)

    def planes(width, low=0):
        return draw.integers(low, 256, (count, width), dtype=np.uint8)

    centers, alpha, rgb, scales = (
        draw.normal(size=(count, 3)).astype("<f2"),
        planes(1),
        planes(3),
        planes(3, 100),
    )
    turns, sh1 = planes(3), planes(9)
    unit = turns[:, :2] / 255 * 2 - 1
    z = 1 - np.abs(unit).sum(axis=1)
    folded = np.where((z < 0)[:, None], (1 - np.abs(unit[:, ::-1])) * np.where(unit >= 0, 1, -1), unit)
    axis = np.column_stack([folded, z])
    half = turns[:, 2] / 255 * np.pi / 2
    quats = np.column_stack(
        [np.cos(half), np.sin(half)[:, None] * axis / np.linalg.norm(axis, axis=1)[:, None]]
    )
    differences = np.diff(rgb, axis=0, prepend=np.zeros((1, 3), np.uint8))
    properties = [
        ("center", "f16_lebytes", {}, centers.T.copy().view(np.uint8).reshape(-1, 2).T.tobytes()),
        ("alpha", "r8", {"min": 0.0, "max": 1.0}, alpha.T.tobytes()),
        ("rgb", "r8_delta", {"min": 0.0, "max": 1.0}, differences.T.tobytes()),
        ("scales", "ln_0r8", {"min": -12.0, "max": 9.0}, scales.T.tobytes()),
        ("orientation", "oct88r8", {}, turns.tobytes()),
        ("sh1", "s8", {"min": -1.0, "max": 1.0}, sh1.T.tobytes()),
    ]
    values = {
        "means": centers.astype(float),
        "opacities": alpha[:, 0] / 255,
        "colors": rgb / 255,
        "log_scales": (scales - 1.0) / 254 * 21 - 12,
        "quats": quats,
        "sh_rest": (sh1.view(np.int8) / 127).reshape(count, 3, 3),
    }
    return properties, values


def check(gaussians, values):
    np.testing.assert_allclose(gaussians.means, values["means"], atol=1e-6)
    np.testing.assert_allclose(gaussians.opacities, values["opacities"], atol=1e-6)
    np.testing.assert_allclose(C0 * gaussians.sh0[:, 0] + 0.5, values["colors"], atol=1e-6)
    np.testing.assert_allclose(gaussians.log_scales, values["log_scales"], atol=1e-5)
    np.testing.assert_allclose(gaussians.sh_rest, values["sh_rest"], atol=1e-6)
    turns = np.abs((gaussians.quats.double().numpy() * values["quats"]).sum(axis=1))
    np.testing.assert_allclose(turns, 1.0, atol=1e-6)


def test_the_bytes_of_its_converter_are_read_as_it_reads_them(tmp_path, spark):
    properties, values = quantized()
    path = tmp_path / "a.rad"
    path.write_bytes(rad_file(properties, 50))
    check(read_scene(path).gaussians, values)
    rows, degree = spark(path)
    assert degree == 1
    np.testing.assert_allclose(rows[:, :3], values["means"], atol=1e-6)
    np.testing.assert_allclose(np.log(rows[:, 3:6]), values["log_scales"], atol=1e-4)
    np.testing.assert_allclose(rows[:, 11:], values["colors"], atol=1e-3)
    assert np.abs((rows[:, 6:10] * values["quats"]).sum(axis=1)).min() >= 1 - 1e-3


def test_of_a_tree_the_finest_splats_are_read(tmp_path):
    """The first splat stands for those that follow, and is more opaque than a splat can be."""
    properties, values = quantized()
    counts = np.zeros(50, "<u2")
    counts[0] = 49
    starts = np.zeros(50, "<u4")
    starts[0] = 1
    properties[1] = (
        "alpha",
        "f16",
        {},
        np.where(counts > 0, 1.5, values["opacities"]).astype("<f2").tobytes(),
    )
    tree = [("child_count", "u16", {}, counts.tobytes()), ("child_start", "u32", {}, starts.tobytes())]
    path = tmp_path / "a.rad"
    path.write_bytes(rad_file([*properties, *tree], 50, lodTree=True))
    values["opacities"] = values["opacities"].astype(np.float16)
    check(read_scene(path).gaussians, {name: array[1:] for name, array in values.items()})


def test_a_palette_of_harmonics_is_read(tmp_path):
    properties, values = quantized()
    labels = np.arange(50, dtype="<u2") % 7
    _, encoding, further, data = properties.pop()
    entries = np.frombuffer(data, np.uint8).reshape(9, 50)[:, :7]
    properties += [
        ("sh1_code", encoding, further, entries.tobytes()),
        ("sh_label", "u16", {}, labels.tobytes()),
    ]
    path = tmp_path / "a.rad"
    path.write_bytes(rad_file(properties, 50, shCodeCount=7))
    values["sh_rest"] = values["sh_rest"][labels]
    check(read_scene(path).gaussians, values)
    properties[-1] = ("sh_label", "u16", {}, (labels + 1).tobytes())
    path.write_bytes(rad_file(properties, 50, shCodeCount=7))
    assert "has a label of harmonics that no code has" in refused(path)


def test_chunks_lie_beside_a_header(tmp_path):
    properties, values = quantized()
    whole = rad_file(properties, 50)
    start = whole.index(b"RADC")
    (tmp_path / "a-0.radc").write_bytes(whole[start:])
    path = tmp_path / "a.rad"
    header = json.loads(whole[8 : whole.index(b"\0", 8)].decode().rstrip())
    for name in ("a-0.radc", "../a-0.radc", "b.radc"):
        header["chunks"][0]["filename"] = name
        path.write_bytes(with_json(b"RAD0", header))
        if name == "a-0.radc":
            check(read_scene(path).gaussians, values)
        else:
            assert "beside it" in refused(path)


def test_many_splats_are_several_chunks(tmp_path):
    scene = random_scene(IN_CHUNK + 5, rest=0)
    write_scene(tmp_path / "a.rad", scene)
    back = read_scene(tmp_path / "a.rad").gaussians
    assert torch.equal(matched(scene.gaussians, back).means, back.means) and len(back) == IN_CHUNK + 5
