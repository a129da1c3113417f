import inspect
import subprocess
import sys

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
    assert sorted(public) == sorted(gsplat_edu.__all__)


def test_every_public_object_has_a_docstring():
    for name in gsplat_edu.__all__:
        value = getattr(gsplat_edu, name)
        if callable(value):
            assert value.__doc__, name


def test_importing_the_package_does_not_import_torch():
    code = "import sys, gsplat_edu; sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
