"""Scenes as USD: usd-core reads what is written, its validators find no errors, and other programs' stages are read."""

import os
import subprocess
import sys
import zipfile
from dataclasses import replace

import numpy as np
import pytest
import torch

from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.io import usd_package
from gsplat_edu.io.axes import half_turned
from gsplat_edu.io.edit import Similarity
from gsplat_edu.io.formats import read_scene, write_scene
from gsplat_edu.io.scene import Scene
from gsplat_edu.render.api import render
from gsplat_edu.scene.camera import Camera
from scene_files import random_scene, refused, small_file

Usd = pytest.importorskip("pxr.Usd", reason="usd-core is not installed")
from pxr import Gf, Sdf, UsdGeom, UsdUtils, UsdValidation, UsdVol, Vt  # noqa: E402

ENDINGS = (".usda", ".usdc", ".usdz")
SPLATS = "/scene/splats"

every_ending = pytest.mark.parametrize("ending", ENDINGS)
Z_UP = Similarity(np.array([[1.0, 0, 0], [0, 0, -1.0], [0, 1.0, 0]]), 1.0, np.zeros(3))
"""From y up to z up."""


def filled(stage, path, gaussians, *, halves=False):
    """Define splats as another program does, with values taken as they are: no axes are turned."""
    g, h = gaussians, "h" if halves else ""
    vectors = Vt.Vec3hArray if halves else Vt.Vec3fArray
    kind = np.float16 if halves else np.float32
    prim = UsdVol.ParticleField3DGaussianSplat.Define(stage, path)
    quats = torch.nn.functional.normalize(g.quats, dim=1).numpy().tolist()
    quat, quats_of = (Gf.Quath, Vt.QuathArray) if halves else (Gf.Quatf, Vt.QuatfArray)
    sh = torch.cat([g.sh0, g.sh_rest], dim=1).reshape(-1, 3)

    def attribute(name):
        return getattr(prim, f"Create{name}{h}Attr")

    attribute("Positions")(vectors.FromNumpy(g.means.numpy().astype(kind)))
    attribute("Scales")(vectors.FromNumpy(g.scales.numpy().astype(kind)))
    attribute("Orientations")(quats_of([quat(*q) for q in quats]))
    opacities = (Vt.HalfArray if halves else Vt.FloatArray).FromNumpy(g.opacities.numpy().astype(kind))
    attribute("Opacities")(opacities)
    prim.CreateRadianceSphericalHarmonicsDegreeAttr(g.sh_degree)
    attribute("RadianceSphericalHarmonicsCoefficients")(vectors.FromNumpy(sh.numpy().astype(kind)))
    return prim


def check_close(back, expected, atol=2e-5):
    assert len(back) == len(expected)
    unit = torch.nn.functional.normalize(expected.quats, dim=1)
    own = torch.nn.functional.normalize(back.quats, dim=1)
    torch.testing.assert_close((unit * own).sum(1).abs(), torch.ones(len(back)), atol=atol, rtol=0)
    torch.testing.assert_close(back.means, expected.means, atol=atol, rtol=atol)
    torch.testing.assert_close(back.scales, expected.scales, atol=atol, rtol=atol)
    torch.testing.assert_close(back.opacities, expected.opacities, atol=atol, rtol=0)
    torch.testing.assert_close(back.sh0, expected.sh0, atol=atol, rtol=atol)
    torch.testing.assert_close(back.sh_rest, expected.sh_rest, atol=atol, rtol=atol)


@every_ending
@pytest.mark.parametrize("rest", [0, 3, 8, 15])
def test_a_round_trip_keeps_the_scene_and_its_frame(tmp_path, ending, rest):
    origin = (500000.25, 4649776.5, -120.0)
    scene = replace(random_scene(50, rest), antialiased=True, up=(0.0, 0.6, 0.8), unit="cm", origin=origin)
    write_scene(tmp_path / f"a{ending}", scene)
    back = read_scene(tmp_path / f"a{ending}")
    assert (back.antialiased, back.unit, back.origin) == (True, "cm", origin)
    np.testing.assert_allclose(back.up, scene.up, atol=1e-15)
    for name in ("means", "sh0", "sh_rest"):
        given, found = (getattr(s.gaussians, name) for s in (scene, back))
        assert torch.equal(given.view(torch.int32), found.view(torch.int32)), name
    check_close(back.gaussians, scene.gaussians, 1e-6)


@every_ending
def test_what_is_unknown_stays_unknown(tmp_path, ending):
    scene = Scene(random_scene(3, 0).gaussians)
    write_scene(tmp_path / f"a{ending}", scene)
    back = read_scene(tmp_path / f"a{ending}")
    assert (back.antialiased, back.up, back.unit, back.origin) == (None, None, None, (0.0, 0.0, 0.0))


@every_ending
def test_a_scene_without_splats_is_kept(tmp_path, ending):
    write_scene(tmp_path / f"a{ending}", Scene(random_scene(3, 8).gaussians.map(lambda t: t[:0])))
    back = read_scene(tmp_path / f"a{ending}").gaussians
    assert len(back) == 0 and back.sh_degree == 2


@every_ending
def test_usd_reads_what_is_written(tmp_path, ending):
    scene = replace(random_scene(20, 8), up=(0.0, 0.0, 1.0), unit="mm", origin=(1e6, 0.0, 0.5))
    path = tmp_path / "deep" / f"a scene{ending}"
    write_scene(path, scene)
    stage = Usd.Stage.Open(str(path))
    assert stage.GetDefaultPrim().GetPath() == "/scene"
    assert (UsdGeom.GetStageUpAxis(stage), UsdGeom.GetStageMetersPerUnit(stage)) == ("Y", 0.001)
    prim = UsdVol.ParticleField3DGaussianSplat.Get(stage, SPLATS)
    turned = half_turned(scene.gaussians)
    assert (np.array(prim.GetPositionsAttr().Get()) == turned.means.numpy()).all()
    first, expected = prim.GetOrientationsAttr().Get()[0], turned.quats[0] / turned.quats[0].norm()
    np.testing.assert_allclose([first.GetReal(), *first.GetImaginary()], expected, atol=1e-7)
    np.testing.assert_allclose(prim.GetScalesAttr().Get(), turned.scales, rtol=1e-6)
    np.testing.assert_allclose(prim.GetOpacitiesAttr().Get(), turned.opacities, rtol=1e-6)
    assert prim.GetRadianceSphericalHarmonicsDegreeAttr().Get() == 2
    assert prim.GetRadianceSphericalHarmonicsDegreeAttr().HasAuthoredValue()
    sh = np.array(prim.GetRadianceSphericalHarmonicsCoefficientsAttr().Get()).reshape(20, 9, 3)
    assert (sh[:, 0] == turned.sh0[:, 0].numpy()).all() and (sh[:, 1:] == turned.sh_rest.numpy()).all()
    assert prim.GetSortingModeHintAttr().Get() == "zDepth"
    low, high = np.array(prim.GetExtentAttr().Get())
    reach = 3.0 * turned.scales.numpy().max(axis=1, keepdims=True)
    assert (low <= turned.means.numpy() - reach + 1e-5).all()
    assert (high >= turned.means.numpy() + reach - 1e-5).all()
    # up and origin, in the stage's world: y, and the half-turned origin where up takes it
    world = np.array(UsdGeom.XformCache().GetLocalToWorldTransform(prim.GetPrim()))
    np.testing.assert_allclose(np.array([0.0, 0.0, -1.0]) @ world[:3, :3], [0, 1, 0], atol=1e-15)
    np.testing.assert_allclose(world[3, :3], np.array([1e6, 0, -0.5]) @ world[:3, :3], rtol=1e-15, atol=1e-9)


@every_ending
@pytest.mark.parametrize("count", [0, 30])
def test_validators_find_no_errors(tmp_path, ending, count):
    path = tmp_path / f"a{ending}"
    scene = replace(random_scene(30, 15), unit="m", origin=(1e6, 0.0, 0.5))
    write_scene(path, replace(scene, gaussians=scene.gaussians.map(lambda t: t[:count])))
    validators = UsdValidation.ValidationRegistry().GetOrLoadAllValidators()
    assert len(validators) > 20
    check = UsdValidation.ValidationContext(validators).Validate
    assert [error.GetMessage() for error in check(Usd.Stage.Open(str(path)))] == []
    # they do look: without its up axis and unit, the same stage has errors
    stage = Usd.Stage.Open(Usd.Stage.Open(str(path)).Flatten())
    for key in ("upAxis", "metersPerUnit"):
        stage.ClearMetadata(key)
    assert len(check(stage)) >= 2


def test_a_package_is_aligned_and_holds_one_layer_of_text(tmp_path):
    path = small_file(tmp_path, ".usdz")
    write_scene(tmp_path / "small.usda", random_scene(40, 3))
    with zipfile.ZipFile(path) as archive:
        assert archive.testzip() is None
        (entry,) = archive.infolist()
        text = archive.read(entry)
    assert (entry.filename, entry.compress_type, entry.flag_bits) == ("scene.usda", zipfile.ZIP_STORED, 0)
    assert text == (tmp_path / "small.usda").read_bytes()
    assert path.read_bytes().index(b"#usda 1.0") % 64 == 0


WRITE = """
import sys
sys.path[:0] = sys.argv[4:]
from dataclasses import replace
from gsplat_edu.io.formats import write_scene
from gsplat_edu.render.api import render
from scene_files import random_scene
for path in sys.argv[1:4]:
    write_scene(path, replace(random_scene(300), origin=(1e6, 2.0, 3.0), unit="m"))
"""


def test_the_same_scene_gives_the_same_bytes_in_every_process(tmp_path):
    written = []
    for seed in ("1", "2"):
        paths = [tmp_path / f"{seed}{ending}" for ending in ENDINGS]
        environment = os.environ | {"PYTHONHASHSEED": seed, "TZ": f"UTC{seed}"}
        words = [sys.executable, "-c", WRITE, *paths, *sys.path]
        subprocess.run(words, check=True, timeout=300, env=environment)
        written.append([path.read_bytes() for path in paths])
    assert written[0] == written[1]


@every_ending
@pytest.mark.parametrize("halves", [False, True])
def test_two_fields_of_another_program_under_transforms(tmp_path, ending, halves):
    """z up, in inches; one field is turned, scaled and moved by two prims, the other has fewer harmonics."""
    inch = 0.0254
    first, second = (random_scene(30, rest, seed).gaussians for rest, seed in ((15, 1), (3, 2)))
    layer = tmp_path / f"a{'.usdc' if ending == '.usdz' else ending}"
    stage = Usd.Stage.CreateNew(str(layer))
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
    UsdGeom.SetStageMetersPerUnit(stage, inch)
    outer = UsdGeom.Xform.Define(stage, "/world")
    outer.AddTranslateOp().Set(Gf.Vec3d(10, 20, 30))
    outer.AddRotateZOp().Set(30.0)
    inner = UsdGeom.Xform.Define(stage, "/world/part")
    inner.AddScaleOp().Set(Gf.Vec3f(2, 2, 2))
    inner.AddRotateXYZOp().Set(Gf.Vec3f(40, 50, 60))
    filled(stage, "/world/part/splats", first, halves=halves)
    filled(stage, "/more", second, halves=halves)
    world = np.array(UsdGeom.XformCache().GetLocalToWorldTransform(inner.GetPrim())).T
    stage.GetRootLayer().Save()
    path = layer
    if ending == ".usdz":
        path = tmp_path / "a.usdz"
        assert UsdUtils.CreateNewUsdzPackage(str(layer), str(path))
    back = read_scene(path)
    assert (back.unit, back.up) == ("m", None)
    upright = Similarity(Z_UP.R.T, inch, np.zeros(3))
    expected = [
        half_turned(upright.after(move).gaussians(gaussians))
        for move, gaussians in (
            (Similarity(np.eye(3), 1.0, np.zeros(3)), second),
            (Similarity.of_matrix(world), first),
        )
    ]
    order = [slice(30), slice(30, None)] if back.gaussians.sh_rest[:30, 3:].abs().max() == 0 else None
    order = order or [slice(30, None), slice(30)]
    for part, gaussians in zip(order, expected, strict=True):
        found = back.gaussians.map(lambda tensor, part=part: tensor[part])
        assert not found.sh_rest[:, gaussians.sh_rest.shape[1] :].any()
        found = replace(found, sh_rest=found.sh_rest[:, : gaussians.sh_rest.shape[1]])
        check_close(found, gaussians, 3e-3 if halves else 2e-5)


@pytest.mark.parametrize(
    ("meters", "unit", "size"), [(1.0, "m", 1), (0.01, "cm", 1), (None, None, 1), (2.0, "m", 2)]
)
def test_the_stages_unit_is_taken(tmp_path, meters, unit, size):
    stage = Usd.Stage.CreateNew(str(tmp_path / "a.usda"))
    if meters:
        UsdGeom.SetStageMetersPerUnit(stage, meters)
    scene = random_scene(3, 0)
    filled(stage, "/a", scene.gaussians)
    stage.Save()
    back = read_scene(tmp_path / "a.usda")
    assert back.unit == unit
    torch.testing.assert_close(back.gaussians.scales, size * scene.gaussians.scales)


def test_a_moved_file_of_ours_lies_where_it_was_moved(tmp_path):
    """Another program moves the scene and keeps our dictionary, which no longer says where the splats are."""
    scene = replace(random_scene(20, 3), up=(0.0, 0.6, 0.8), origin=(1e6, 0.0, 0.0))
    path = tmp_path / "a.usda"
    write_scene(path, scene)
    stage = Usd.Stage.Open(str(path))
    root = UsdGeom.Xform(stage.GetDefaultPrim())
    root.GetTranslateOp().Set(Gf.Vec3d(1, 2, 3))
    world = np.array(UsdGeom.XformCache().GetLocalToWorldTransform(root.GetPrim())).T
    stage.Save()
    back = read_scene(path)
    assert (back.origin, back.up, back.unit) == ((0.0, 0.0, 0.0), None, None)
    expected = half_turned(Similarity.of_matrix(world).gaussians(half_turned(scene.gaussians)))
    check_close(back.gaussians, expected)


def test_a_turned_field_looks_the_same_from_a_turned_camera(tmp_path):
    scene = random_scene(15, 15)
    stage = Usd.Stage.CreateNew(str(tmp_path / "a.usda"))
    prim = filled(stage, "/a", half_turned(scene.gaussians))
    prim.AddRotateXYZOp().Set(Gf.Vec3f(20, 130, 70))
    world = np.array(UsdGeom.XformCache().GetLocalToWorldTransform(prim.GetPrim())).T
    stage.Save()
    back = read_scene(tmp_path / "a.usda")
    signs = np.diag([1.0, -1.0, -1.0])
    move = Similarity(signs @ world[:3, :3] @ signs, 1.0, np.zeros(3))
    camera = Camera.looking_at((0.0, 0.0, -6.0), (0, 0, 0), 40.0, 40.0, 32, 32, (0.0, -1.0, 0.0))
    seen, turned = (
        render(gaussians, view).image.detach()
        for gaussians, view in ((scene.gaussians, camera), (back.gaussians, move.camera(camera)))
    )
    np.testing.assert_allclose(np.asarray(turned), np.asarray(seen), atol=1e-4)
    assert np.ptp(np.asarray(seen)) > 0.1


def changed(tmp_path, change):
    """Return a stage of another program with two splats, after a change."""
    path = tmp_path / "a.usda"
    stage = Usd.Stage.CreateNew(str(path))
    prim = filled(stage, "/world/a", random_scene(2, 3).gaussians)
    change(stage, prim)
    stage.Save()
    return path


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda s, p: p.AddScaleOp().Set(Gf.Vec3f(1, 2, 1)), "scales non-uniformly"),
        (lambda s, p: p.AddScaleOp().Set(Gf.Vec3f(-1, 1, 1)), "mirrors"),
        (lambda s, p: p.AddTranslateOp().Set(Gf.Vec3d(np.nan, 0, 0)), "NaN"),
        (lambda s, p: p.AddRotateXOp().Set(1.0, 2.0) and p.GetRotateXOp().Set(2.0, 3.0), "move over time"),
        (lambda s, p: [p.GetPositionsAttr().Set(p.GetPositionsAttr().Get(), t) for t in (1, 2)], "move over"),
        (lambda s, p: p.CreateScalesAttr([(1, 1, 1)]), "2 positions, but 1 scales, not 2"),
        (lambda s, p: p.CreateOpacitiesAttr([]), "but 0 opacities"),
        (lambda s, p: p.CreateOpacitiesAttr([0.5, 1.5]), "outside 0 to 1"),
        (lambda s, p: p.CreateOpacitiesAttr([0.5, np.nan]), "NaN"),
        (lambda s, p: p.CreateRadianceSphericalHarmonicsDegreeAttr(4), "degree 4; degrees 0 to 3"),
        (
            lambda s, p: p.CreateRadianceSphericalHarmonicsDegreeAttr(2),
            "but 8 radiance:sphericalHarmonicsCoe",
        ),
        (lambda s, p: p.MakeInvisible(), "its 1 prims of splats are invisible"),
        (lambda s, p: p.GetPrim().SetTypeName("Mesh"), "it holds Mesh"),
        (lambda s, p: s.RemovePrim("/world"), "it holds no shapes"),
        (lambda s, p: p.GetPrim().SetTypeName("ParticleField"), "no 3D Gaussians"),
        (lambda s, p: p.GetPrim().GetReferences().AddReference("../b.usda", "/b"), "another file, ../b.usda"),
        (lambda s, p: p.GetPrim().GetPayloads().AddPayload("/etc/b.usdc"), "another file, /etc/b.usdc"),
        (lambda s, p: s.GetRootLayer().subLayerPaths.append("c.usda"), "another file, c.usda"),
        (lambda s, p: p.GetPrim().SetMetadata("clips", {"default": {"active": Vt.Vec2dArray()}}), "clips"),
        (lambda s, p: UsdGeom.SetStageMetersPerUnit(s, -1.0), "metres per unit"),
    ],
)
def test_what_splats_cannot_be_is_said_in_one_line(tmp_path, change, said):
    message = refused(changed(tmp_path, change))
    assert said in message


def test_attributes_of_another_type_are_refused(tmp_path):
    path = changed(tmp_path, lambda s, p: None)
    text = path.read_text()
    for old, new in (("float[] opacities = ", "string[] opacities = "), ("quatf[] ori", "float4[] ori")):
        assert old in text
        swapped = text.replace(old, new)
        if "string" in new:
            start = swapped.index(new) + len(new)
            swapped = swapped[:start] + '["a", "b"]' + swapped[swapped.index("]", start) + 1 :]
        path.write_text(swapped)
        assert "of the type" in refused(path)


def test_layers_of_a_package_may_refer_to_one_another_but_not_out_of_it(tmp_path):
    scene = random_scene(4, 0)
    stage = Usd.Stage.CreateNew(str(tmp_path / "splats.usdc"))
    stage.SetDefaultPrim(filled(stage, "/a", half_turned(scene.gaussians)).GetPrim())
    stage.Save()
    stage = Usd.Stage.CreateNew(str(tmp_path / "default.usda"))
    stage.DefinePrim("/b").GetReferences().AddReference("./splats.usdc")
    stage.Save()
    assert "another file, ./splats.usdc" in refused(tmp_path / "default.usda")
    assert UsdUtils.CreateNewUsdzPackage(str(tmp_path / "default.usda"), str(tmp_path / "a.usdz"))
    check_close(read_scene(tmp_path / "a.usdz").gaussians, scene.gaussians)
    outside = (tmp_path / "default.usda").read_text().replace("./splats.usdc", str(tmp_path / "splats.usdc"))
    usd_package.write_package(tmp_path / "b.usdz", [("a.usda", [outside.encode()])], "")
    assert "another file" in refused(tmp_path / "b.usdz")


def test_prims_that_multiply_end_in_one_line(tmp_path):
    """Twenty prims, each with two references to the next one."""
    lines = ["#usda 1.0"]
    for level in range(20):
        inner = "".join(
            f'    def "{side}" (references = </l{level + 1}>) {{}}\n' for side in ("a", "b") if level < 19
        )
        lines.append(f'def Xform "l{level}" {{\n{inner}}}')
    (tmp_path / "a.usda").write_text("\n".join(lines))
    refused(tmp_path / "a.usda")


def test_a_section_beyond_the_end_costs_one_line(tmp_path):
    """Damage of this kind may crash usd-core, which therefore reads in a process of its own."""
    path = small_file(tmp_path, ".usdc")
    data = bytearray(path.read_bytes())
    toc = int.from_bytes(data[16:24], "little")
    data[toc + 8 + 16 : toc + 8 + 24] = (1 << 60).to_bytes(8, "little")
    path.write_bytes(data)
    refused(path)


@every_ending
def test_the_wrong_contents_of_a_name_are_refused(tmp_path, ending):
    other = ".usdc" if ending == ".usda" else ".usda"
    content = small_file(tmp_path, other).read_bytes()
    path = tmp_path / f"other{ending}"
    path.write_bytes(content)
    assert "does not begin with" in refused(path)


def test_what_needs_usd_core_says_so(tmp_path, monkeypatch):
    scene = random_scene(3)
    written = [small_file(tmp_path, ending) for ending in ENDINGS]
    monkeypatch.setitem(sys.modules, "pxr", None)
    for path in written:
        with pytest.raises(ArgumentError, match=r"needs usd-core.*\[usd\]"):
            read_scene(path)
    before = written[1].read_bytes()
    with pytest.raises(ArgumentError, match=r"needs usd-core.*\[usd\]"):
        write_scene(written[1], scene)
    assert written[1].read_bytes() == before
    for path in (written[0], written[2]):
        write_scene(path, scene)


def test_a_package_beyond_its_limit_is_refused(tmp_path):
    files = [("scene.usda", [bytes(10_000)] * 3)]
    with pytest.raises(ArgumentError, match=r"does not fit into the 2 GiB of a USDZ; write a \.usdc"):
        usd_package.write_package(tmp_path / "a.usdz", files, "write a .usdc", most=20_000)
    assert list(tmp_path.iterdir()) == []


def test_layers_are_not_kept_between_readings(tmp_path):
    path = small_file(tmp_path, ".usdc")
    assert len(read_scene(path).gaussians) == 40
    write_scene(path, random_scene(5))
    assert len(read_scene(path).gaussians) == 5
    assert not [layer for layer in Sdf.Layer.GetLoadedLayers() if layer.identifier.endswith("small.usdc")]
