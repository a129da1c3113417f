"""Convex parts: each is convex, together they cover the mesh, and they are the same bytes whatever the threads."""

import hashlib
import json
import os
import struct
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.evaluate.topology import topology
from gsplat_edu.io.mesh_files import read_mesh
from gsplat_edu.io.mesh_glb import write_parts
from gsplat_edu.mesh.coacd_process import cut
from gsplat_edu.mesh.convex import ConvexSettings, convex_parts, farthest_outside, fit_of
from gsplat_edu.scene.mesh import Mesh
from known_surfaces import torus

pytestmark = pytest.mark.slow

RING = torus(24, 12, r=0.3)

CORNERS = np.array([[(i >> axis) & 1 for axis in range(3)] for i in range(8)], float)
BOX = np.array(
    [
        *([0, 2, 3], [0, 3, 1], [4, 5, 7], [4, 7, 6], [0, 1, 5], [0, 5, 4]),
        *([2, 6, 7], [2, 7, 3], [0, 4, 6], [0, 6, 2], [1, 3, 7], [1, 7, 5]),
    ]
)


@pytest.fixture(scope="module")
def parts():
    return convex_parts(RING)


def bumpiness(part):
    """How far a vertex of a part lies above the plane of one of its faces."""
    normals = part.face_normals()
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return (part.vertices @ normals.T - (normals * part.corners[:, 0]).sum(axis=1)).max()


def test_each_part_is_a_small_convex_solid(parts):
    assert len(parts) > 4, "one hull would close the hole of the ring"
    for part in parts:
        shape = topology(part)
        assert shape.closed and shape.volume > 0 and shape.genus == 0
        assert bumpiness(part) < 1e-9 and len(part.vertices) <= 64
    assert sum(topology(part).volume for part in parts) < 1.5 * topology(RING).volume


def test_together_they_cover_the_ring_and_leave_its_hole(parts):
    assert farthest_outside(RING.vertices, parts) < 0.02
    assert farthest_outside(np.zeros((1, 3)), parts) > 0.5
    assert bumpiness(RING) > 0.1, "the ring itself is not convex"


def test_the_distance_from_a_box():
    (box,) = convex_parts(Mesh(CORNERS, BOX))
    points = np.array([[0.5, 0.5, 0.5], [0.5, 0.5, 1.25]])
    assert farthest_outside(points[:1], [box]) == 0
    assert farthest_outside(points, [box]) == pytest.approx(0.25)
    assert farthest_outside(np.array([[4.0, 5, 0.5]]), [box]) == pytest.approx(5)


def box(low, high):
    """A box between two corners."""
    return Mesh(np.array(low) + CORNERS * (np.array(high, float) - low), BOX)


def mug(wall=0.1):
    """A unit box with a hollow in its middle that no hole leads to: walls of one thickness."""
    inner = box([wall] * 3, [1 - wall] * 3)
    return Mesh(np.concatenate([CORNERS, inner.vertices]), np.concatenate([BOX, 8 + BOX[:, ::-1]]))


def test_what_parts_fill_and_leave_out():
    whole = box([0, 0, 0], [1, 1, 1])
    # one part fills the hollow, 0.8^3 of its volume
    full = fit_of(mug(), [whole])
    assert full.filled == pytest.approx(0.512, abs=0.01) and full.uncovered == full.outside == 0
    # a quarter of the box is left out; nothing is filled
    low = fit_of(whole, [box([0, 0, 0], [1, 1, 0.75])])
    assert low.filled == 0 and low.uncovered == pytest.approx(0.25, abs=0.01)
    assert low.outside == pytest.approx(0.25)
    # two parts that overlap count once: 0.3 of 1.3 in all lies outside the box
    both = fit_of(whole, [box([0, 0, 0], [1, 1, 0.7]), box([0, 0, 0.4], [1, 1, 1.3])])
    assert both.filled == pytest.approx(0.3 / 1.3, abs=0.01) and both.uncovered == 0


def test_what_fills_an_open_mesh_is_unknown():
    room = Mesh(CORNERS, BOX[:-2, ::-1])
    assert fit_of(room, [box([0, 0, 0], [1, 1, 1])])[1:] == (None, None)


def test_holes_of_an_object_are_closed_and_those_of_a_room_are_not():
    lidless = Mesh(CORNERS, BOX[:-2])  # one side is missing: a sixth of the area
    (part,) = convex_parts(lidless)
    assert topology(part).volume == pytest.approx(1, rel=1e-6)
    room = convex_parts(Mesh(CORNERS, lidless.faces[:, ::-1]))
    assert len(room) > 1 and farthest_outside(np.array([[0.5, 0.5, 0.5]]), room) > 0.1


def test_an_open_mesh_gets_a_shell():
    """Half a ring without caps."""
    keep = RING.corners[:, :, 0].min(axis=1) > -0.05
    half = Mesh(RING.vertices, RING.faces[keep]).used()
    found = convex_parts(half, ConvexSettings(concavity=0.2))
    assert all(bumpiness(part) < 1e-9 for part in found)
    assert farthest_outside(half.vertices, found) < 0.1
    assert farthest_outside(np.array([[-1.0, 0, 0]]), found) > 0.5


def test_the_file_has_a_node_for_each_part_and_the_same_bytes_for_any_threads(parts, tmp_path):
    out = tmp_path / "collider.glb"
    write_parts(out, [(f"collider_{i}", part) for i, part in enumerate(parts)], "cm")
    data = out.read_bytes()
    document = json.loads(data[20 : 20 + struct.unpack("<I", data[12:16])[0]])
    assert [node["name"] for node in document["nodes"]] == [f"collider_{i}" for i in range(len(parts))]
    assert document["scenes"][0]["nodes"] == list(range(len(parts)))
    read = read_mesh(out, "cm")
    assert len(read.faces) == sum(len(part.faces) for part in parts)
    assert np.allclose(read.vertices.max(axis=0), np.concatenate([p.vertices for p in parts]).max(axis=0))
    for threads in (1, 5):
        again = tmp_path / f"{threads}.glb"
        program = (
            "import sys; from known_surfaces import torus; from gsplat_edu.io.mesh_glb import write_parts;"
            "from gsplat_edu.mesh.convex import convex_parts; parts = convex_parts(torus(24, 12, r=0.3));"
            "write_parts(sys.argv[1], [(f'collider_{i}', part) for i, part in enumerate(parts)], 'cm')"
        )
        paths = os.pathsep.join(path for path in sys.path if path)
        environment = {**os.environ, "OMP_NUM_THREADS": str(threads), "PYTHONPATH": paths}
        subprocess.run([sys.executable, "-c", program, again], env=environment, check=True, timeout=300)
        assert hashlib.sha256(again.read_bytes()).digest() == hashlib.sha256(data).digest()


def test_a_failure_of_coacd_is_one_line_and_not_the_end_of_the_program():
    with pytest.raises(ArgumentError, match=r"cannot cut this mesh \(exit code 1: TypeError.*unknown"):
        cut(RING, {"unknown": 1})


def test_islands_beside_a_torn_hole():
    """CoACD 1.0.14 ends its process at this ball by a segmentation fault."""
    polar, around = np.meshgrid(np.linspace(0.12, 0.88, 14) * np.pi, np.arange(16) * np.pi / 8, indexing="ij")
    places = [np.sin(polar) * np.cos(around), -np.cos(polar), np.sin(polar) * np.sin(around)]
    first = 16 * np.arange(13)[:, None] + np.arange(16)
    after = 16 * np.arange(13)[:, None] + (np.arange(16) + 1) % 16
    corners = [(first, after, first + 16), (after, after + 16, first + 16)]
    faces = np.stack([np.stack(three, axis=-1) for three in corners], axis=2).reshape(-1, 3)
    ball = Mesh(np.stack(places, axis=-1).reshape(-1, 3), faces)
    if (ball.face_normals() * ball.corners.mean(axis=1)).sum() < 0:
        ball = Mesh(ball.vertices, faces[:, ::-1].copy())
    middles = np.abs(ball.corners.mean(axis=1)[:, 1])
    kept = (middles < 0.93 * middles.max()) | (np.random.default_rng(0).random(len(middles)) > 0.5)
    torn = Mesh(ball.vertices, ball.faces[kept]).used()
    try:
        parts = convex_parts(torn)
    except ArgumentError as error:
        assert "write a collider of triangles" in str(error)
    else:
        assert farthest_outside(torn.vertices, parts) < 0.2


def test_refusals(tmp_path, monkeypatch):
    with pytest.raises(ArgumentError, match="no faces"):
        convex_parts(Mesh(np.zeros((0, 3)), np.zeros((0, 3), np.int64)))
    with pytest.raises(ArgumentError, match="concavity"):
        ConvexSettings(concavity=0.0)
    with pytest.raises(ArgumentError, match="nothing to write"):
        write_parts(Path(tmp_path / "none.glb"), [])
    with pytest.raises(ArgumentError, match="unit"):
        write_parts(tmp_path / "ell.glb", [("a", RING)], "ell")
    monkeypatch.setitem(sys.modules, "coacd", None)
    with pytest.raises(ArgumentError, match=r"coacd.*\[mesh\]"):
        convex_parts(RING)
