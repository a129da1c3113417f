from dataclasses import replace

import numpy as np
import pytest
import torch

from gsplat_edu.base.constants import C0
from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.io.ply import load_ply
from gsplat_edu.io.scene import Scene
from gsplat_edu.io.splat import MIN_SCALE, read, write
from scene_files import kept_file, random_scene, refused

ROW = np.dtype([("position", "<f4", 3), ("scales", "<f4", 3), ("rgba", "u1", 4), ("quat", "u1", 4)])
GOOD = ((1, 2, 3), (0.5, 1, 2), (255, 0, 51, 204), (128, 0, 192, 255))


def by_hand(path, rows):
    path.write_bytes(np.array(rows, dtype=ROW).tobytes())


def importance(gaussians):
    """Return opacity times volume, by which a file is sorted."""
    return gaussians.opacities.double() * torch.exp(gaussians.log_scales.double().sum(dim=1))


def test_a_handmade_file_is_read(tmp_path):
    by_hand(tmp_path / "a.splat", [GOOD, ((-4, -5, -6), (1, 1, 1), (0, 102, 0, 0), (128, 128, 128, 128))])
    scene = read(tmp_path / "a.splat")
    g = scene.gaussians
    assert (scene.antialiased, scene.up, g.sh_degree, g.sh_rest.shape) == (None, None, 0, (2, 0, 3))
    assert {tensor.dtype for tensor in g.tensors().values()} == {torch.float32}
    np.testing.assert_array_equal(g.means.numpy(), [[1, 2, 3], [-4, -5, -6]])  # axes are those of the file
    np.testing.assert_allclose(g.log_scales.numpy(), [np.log([0.5, 1, 2]), [0, 0, 0]], rtol=1e-6)
    colors = np.array([[1, 0, 0.2], [0, 0.4, 0]])
    np.testing.assert_allclose(g.sh0.numpy()[:, 0], (colors - 0.5) / C0, rtol=1e-5)
    # Byte 0 is read as a quarter of a step above 0, so that its logit is finite.
    np.testing.assert_allclose(g.opacities.numpy(), [0.8, 0.25 / 255], rtol=1e-5)
    # w, x, y, z in steps of 1/128. A quaternion of four zeros becomes the identity.
    np.testing.assert_array_equal(g.quats.numpy(), [[0, -1, 0.5, 127 / 128], [1, 0, 0, 0]])


def test_the_layout_of_a_written_file(tmp_path):
    g = random_scene(1, 3).gaussians
    path = tmp_path / "new" / "a.splat"
    write(path, Scene(replace(g, quats=torch.tensor([[0.0, -2.0, 0.0, 0.0]]))))
    (row,) = np.frombuffer(path.read_bytes(), dtype=ROW)
    np.testing.assert_array_equal(row["position"], g.means[0].numpy())
    np.testing.assert_allclose(row["scales"], g.scales[0].numpy(), rtol=1e-6)
    assert row["rgba"].tolist() == [
        *np.clip(np.rint(255 * (C0 * g.sh0[0, 0].double().numpy() + 0.5)), 0, 255),
        np.rint(255 * g.opacities[0].double().item()),
    ]
    assert row["quat"].tolist() == [128, 0, 128, 128]


@pytest.mark.parametrize("count", [0, 1, 257, 1000])
@pytest.mark.parametrize("rest", [0, 15])
def test_a_round_trip_stays_within_half_a_step(tmp_path, rest, count):
    scene, path = random_scene(count, rest), tmp_path / "a.splat"
    write(path, scene)
    assert path.stat().st_size == 32 * count
    back = read(path).gaussians
    assert len(back) == count and back.sh_degree == 0

    place = {tuple(mean): i for i, mean in enumerate(scene.gaussians.means.tolist())}  # means keep their bits
    order = torch.tensor([place[tuple(mean)] for mean in back.means.tolist()], dtype=torch.int64)
    given = scene.gaussians.map(lambda tensor: tensor[order])
    assert len(set(order.tolist())) == count

    # The scale and its logarithm are both rounded to float32: each is off by 2^-24 of itself.
    before, after = given.log_scales.double(), back.log_scales.double()
    assert ((after - before).abs() <= 2.0**-24 * (2 + before.abs() + after.abs())).all()
    assert ((back.opacities - given.opacities).abs() <= 0.5 / 255 + 1e-6).all()
    colors = (C0 * given.sh0 + 0.5).clamp(0, 1)
    assert ((C0 * back.sh0 + 0.5 - colors).abs() <= 0.5 / 255 + 1e-6).all()
    quats = torch.nn.functional.normalize(given.quats, dim=1)
    # Half a step of 1/128. The largest value of a byte is 127/128.
    assert ((back.quats - quats.clamp(max=127 / 128)).abs() <= 0.5 / 128 + 1e-6).all()


def test_splats_are_sorted_by_importance(tmp_path):
    write(tmp_path / "a.splat", random_scene(500))
    values = importance(read(tmp_path / "a.splat").gaussians)
    # Splats are sorted by the stored bytes, but bytes 0 and 255 are read a quarter of a step inside.
    assert (values[1:] <= values[:-1] * (1 + 0.25 / 254) + 1e-12).all()


def test_ties_keep_their_order(tmp_path):
    g = random_scene(1000).gaussians
    large = (torch.arange(1000) % 2).bool()
    log_scales = torch.where(large, 0.0, -1.0)[:, None].repeat(1, 3)
    write(tmp_path / "a.splat", Scene(replace(g, log_scales=log_scales, logit_opacities=torch.zeros(1000))))
    back = read(tmp_path / "a.splat").gaussians
    assert torch.equal(back.means, torch.cat([g.means[large], g.means[~large]]))


def test_values_out_of_range_are_clamped(tmp_path):
    g = random_scene(4, 0).gaussians
    scene = Scene(
        replace(
            g,
            log_scales=torch.tensor([200.0, 0.0, -50.0, -3e38])[:, None].repeat(1, 3),
            sh0=torch.tensor([3e38, -3e38, 5.0, -5.0])[:, None, None].repeat(1, 1, 3),
            logit_opacities=torch.tensor([400.0, 3e38, 400.0, 400.0]),
        )
    )
    write(tmp_path / "a.splat", scene)
    back = read(tmp_path / "a.splat").gaussians
    largest, smallest = np.log(np.finfo(np.float32).max), np.log(MIN_SCALE)
    np.testing.assert_allclose(back.log_scales[:, 0].numpy(), [largest, 0, -50, smallest], rtol=1e-6)
    np.testing.assert_allclose(C0 * back.sh0[:, 0, 0].numpy() + 0.5, [1, 0, 1, 0], atol=1e-6)
    np.testing.assert_allclose(back.logit_opacities.numpy(), np.log(254.75 / 0.25), rtol=1e-6)


def test_a_scale_of_zero_becomes_the_smallest_float(tmp_path):
    by_hand(tmp_path / "a.splat", [((0, 0, 0), (0, -0.0, 1e-45), (0, 0, 0, 0), (255, 128, 128, 128))])
    log_scales = read(tmp_path / "a.splat").gaussians.log_scales
    np.testing.assert_allclose(log_scales.numpy(), np.log(2.0**-149), rtol=1e-6)


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("quats", 0.0, r"quats\[3\]: has zero length"),
        ("log_scales", np.inf, r"log_scales\[3, 0\]: is NaN or infinite"),
        ("means", 1e300, r"means\[3, 0\]: is NaN or infinite"),
    ],
)
def test_values_that_cannot_be_written_are_named(tmp_path, name, value, message):
    scene = Scene(random_scene(5).gaussians.map(torch.Tensor.double))
    scene.gaussians.tensors()[name][3] = value
    with pytest.raises(ArgumentError, match=message):
        write(tmp_path / "a.splat", scene)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("axis", range(3))
@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        *[("position", value, "a position that is NaN or infinite") for value in (np.nan, np.inf, -np.inf)],
        *[
            ("scales", value, "a scale that is NaN, infinite or negative")
            for value in (np.nan, np.inf, -1e-30)
        ],
    ],
)
def test_invalid_numbers_are_named(tmp_path, name, value, message, axis):
    rows = np.array([GOOD] * 5, dtype=ROW)
    rows[name][[2, 4], axis] = value
    by_hand(tmp_path / "a.splat", rows)
    assert f"splat 2 has {message} (2 such splats in all)" in refused(tmp_path / "a.splat")


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 1\n   ", "is a Git LFS pointer"),
        (b"ply\nformat ascii 1.0\nelement vertex 0\nend_header\n".ljust(64), "is a PLY, not a .splat"),
        (b"<!DOCTYPE html><html>not found</html>", "37 bytes, 5 more than whole splats of 32"),
    ],
)
def test_other_files_are_refused_by_kind(tmp_path, content, message):
    (tmp_path / "a.splat").write_bytes(content)
    assert message in refused(tmp_path / "a.splat")


def test_a_missing_file_stays_an_oserror(tmp_path):
    with pytest.raises(FileNotFoundError):
        read(tmp_path / "gone.splat")


def test_the_same_splats_as_in_a_ply():
    name = "formats/metalsplatter_3splats/test-splat.3-points-from-train"
    splats = read(kept_file(f"{name}.splat")).gaussians
    ply = load_ply(kept_file(f"{name}.ply"))
    np.testing.assert_array_equal(splats.means.numpy(), ply.means.numpy())
    np.testing.assert_allclose(splats.log_scales.numpy(), ply.log_scales.numpy(), rtol=1e-6)
    # Its writer truncates where ours rounds, so values differ by up to a step.
    colors = (C0 * ply.sh0 + 0.5).clamp(0, 1)
    assert ((C0 * splats.sh0 + 0.5 - colors).abs() <= 1 / 255 + 1e-6).all()
    assert ((splats.opacities - ply.opacities).abs() <= 1 / 255 + 1e-6).all()
    quats = torch.nn.functional.normalize(ply.quats, dim=1)
    assert ((splats.quats - quats).abs() <= 1 / 128 + 1e-6).all()


def test_a_file_from_another_program():
    g = read(kept_file("formats/splat_fixtures/minimal.splat")).gaussians
    np.testing.assert_array_equal(g.means.numpy(), [[-1, 0, -1], [0, 0, -1], [-1, 0, 0], [0, 0, 0]])
    np.testing.assert_allclose(g.scales.numpy(), 0.1, rtol=1e-6)
    np.testing.assert_array_equal(g.quats.numpy(), [[0, 0, 0, 127 / 128]] * 4)
    np.testing.assert_allclose(g.opacities.numpy(), 230 / 255, rtol=1e-6)
