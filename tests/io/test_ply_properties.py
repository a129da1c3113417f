"""Properties of other programs' PLYs that change the meaning of others are applied, or refused by name."""

import math

import numpy as np
import pytest
import torch

from gsplat_edu.base.errors import SceneFormatError
from gsplat_edu.io.formats import read_scene
from gsplat_edu.io.ply import OTHER_KINDS, load_ply
from gsplat_edu.scene.gaussian_math import quat_to_R

NAMES = ["x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity", "scale_0", "scale_1", "scale_2"]
NAMES += ["rot_0", "rot_1", "rot_2", "rot_3"]


def write(path, rows, extra=(), leave_out=(), kind="float"):
    """Write an ASCII PLY of splats; rows are values by name."""
    names = [name for name in (*NAMES, *extra) if name not in leave_out]
    lines = ["ply", "format ascii 1.0", f"element vertex {len(rows)}"]
    lines += [f"property {kind} {name}" for name in names] + ["end_header"]
    lines += [" ".join(repr(float(row.get(name, 0.0))) for name in names) for row in rows]
    path.write_text("\n".join(lines) + "\n")
    return path


def splat(opacity, scales, **more):
    row = {"opacity": math.log(opacity / (1 - opacity)), "rot_0": 0.8, "rot_2": 0.6, "x": 1.0, **more}
    return row | {f"scale_{i}": math.log(value) for i, value in enumerate(scales)}


@pytest.mark.parametrize("name", ["filter_3D", "filter_3d"])
def test_the_filter_of_mip_splatting_is_a_convolution(tmp_path, name):
    """The splat 0.5 exp(-x' S^-1 x / 2) convolved with a unit-mass Gaussian, by quadrature over R^3 at five points.

    The integrand is a Gaussian, for which the trapezoidal rule over 8 standard deviations at a sixth of the smallest is
    exact to 1e-12; float32 parameters give 1e-6.
    """
    scales, f, opacity = np.array([0.3, 0.5, 0.9]), 0.4, 0.5
    path = write(tmp_path / "a.ply", [splat(opacity, scales, **{name: f})], [name])
    fused = load_ply(path)
    R = quat_to_R(fused.quats[0].double().numpy())
    got = fused.log_scales[0].double().exp().numpy()
    peak = float(torch.sigmoid(fused.logit_opacities[0].double()))
    step = 0.05
    grid = np.arange(-8 * f, 8 * f + step / 2, step)
    rng = np.random.default_rng(0)
    for at in rng.normal(size=(5, 3)) * 0.5:
        # both Gaussians have the splat's axes, so the integral over R^3 is a product of three
        along = R.T @ at
        product = 1.0
        for axis in range(3):
            kernel = np.exp(-((grid / f) ** 2) / 2) / (f * math.sqrt(2 * math.pi))
            product *= float(
                np.sum(np.exp(-(((along[axis] - grid) / scales[axis]) ** 2) / 2) * kernel) * step
            )
        value = peak * math.exp(-float(np.sum((along / got) ** 2)) / 2)
        assert value == pytest.approx(opacity * product, rel=1e-5)


def test_filters_of_any_size(tmp_path):
    """Expected values by Python's floats; those of tiny scales, which underflow there, by logarithms."""
    cases = [(0.9, (1.0, 2.0, 3.0), 0.5), (0.2, (1e-4, 1.0, 1.0), 0.01), (1 - 1e-9, (1.0, 1.0, 1.0), 1e-6)]
    rows = [splat(o, s, filter_3D=f) for o, s, f in cases]
    scene = read_scene(write(tmp_path / "a.ply", rows, ["filter_3D"], kind="double"))
    for i, (opacity, scales, f) in enumerate(cases):
        after = [math.hypot(s, f) for s in scales]
        expected = opacity * math.prod(scales) / math.prod(after)
        torch.testing.assert_close(
            scene.gaussians.log_scales[i].exp().double(), torch.tensor(after).double(), rtol=1e-6, atol=0
        )
        got = torch.sigmoid(scene.gaussians.logit_opacities[i].double())
        # a logit of up to 21 has an error of 1e-6 in float32, so 1 - o has that relative error
        assert float(got) == pytest.approx(expected, rel=1e-6)
    tiny = splat(0.5, (1.0, 1.0, 1.0), filter_3D=2.0) | {"scale_0": -600.0, "opacity": 200.0}
    fused = load_ply(write(tmp_path / "b.ply", [tiny], ["filter_3D"]))
    assert float(fused.log_scales[0, 0]) == pytest.approx(math.log(2.0), rel=1e-6)
    # log of the ratio: -600 - log 2 for the tiny axis, -log(5) / 2 for each of the others
    assert float(fused.logit_opacities[0]) == pytest.approx(-600 - math.log(2) - math.log(5), rel=1e-6)


def test_a_filter_of_zero_changes_no_bit(tmp_path):
    rows = [splat(0.3, (0.1, 0.2, 0.3)), splat(0.7, (1.0, 2.0, 3.0)) | {"opacity": float("inf")}]
    plain, filtered = (
        load_ply(write(tmp_path / f"{len(extra)}.ply", rows, extra)) for extra in ([], ["filter_3D"])
    )
    for name, tensor in plain.tensors().items():
        assert torch.equal(tensor, filtered.tensors()[name]), name


def test_a_filter_that_is_nan_is_named(tmp_path):
    path = write(tmp_path / "a.ply", [splat(0.3, (1, 1, 1), filter_3D=float("nan"))], ["filter_3D"])
    with pytest.raises(SceneFormatError, match="vertex 0: filter_3D is nan"):
        load_ply(path)


@pytest.mark.parametrize("pattern", OTHER_KINDS)
def test_other_kinds_of_splats_are_refused_by_name(tmp_path, pattern):
    name = pattern.replace("*", "0")
    path = write(tmp_path / "a.ply", [splat(0.3, (1, 1, 1))], [name])
    with pytest.raises(SceneFormatError, match=rf"its splats .*: property {name}; export") as caught:
        read_scene(path)
    assert "\n" not in str(caught.value)


def test_flat_disks_are_refused_by_name(tmp_path):
    path = write(tmp_path / "a.ply", [splat(0.3, (1, 1, 1))], leave_out=["scale_2"])
    with pytest.raises(SceneFormatError, match="2D Gaussian Splatting.*lacks scale_2"):
        read_scene(path)


def test_labels_are_ignored(tmp_path):
    rows = [splat(0.3, (0.1, 0.2, 0.3), segment_id=4, red=7)]
    extra = ["segment_id", "red", "semantic_0", "features_0", "lod", "instance_id"]
    plain, labelled = (load_ply(write(tmp_path / f"{len(e)}.ply", rows, e)) for e in ([], extra))
    for name, tensor in plain.tensors().items():
        assert torch.equal(tensor, labelled.tensors()[name]), name
