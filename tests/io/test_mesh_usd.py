"""Meshes as USDZ: usd-core reads what is written, and its validators find no errors."""

import io
import os
import struct
import subprocess
import sys
import zipfile

import numpy as np
import pytest
from PIL import Image

from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.io.mesh_files import mesh_losses, read_mesh, write_mesh
from gsplat_edu.io.mesh_glb import linear
from gsplat_edu.scene.earth import Earth
from gsplat_edu.scene.mesh import Mesh, Texture

Usd = pytest.importorskip("pxr.Usd", reason="usd-core is not installed")
from pxr import Sdf, UsdGeom, UsdShade, UsdValidation  # noqa: E402

MESH = "/scene/surface"


def some_mesh(colors=False, texture=False):
    """A tetrahedron, its faces outward."""
    vertices = np.array([[0.0, 0, 0], [1, 0, 0], [0, 2, 0], [0, 0, 3]]) + 0.25
    faces = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
    rng = np.random.default_rng(3)
    shades = (rng.integers(0, 256, (4, 3)) / 255).astype(np.float32) if colors else None
    image = None
    if texture:
        uvs = rng.random((4, 3, 2), dtype=np.float32)
        image = Texture(rng.integers(0, 256, (16, 32, 3), dtype=np.uint8), uvs)
    return Mesh(vertices, faces, shades, image)


def opened(path):
    stage = Usd.Stage.Open(str(path))
    return stage, UsdGeom.Mesh.Get(stage, MESH)


@pytest.mark.parametrize(
    ("unit", "size", "extra"), [(None, 1.0, "colors"), ("cm", 0.01, "texture"), ("m", 1.0, "")]
)
def test_usd_reads_what_is_written(tmp_path, unit, size, extra):
    mesh = some_mesh(**({extra: True} if extra else {}))
    path = tmp_path / "deep" / "a mesh.usdz"
    write_mesh(path, mesh, unit)
    stage, found = opened(path)
    assert UsdGeom.GetStageUpAxis(stage) == "Y"
    assert UsdGeom.GetStageMetersPerUnit(stage) == 1.0
    assert stage.GetDefaultPrim().GetPath() == "/scene"
    points = np.array(found.GetPointsAttr().Get())
    expected = (size * mesh.vertices * (1, -1, -1)).astype(np.float32)
    assert (points == expected).all()
    assert (np.array(found.GetExtentAttr().Get()) == [expected.min(0), expected.max(0)]).all()
    assert (np.array(found.GetFaceVertexCountsAttr().Get()) == 3).all()
    faces = np.array(found.GetFaceVertexIndicesAttr().Get(), np.int64).reshape(-1, 3)
    assert (faces == mesh.faces).all()
    assert found.GetSubdivisionSchemeAttr().Get() == "none"
    # normals and the winding of the faces both point outward in USD's axes
    normals = np.array(found.GetNormalsAttr().Get())
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0, atol=1e-6)
    assert ((normals * (points - points.mean(0))).sum(1) > 0).all()
    turned = Mesh(points.astype(np.float64), faces)
    assert ((turned.face_normals() * (turned.corners.mean(1) - points.mean(0))).sum(1) > 0).all()
    assert found.GetOrientationAttr().Get() == "rightHanded"
    shades = found.GetDisplayColorPrimvar()
    if extra == "colors":
        assert shades.GetInterpolation() == "vertex"
        assert (np.array(shades.Get()) == linear(mesh.colors).astype(np.float32)).all()
    else:
        assert not shades.HasValue()


def test_the_layer_says_where_on_earth_its_metres_are(tmp_path):
    earth = Earth.at_place(47.0, 8.0, 400.0, np.diag([0.01, 0.01, 0.01]))
    write_mesh(tmp_path / "a.usdz", some_mesh(), "cm", earth=earth)
    stage, _ = opened(tmp_path / "a.usdz")
    said = Earth.parsed(stage.GetRootLayer().customLayerData["gsplat_edu"]["earth"])
    np.testing.assert_allclose(said.rows, Earth.at_place(47.0, 8.0, 400.0).rows, rtol=0, atol=1e-9)
    write_mesh(tmp_path / "b.usdz", some_mesh(), "cm")
    assert not opened(tmp_path / "b.usdz")[0].GetRootLayer().customLayerData


@pytest.mark.parametrize(("jpeg", "name"), [(None, "texture.png"), (90, "texture.jpg")])
def test_the_texture_lies_inside_and_is_the_diffuse_colour(tmp_path, jpeg, name):
    mesh, path = some_mesh(colors=True, texture=True), tmp_path / "a.usdz"
    write_mesh(path, mesh, jpeg=jpeg)
    assert "colours; they are dropped" in mesh_losses(path, mesh)[0]
    _, found = opened(path)
    assert not found.GetDisplayColorPrimvar().HasValue()
    st = UsdGeom.PrimvarsAPI(found).GetPrimvar("st")
    assert st.GetInterpolation() == "faceVarying"
    stored = np.array(st.ComputeFlattened()).reshape(-1, 3, 2)
    uvs = mesh.texture.uvs
    assert (stored[..., 0] == uvs[..., 0]).all()
    assert (stored[..., 1] == np.float32(1) - uvs[..., 1]).all()  # USD counts from the bottom
    material = UsdShade.MaterialBindingAPI(found).ComputeBoundMaterial()[0]
    look = material.ComputeSurfaceSource()[0]
    assert look.GetIdAttr().Get() == "UsdPreviewSurface"
    image = UsdShade.Shader(look.GetInput("diffuseColor").GetConnectedSources()[0][0].source.GetPrim())
    assert image.GetIdAttr().Get() == "UsdUVTexture"
    assert image.GetInput("sourceColorSpace").Get() == "sRGB"
    place = UsdShade.Shader(image.GetInput("st").GetConnectedSources()[0][0].source.GetPrim())
    assert place.GetInput("varname").Get() == "st"
    assert image.GetInput("file").Get().resolvedPath.endswith(f"a.usdz[{name}]")
    with zipfile.ZipFile(path) as archive:
        decoded = np.array(Image.open(io.BytesIO(archive.read(name))))
    if jpeg is None:
        assert (decoded == mesh.texture.image).all()
    else:
        assert decoded.shape == mesh.texture.image.shape


@pytest.mark.parametrize("extra", ["", "colors", "texture"])
def test_validators_find_no_errors(tmp_path, extra):
    path = tmp_path / "a.usdz"
    write_mesh(path, some_mesh(**({extra: True} if extra else {})), "m")
    registry = UsdValidation.ValidationRegistry()
    validators = registry.GetOrLoadAllValidators()
    assert len(validators) > 20
    check = UsdValidation.ValidationContext(validators).Validate
    assert [error.GetMessage() for error in check(Usd.Stage.Open(str(path)))] == []
    # they do look: without its up axis and unit, the same stage has errors
    stage = Usd.Stage.Open(Usd.Stage.Open(str(path)).Flatten())
    for key in ("upAxis", "metersPerUnit"):
        stage.ClearMetadata(key)
    assert len(check(stage)) >= 2


def test_files_begin_at_multiples_of_64_bytes(tmp_path):
    path = tmp_path / "a.usdz"
    write_mesh(path, some_mesh(texture=True))
    data = path.read_bytes()
    with zipfile.ZipFile(path) as archive:
        assert archive.testzip() is None
        entries = archive.infolist()
    assert [entry.filename for entry in entries] == ["mesh.usdc", "texture.png"]
    for entry in entries:
        assert entry.compress_type == zipfile.ZIP_STORED
        assert entry.flag_bits == 0
        name, extra = struct.unpack_from("<HH", data, entry.header_offset + 26)
        assert (entry.header_offset + 30 + name + extra) % 64 == 0
    assert data[(30 + len("mesh.usdc") + 4 + 63) // 64 * 64 :][:8] == b"PXR-USDC"
    package = Sdf.ZipFile.Open(str(path)) if hasattr(Sdf, "ZipFile") else Usd.ZipFile.Open(str(path))
    assert list(package.GetFileNames()) == ["mesh.usdc", "texture.png"]


WRITE = """
import sys, numpy as np
from gsplat_edu.io.mesh_files import write_mesh
from gsplat_edu.scene.mesh import Mesh, Texture
rng = np.random.default_rng(0)
image = Texture(rng.integers(0, 256, (16, 16, 3), dtype=np.uint8), rng.random((500, 3, 2), dtype=np.float32))
write_mesh(sys.argv[1], Mesh(rng.normal(size=(300, 3)), rng.integers(0, 300, (500, 3)), None, image), "m")
"""


def test_the_same_mesh_gives_the_same_bytes_in_every_process(tmp_path):
    written = []
    for seed in ("1", "2"):
        path = tmp_path / f"{seed}.usdz"
        environment = os.environ | {"PYTHONHASHSEED": seed, "TZ": f"UTC{seed}"}
        subprocess.run([sys.executable, "-c", WRITE, path], check=True, timeout=300, env=environment)
        written.append(path.read_bytes())
    assert written[0] == written[1]


def test_what_cannot_be_done_is_said_in_one_line(tmp_path, monkeypatch):
    path = tmp_path / "a.usdz"
    far = Mesh(some_mesh().vertices * 1e39, some_mesh().faces)
    write_mesh(path, some_mesh())
    before = path.read_bytes()
    with pytest.raises(ArgumentError, match="beyond float32, which USD uses"):
        write_mesh(path, far)
    with pytest.raises(ArgumentError, match="written, not read; give a .glb"):
        read_mesh(path)
    monkeypatch.setitem(sys.modules, "pxr", None)
    with pytest.raises(ArgumentError, match=r"needs usd-core.*\[usd\]"):
        write_mesh(path, some_mesh())
    assert path.read_bytes() == before
    assert [file.name for file in tmp_path.iterdir()] == ["a.usdz"]
