import numpy as np
import pytest
import torch

from gsplat_edu.gaussians import Gaussians
from gsplat_edu.io.ply import save_ply


def random_gaussians(count, rest):
    generator = torch.Generator().manual_seed(0)
    shapes = {
        "means": (count, 3),
        "quats": (count, 4),
        "log_scales": (count, 3),
        "sh0": (count, 1, 3),
        "sh_rest": (count, rest, 3),
        "logit_opacities": (count,),
    }
    return Gaussians(**{name: torch.randn(*shape, generator=generator) for name, shape in shapes.items()})


def parse(path):
    """Read the file as a viewer would: by the names in its header."""
    header, body = path.read_bytes().split(b"end_header\n", 1)
    lines = header.decode("ascii").splitlines()
    assert lines[:2] == ["ply", "format binary_little_endian 1.0"]
    count = int(lines[2].removeprefix("element vertex "))
    names = [line.removeprefix("property float ") for line in lines[3:]]
    table = np.frombuffer(body, dtype=[(name, "<f4") for name in names])
    assert len(table) == count
    return names, table


@pytest.mark.parametrize("rest", [0, 3, 8, 15])
def test_properties_are_inrias_by_name(tmp_path, rest):
    gaussians = random_gaussians(7, rest)
    save_ply(tmp_path / "new" / "scene.ply", gaussians)
    names, table = parse(tmp_path / "new" / "scene.ply")
    expected = ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"]
    expected += [f"f_rest_{i}" for i in range(3 * rest)]
    expected += ["opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]
    assert names == expected

    np.testing.assert_array_equal(table["y"], gaussians.means[:, 1].numpy())
    np.testing.assert_array_equal(table["ny"], 0)
    np.testing.assert_array_equal(table["f_dc_2"], gaussians.sh0[:, 0, 2].numpy())
    np.testing.assert_array_equal(table["opacity"], gaussians.logit_opacities.numpy())
    np.testing.assert_array_equal(table["scale_1"], gaussians.log_scales[:, 1].numpy())
    np.testing.assert_array_equal(table["rot_0"], gaussians.quats[:, 0].numpy())
    for channel in range(3):
        for k in range(rest):
            values = table[f"f_rest_{channel * rest + k}"]
            np.testing.assert_array_equal(values, gaussians.sh_rest[:, k, channel].numpy())


def test_an_empty_scene_is_a_file(tmp_path):
    save_ply(tmp_path / "empty.ply", random_gaussians(0, 15))
    assert len(parse(tmp_path / "empty.ply")[1]) == 0


def test_gradients_and_float64_are_no_obstacle(tmp_path):
    save_ply(tmp_path / "a.ply", random_gaussians(3, 0).map(torch.Tensor.double).trainable())
    assert len(parse(tmp_path / "a.ply")[1]) == 3


def test_a_failed_write_leaves_the_old_file(tmp_path, monkeypatch):
    path = tmp_path / "scene.ply"
    save_ply(path, random_gaussians(2, 0))
    before = path.read_bytes()

    def disk_full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("pathlib.Path.write_bytes", disk_full)
    with pytest.raises(OSError, match="No space"):
        save_ply(path, random_gaussians(5, 0))
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path], "and nothing beside it"
