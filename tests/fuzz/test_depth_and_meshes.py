"""Damaged and hostile depth maps and meshes end in a result or one line, in at most 1 GB of memory."""

import json
import os
import shutil
import struct
import tracemalloc
import zipfile
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import tiers
from damage import damaged_bytes, damaged_json, damaged_text
from gsplat_edu.base.errors import DatasetError, NotEnoughMemoryError, SceneFormatError
from gsplat_edu.data.depth_files import read_depth
from gsplat_edu.io.mesh_files import read_mesh, write_mesh
from gsplat_edu.scene.mesh import Mesh, Texture
from processes import Program
from systems import needs_posix

pytestmark = pytest.mark.fuzz

FILES = tiers.count("GSPLAT_EDU_FUZZ", 200, 20_000)
"""Damaged files per reader."""

SEEDS = range(tiers.SEED, tiers.SEED + FILES)

DATA = Path(os.environ.get("GSPLAT_EDU_DATA", Path(__file__).parents[3] / "shared" / "data"))

MOST_MEMORY = 1_000_000_000
"""Largest memory of any file, bytes."""

DEPTH = np.random.default_rng(0).uniform(1, 60_000, (12, 16)).astype(np.float32)

MEASURED = """
import resource, sys
from pathlib import Path
from damage import damaged_bytes
from gsplat_edu.base.errors import DatasetError, NotEnoughMemoryError, SceneFormatError
from gsplat_edu.data.depth_files import read_depth
from gsplat_edu.io.mesh_files import read_mesh
import numpy as np

folder, first, count, whole, *names = sys.argv[1:]
before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss

def read(path):
    try:
        (read_depth if path.suffix in (".npy", ".npz", ".exr", ".png") else read_mesh)(path)
        print("read")
    except (DatasetError, NotEnoughMemoryError, SceneFormatError) as error:
        assert "\\n" not in str(error) and str(path) in str(error)
        print(error)

for name in names:
    read(Path(folder, name))
for seed in range(int(first), int(first) + int(count)):
    path = Path(folder, "damaged" + Path(whole).suffix)
    path.write_bytes(damaged_bytes(Path(folder, whole).read_bytes(), np.random.default_rng(seed)))
    read(path)
print(1024 * (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before))
"""
"""Reads files, prints what is said of each, and last the bytes of memory that reading took, of libraries too."""


def measured(folder, names=(), whole="", count=0):
    """Read files in a process of their own; return what is said of each, and the bytes of memory."""
    ended = Program(MEASURED, [folder, tiers.SEED, count, whole, *names], folder).ended()
    assert ended[0] == 0, ended[2]
    *said, size = ended[1].splitlines()
    return said, int(size)


def depth_file(folder, name):
    path = folder / name
    if name.endswith(".npy"):
        np.save(path, DEPTH)
    elif name.endswith("deflated.npz"):
        np.savez_compressed(path, depth=DEPTH, other=np.zeros(3))
    elif name.endswith(".npz"):
        np.savez(path, depth=DEPTH.astype(np.float64))
    elif name.endswith(".bin"):
        path.write_bytes(b"16&12&1&" + DEPTH.tobytes())
    else:
        Image.fromarray(DEPTH.astype(np.uint16)).save(path)
    return path


def mesh_file(folder, name):
    rng = np.random.default_rng(0)
    points, faces = rng.normal(size=(30, 3)), rng.integers(0, 30, (20, 3))
    colors = rng.random((30, 3)).astype(np.float32)
    texture = Texture(rng.integers(0, 256, (8, 8, 3), np.uint8), rng.random((20, 3, 2)).astype(np.float32))
    path = folder / name
    if name == "various.ply":
        head = (
            "ply\nformat binary_little_endian 1.0\nelement vertex 30\nproperty double x\nproperty double y\n"
        )
        head += "property double z\nelement face 20\nproperty list uchar uint vertex_indices\n"
        head += "property list uint double weights\nend_header\n"
        rows = [
            struct.pack(f"<B{n}II{n}d", n, *rng.integers(0, 30, n), n, *rng.random(n))
            for n in rng.integers(3, 7, 20)
        ]
        path.write_bytes(head.encode() + points.tobytes() + b"".join(rows))
    elif name == "text.ply":
        head = (
            "ply\nformat ascii 1.0\nelement vertex 30\nproperty float x\nproperty float y\nproperty float z\n"
        )
        head += "element face 20\nproperty list uchar int vertex_indices\nend_header\n"
        lines = [
            " ".join(map(str, row)) for row in (*points.tolist(), *([3, *face] for face in faces.tolist()))
        ]
        path.write_text(head + "\n".join(lines) + "\n")
    else:
        write_mesh(
            path,
            Mesh(
                points, faces, None if "textured" in name else colors, texture if "textured" in name else None
            ),
        )
    return path


def check(read, path, seed):
    tracemalloc.start()
    try:
        found = read(path)
        assert np.isfinite(found.vertices).all() if read is read_mesh else found.dtype == np.float32, seed
    except (DatasetError, SceneFormatError, NotEnoughMemoryError) as error:
        assert "\n" not in str(error) and str(path) in str(error), seed
    finally:
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
    assert peak < MOST_MEMORY, f"seed {seed}: {peak:,} bytes"


@pytest.mark.parametrize("name", ["a.npy", "a.npz", "deflated.npz", "a.png", "a.tif", "a.geometric.bin"])
def test_damaged_depth_maps(tmp_path, name):
    data, path = depth_file(tmp_path, name).read_bytes(), tmp_path / f"damaged{name}"
    for seed in SEEDS:
        path.write_bytes(damaged_bytes(data, np.random.default_rng(seed)))
        check(read_depth, path, seed)


def test_damage_inside_an_npz(tmp_path):
    """A zip has checksums, so the damage is done before zipping."""
    data, path = depth_file(tmp_path, "a.npy").read_bytes(), tmp_path / "damaged.npz"
    for seed in SEEDS:
        rng = np.random.default_rng(seed)
        how = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED, zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA)[seed % 4]
        with zipfile.ZipFile(path, "w", how) as archive:
            archive.writestr("depth.npy", damaged_bytes(data[:128], rng) + data[128:])
        check(read_depth, path, seed)


@pytest.mark.parametrize(
    "name", ["a.ply", "various.ply", "text.ply", "a.obj", "textured.obj", "a.glb", "textured.glb"]
)
def test_damaged_meshes(tmp_path, name):
    data, path = mesh_file(tmp_path, name).read_bytes(), tmp_path / f"damaged.{name}"
    for seed in SEEDS:
        rng = np.random.default_rng(seed)
        text = name in ("text.ply", "a.obj", "textured.obj") and seed % 2
        path.write_bytes((damaged_text if text else damaged_bytes)(data, rng))
        check(read_mesh, path, seed)


def glb(document, body=b""):
    """Return a GLB of a document, which is JSON already or becomes it, and a buffer."""
    text = document if isinstance(document, bytes) else json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(body), b"BIN\0") + body
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


@pytest.mark.parametrize("name", ["a.glb", "textured.glb"])
def test_damage_inside_the_json_of_a_glb(tmp_path, name):
    data, path = mesh_file(tmp_path, name).read_bytes(), tmp_path / "damaged.glb"
    length = struct.unpack_from("<I", data, 12)[0]
    text, body = data[20 : 20 + length], data[28 + length :]
    for seed in SEEDS:
        path.write_bytes(glb(damaged_json(text, np.random.default_rng(seed)), body))
        check(read_mesh, path, seed)


@needs_posix
def test_damaged_exr(tmp_path):
    exr = pytest.importorskip("OpenEXR", reason="OpenEXR is not installed (extra depth)")
    parts = [
        exr.Part({"type": exr.scanlineimage, "name": name}, {"Z": DEPTH, "A": DEPTH}) for name in ("a", "b")
    ]
    exr.File(parts).write(str(tmp_path / "a.exr"))
    said, size = measured(tmp_path, whole="a.exr", count=FILES)
    assert len(said) == FILES and 0 < said.count("read") < FILES
    assert size < MOST_MEMORY, f"{size:,} bytes"


def npy(shape, length=None):
    text = f"{{'descr': '<f8', 'fortran_order': False, 'shape': {shape}, }}\n".encode()
    return b"\x93NUMPY\x02\0" + struct.pack("<I", len(text) if length is None else length) + text


def zip_of_zeros(path, head, size, method=zipfile.ZIP_BZIP2):
    """Write an NPZ whose only member is a head followed by zeros."""
    with (
        zipfile.ZipFile(path, "w", method) as archive,
        archive.open("depth.npy", "w", force_zip64=True) as file,
    ):
        file.write(head)
        for _ in range(size >> 24):
            file.write(bytes(1 << 24))


def hostile_npz(folder):
    zip_of_zeros(folder / "header.npz", npy((3, 4), (1 << 32) - 1), 1 << 28)
    zip_of_zeros(folder / "length.npz", npy((8000, 8000)), 1 << 24, zipfile.ZIP_DEFLATED)
    with zipfile.ZipFile(folder / "members.npz", "w") as archive:
        for number in range(3_000):
            archive.writestr(f"{number}.npy", b"")
    claims = bytearray((folder / "length.npz").read_bytes())
    at = claims.rindex(b"PK\x01\x02")
    claims[at + 24 : at + 28] = struct.pack("<I", 8 * 8000 * 8000 + 100)  # the size that the directory states
    (folder / "claims.npz").write_bytes(claims)


@needs_posix
def test_archives_that_claim_more_than_they_hold(tmp_path):
    hostile_npz(tmp_path)
    reasons = {
        "header.npz": "it is compressed in a way that NumPy does not write",
        "length.npz": "its header names 512,000,000 bytes of numbers, but it has 16,777,216",
        "members.npz": "3,000 entries",
        "claims.npz": "is no depth map",
    }
    said, size = measured(tmp_path, reasons)
    assert size < MOST_MEMORY, f"{size:,} bytes"
    for line, reason in zip(said, reasons.values(), strict=True):
        assert reason in line


@needs_posix
def test_the_archives_that_fell_before(tmp_path):
    files = sorted((DATA / "fell" / "depth").glob("*.npz"))
    if not files:
        pytest.skip(f"{DATA / 'fell' / 'depth'} is not on this machine; see GSPLAT_EDU_DATA")
    names = [Path(shutil.copy(file, tmp_path)).name for file in files]
    said, size = measured(tmp_path, names)
    assert len(said) == len(names) and "read" not in said and size < MOST_MEMORY


@needs_posix
def test_parts_and_channels_of_an_exr_are_counted(tmp_path):
    exr = pytest.importorskip("OpenEXR", reason="OpenEXR is not installed (extra depth)")
    plane, how = (
        np.ones((1000, 1000), np.float16),
        {"type": exr.scanlineimage, "compression": exr.RLE_COMPRESSION},
    )
    exr.File(how, {f"c{number}": plane for number in range(100)} | {"Z": plane}).write(
        str(tmp_path / "channels.exr")
    )
    parts = [exr.Part(how | {"name": f"p{number}"}, {"Z": plane}) for number in range(101)]
    exr.File(parts).write(str(tmp_path / "parts.exr"))
    said, size = measured(tmp_path, ["channels.exr", "parts.exr"])
    assert all("have 101,000,000 numbers in all channels" in line for line in said) and size < 100e6


def repeated(count):
    """Return a GLB of nodes with a mesh of as many empty primitives."""
    accessors = [{"componentType": 5126, "type": "VEC3", "count": 0, "bufferView": 0}]
    return {
        "asset": {"version": "2.0"},
        "nodes": [{"mesh": 0}] * count,
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}}] * count}],
        "accessors": accessors,
        "bufferViews": [{"byteLength": 0}],
        "buffers": [{"byteLength": 0}],
    }


def list_ply(path, claimed, size):
    """Write a PLY whose face claims a list of doubles, and zeros up to a size."""
    head = "ply\nformat binary_little_endian 1.0\nelement vertex 3\nproperty float x\nproperty float y\n"
    head += "property float z\nelement face 1\nproperty list uchar int vertex_indices\n"
    head += "property list uint double weights\nend_header\n"
    rows = np.eye(3, dtype="<f4").tobytes() + struct.pack("<BIIII", 3, 0, 1, 2, claimed)
    path.write_bytes(head.encode() + rows)
    os.truncate(path, max(size, path.stat().st_size))


@needs_posix
def test_meshes_that_claim_more_than_they_hold(tmp_path):
    mebi, start = 1 << 20, b'{"asset":{},"nodes":[{}'
    files = {
        "quadratic.glb": (glb(repeated(20_000)), "in more than 100,000 parts"),
        "roots.glb": (glb(start + b'],"scenes":[{"nodes":[' + b"0," * 7 * mebi + b"0]}]}"), "two parents"),
        "nodes.glb": (glb(start + b",{}" * mebi + b"]}"), "nodes, and at most"),
    }
    for name, (data, _) in files.items():
        (tmp_path / name).write_bytes(data)
    list_ply(tmp_path / "doubles.ply", 1 << 28, 1 << 28)
    list_ply(tmp_path / "longest.ply", (1 << 32) - 1, 0)
    reasons = [reason for _, reason in files.values()] + ["is truncated"] * 2
    said, size = measured(tmp_path, [*files, "doubles.ply", "longest.ply"])
    for line, reason in zip(said, reasons, strict=True):
        assert reason in line
    assert size < MOST_MEMORY, f"{size:,} bytes"
