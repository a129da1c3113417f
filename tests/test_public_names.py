import inspect
import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch

import gsplat_edu

SIGNATURES = {
    "Camera": "(R, eye, fx, fy, cx, cy, H, W)",
    "look_at": "(eye, target, up=(0.0, -1.0, 0.0))",
    "orbit_camera": "(azimuth, elevation, size, fx, radius=3.0)",
    "quat_to_R": "(quat)",
    "quat_to_R_batch": "(quats)",
    "build_cov3d": "(scale, R)",
    "build_cov3d_batch": "(scales, Rs)",
    "project_cov3d": "(cov3d, mean_cam, cam, *, jacobian_limit=None)",
    "render_gaussians": (
        "(cam, means, cov3ds, colors, opacities, bg=(0, 0, 0), z_near=0.05, "
        "*, extent='box3sigma', stop='box', jacobian_limit=None, dilation=0.3)"
    ),
    "sphere_shell": "(n=2500, s_t=0.06, s_n=0.01, opacity=0.8, seed=0)",
    "sh_basis": "(dirs)",
    "eval_sh": "(degree, sh, dirs)",
}
METHODS = {
    "looking_at": "(eye, target, fx, fy, H, W, up=(0.0, -1.0, 0.0))",
    "world_to_cam": "(self, points)",
    "project": "(self, points_cam)",
}


def bare_signature(function) -> str:
    signature = inspect.signature(function)
    bare = [p.replace(annotation=inspect.Parameter.empty) for p in signature.parameters.values()]
    return str(signature.replace(parameters=bare, return_annotation=inspect.Signature.empty))


def test_signatures_match_the_chapters():
    assert {name: bare_signature(getattr(gsplat_edu, name)) for name in SIGNATURES} == SIGNATURES
    assert {name: bare_signature(getattr(gsplat_edu.Camera, name)) for name in METHODS} == METHODS


def test_all_lists_every_public_name_once_and_nothing_else():
    public = {
        name
        for name, value in vars(gsplat_edu).items()
        if not name.startswith("_") and not inspect.ismodule(value)
    }
    assert sorted(public - {"LAZY", "TYPE_CHECKING", "annotations"} | set(gsplat_edu.LAZY)) == sorted(
        set(gsplat_edu.__all__) - {"render"}
    )


def test_names_that_need_torch_are_imported_on_first_use():
    for name in gsplat_edu.LAZY:
        assert getattr(gsplat_edu, name).__name__ == name
        assert name in dir(gsplat_edu)
    with pytest.raises(AttributeError, match="no attribute 'Gausians'"):
        _ = gsplat_edu.Gausians


def test_the_package_render_can_be_called():
    from gsplat_edu.render.api import render

    scene = gsplat_edu.Gaussians(
        means=torch.zeros(1, 3),
        quats=torch.tensor([[1.0, 0, 0, 0]]),
        log_scales=torch.full((1, 3), -1.0),
        sh0=torch.ones(1, 1, 3),
        sh_rest=torch.zeros(1, 0, 3),
        logit_opacities=torch.zeros(1),
    )
    camera = gsplat_edu.Camera.looking_at((0, 0, -3), (0, 0, 0), 40, 40, 24, 32)
    assert torch.equal(gsplat_edu.render(scene, camera).image, render(scene, camera).image)


def test_every_public_object_has_a_docstring():
    for name in gsplat_edu.__all__:
        value = getattr(gsplat_edu, name)
        if callable(value):
            assert value.__doc__, name


def test_importing_the_package_does_not_import_torch():
    code = "import sys, gsplat_edu; sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


USER = """
from pathlib import Path

import torch
from gsplat_edu import Camera, Gaussians, Scene, load_backend, load_dataset, read_scene, recipe, training, write_scene
from gsplat_edu.data.torch_dataset import ViewDataset
from gsplat_edu.mesh.extract import mesh_of
from gsplat_edu.ops.losses import photo_loss
from gsplat_edu.render.api import render
from gsplat_edu.scene.mesh import Mesh


def step(gaussians: Gaussians, camera: Camera, photo: torch.Tensor) -> float:
    output = render(gaussians, camera)
    loss = photo_loss(output.image, photo)
    loss.backward()  # type: ignore[no-untyped-call]
    output.save(Path("a.png"))
    return float(loss)


def made(folder: Path) -> tuple[Scene, Mesh, ViewDataset]:
    dataset = load_dataset(folder)
    trainer = training(recipe(30), dataset, load_backend())
    losses: list[float] = trainer.run().losses
    print(len(losses), trainer)
    write_scene("a.ply", trainer.gaussians[trainer.gaussians.opacities > 0.1])
    return read_scene("a.ply"), mesh_of(trainer.gaussians), dataset.torch("train", crop=(8, 8))


wrong: int = render(Gaussians, 3)
"""


@pytest.mark.slow
@pytest.mark.own_process
def test_a_users_file_is_typed(tmp_path):
    """The package has annotations for users (py.typed): the one mistake in a file is found, and nothing else."""
    (tmp_path / "user.py").write_text(USER)
    source = Path(gsplat_edu.__file__).parent
    assert (source / "py.typed").is_file()
    words = ["--strict", "--follow-imports=silent", f"--cache-dir={tmp_path / 'cache'}", "user.py"]
    found = subprocess.run(
        [sys.executable, "-m", "mypy", *words],
        cwd=tmp_path,
        env=os.environ | {"MYPYPATH": str(source.parent)},
        capture_output=True,
        text=True,
        check=False,
    )
    lines = [line for line in found.stdout.splitlines() if ": error: " in line]
    number = 1 + USER.splitlines().index("wrong: int = render(Gaussians, 3)")
    assert lines and all(line.startswith(f"user.py:{number}: ") for line in lines), (
        found.stdout + found.stderr
    )
