"""Meshes as USDZ: a package of USD that phones, Blender and other programs open.

The package's first file, a binary layer of USD (usd-core writes it), holds the mesh, and a texture lies beside it
(`gsplat_edu.io.usd_package`). The layer's axes and unit are those of glTF (`gsplat_edu.io.mesh_glb`): y points up, and
a known unit becomes the metre. Points are float32, which is all that a mesh of USD has; the transform of the root, in
double, turns the scene's up direction to y and moves the mesh to its origin. The layer's customLayerData says where on
earth the mesh is, if that is known.

Colours of vertices are linear in USD (displayColor), and left out beside a texture, as in glTF. A texture stays sRGB,
as the diffuse colour of a UsdPreviewSurface. USD has no unlit material, so a viewer adds its own light to the photos'.
The layer stores texture coordinates per corner of a face, so no vertex is repeated. They begin at the bottom left.

Source: Pixar, "UsdPreviewSurface Specification".
"""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from gsplat_edu.io.axes import POSITION_SIGNS
from gsplat_edu.io.mesh_glb import linear
from gsplat_edu.io.mesh_image import encoded
from gsplat_edu.io.mesh_parts import Placement, turned_positions, vertex_normals
from gsplat_edu.io.usd_package import require_usd, write_package
from gsplat_edu.io.usd_stage import MARK
from gsplat_edu.scene.mesh import Mesh

LAYER = "mesh.usdc"
"""Name of the layer in the package."""


def write(path: Path, mesh: Mesh, placement: Placement, jpeg: int | None) -> None:
    """Write a mesh; see `gsplat_edu.io.mesh_files.write_mesh`."""
    require_usd(".usdz")
    files, image = [], ""
    if mesh.texture is not None:
        image = "texture.png" if jpeg is None else "texture.jpg"
        files.append((image, encoded(mesh.texture.image, jpeg)))
    files.insert(0, (LAYER, _layer(path, mesh, placement, image)))
    write_package(path, ((name, (data,)) for name, data in files), "write a .ply")


def _layer(path: Path, mesh: Mesh, placement: Placement, image: str) -> bytes:
    """Return the layer; `image` is the name of the texture in the package, empty without one."""
    from pxr import Gf, Usd, UsdGeom, Vt

    points = turned_positions(path, mesh.vertices, placement, "USD")
    stage = Usd.Stage.CreateInMemory(LAYER)
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    if "earth" in placement.stated:
        stage.GetRootLayer().customLayerData = {MARK: {"earth": placement.stated["earth"]}}
    root = UsdGeom.Xform.Define(stage, "/scene")
    stage.SetDefaultPrim(root.GetPrim())
    turn, shift = placement.root
    matrix = np.eye(4)
    matrix[:3, :3], matrix[3, :3] = turn.T, shift  # USD multiplies rows
    if not np.array_equal(matrix, np.eye(4)):
        root.AddTransformOp().Set(Gf.Matrix4d(matrix.tolist()))
    surface = UsdGeom.Mesh.Define(stage, "/scene/surface")
    surface.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(points))
    surface.CreateExtentAttr(Vt.Vec3fArray.FromNumpy(np.stack([points.min(axis=0), points.max(axis=0)])))
    surface.CreateFaceVertexCountsAttr(Vt.IntArray.FromNumpy(np.full(len(mesh.faces), 3, np.int32)))
    surface.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(mesh.faces.ravel().astype(np.int32)))
    normals = vertex_normals(mesh) * np.array(POSITION_SIGNS) + 0.0
    surface.CreateNormalsAttr(Vt.Vec3fArray.FromNumpy(normals.astype(np.float32)))
    surface.SetNormalsInterpolation(UsdGeom.Tokens.vertex)
    surface.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)  # otherwise viewers would round the mesh off
    surface.CreateDoubleSidedAttr(True)
    if mesh.texture is not None:
        _add_texture(stage, surface, mesh.texture.uvs, image)
    elif mesh.colors is not None:
        colors = linear(np.clip(mesh.colors, 0.0, 1.0)).astype(np.float32)
        shown = surface.CreateDisplayColorPrimvar(UsdGeom.Tokens.vertex)
        shown.Set(Vt.Vec3fArray.FromNumpy(colors))
    with TemporaryDirectory() as folder:
        file = Path(folder, LAYER)
        stage.GetRootLayer().Export(str(file))
        return file.read_bytes()


def _add_texture(stage: Any, surface: Any, uvs: np.ndarray, image: str) -> None:  # noqa: ANN401
    """Add texture coordinates and a material whose diffuse colour is the image."""
    from pxr import Sdf, UsdGeom, UsdShade, Vt

    types = Sdf.ValueTypeNames
    upward = uvs.reshape(-1, 2).copy()
    upward[:, 1] = 1.0 - upward[:, 1]
    api = UsdGeom.PrimvarsAPI(surface)
    coordinates = api.CreatePrimvar("st", types.TexCoord2fArray, UsdGeom.Tokens.faceVarying)
    coordinates.Set(Vt.Vec2fArray.FromNumpy(upward))
    material = UsdShade.Material.Define(stage, "/scene/photos")

    def node(name: str, kind: str, inputs: dict[str, tuple[Any, Any]]) -> Any:  # noqa: ANN401
        shader = UsdShade.Shader.Define(stage, f"/scene/photos/{name}")
        shader.CreateIdAttr(kind)
        for key, (of_type, value) in inputs.items():
            shader.CreateInput(key, of_type).Set(value)
        return shader

    place = node("place", "UsdPrimvarReader_float2", {"varname": (types.String, "st")})
    texture = node(
        "image",
        "UsdUVTexture",
        {
            "file": (types.Asset, image),
            "sourceColorSpace": (types.Token, "sRGB"),
            "wrapS": (types.Token, "clamp"),
            "wrapT": (types.Token, "clamp"),
        },
    )
    texture.CreateInput("st", types.Float2).ConnectToSource(place.CreateOutput("result", types.Float2))
    matte = {"roughness": (types.Float, 1.0), "metallic": (types.Float, 0.0)}
    look = node("look", "UsdPreviewSurface", matte)
    color = texture.CreateOutput("rgb", types.Float3)
    look.CreateInput("diffuseColor", types.Color3f).ConnectToSource(color)
    material.CreateSurfaceOutput().ConnectToSource(look.CreateOutput("surface", types.Token))
    UsdShade.MaterialBindingAPI.Apply(surface.GetPrim()).Bind(material)
