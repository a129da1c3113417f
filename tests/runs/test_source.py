import numpy as np
import pytest
import torch

from gsplat_edu.base.errors import ArgumentError, CheckpointError
from gsplat_edu.io.formats import write_scene
from gsplat_edu.io.scene import Scene
from gsplat_edu.runs.folder import RunFolder
from gsplat_edu.runs.source import CAPTURE_JACOBIAN_LIMIT, open_source
from scene_files import RUN_UP, make_run, random_scene


@pytest.mark.parametrize("by_file", [False, True])
def test_a_scene_of_a_run_has_the_runs_cameras_and_settings(tmp_path, by_file):
    folder, gaussians, cameras = make_run(tmp_path / "run")
    source = open_source(folder.scene(7) if by_file else folder.path)
    assert torch.equal(source.scene.gaussians.means, gaussians.means)
    assert source.scene.antialiased is True and source.settings.antialiased
    assert source.settings.background == (1.0, 0.5, 0.0)
    np.testing.assert_allclose(source.scene.up, RUN_UP, atol=1e-12)
    # The run's file lists training views first, the source has the capture's order.
    assert [name for name, _ in source.cameras] == [
        "0.00.jpg",
        "1.26.jpg",
        "2.51.jpg",
        "3.77.jpg",
        "5.03.jpg",
    ]
    assert source.held_out == {"0.00.jpg"}
    for (_, found), camera in zip(source.cameras, [cameras[-1], *cameras[:-1]], strict=True):
        np.testing.assert_array_equal(found.eye, camera.eye)


def test_far_from_zero_scene_and_cameras_are_relative_to_the_runs_origin(tmp_path):
    origin = (4096.0, -8192.0, 16384.0)
    folder, gaussians, cameras = make_run(tmp_path / "run", origin)
    source = open_source(folder.path)
    assert source.origin == origin
    assert torch.equal(source.scene.gaussians.means, gaussians.means)
    np.testing.assert_allclose(source.cameras[1][1].eye, cameras[0].eye, atol=1e-11)


def test_a_scene_file_is_rendered_with_its_own_settings(tmp_path):
    write_scene(tmp_path / "a.ply", random_scene(10))
    source = open_source(tmp_path / "a.ply")
    assert source.cameras == () and source.scene.up == (0.0, -1.0, 0.0)
    assert not source.settings.antialiased
    assert source.settings.jacobian_limit == CAPTURE_JACOBIAN_LIMIT
    probes = source.probes(3, 64)
    assert len(probes) == 3 and all((camera.W, camera.H) == (64, 64) for _, camera in probes)


def test_probe_cameras_are_small_and_spread_evenly(tmp_path):
    source = open_source(make_run(tmp_path / "run")[0].path)
    assert [name for name, _ in source.probes(2, 30)] == ["0.00.jpg", "2.51.jpg"]
    assert [(camera.W, camera.H) for _, camera in source.probes(9, 30)] == [(30, 20)] * 5
    assert source.probes(9, 100)[0][1] is source.cameras[0][1]


def test_a_path_without_a_scene_is_a_one_line_error(tmp_path):
    with pytest.raises(ArgumentError, match="does not exist; give a scene file"):
        open_source(tmp_path / "gone.ply")
    with pytest.raises(ArgumentError, match="is not a run"):
        open_source(tmp_path)
    RunFolder(tmp_path / "run").write_config({})
    with pytest.raises(CheckpointError, match="contains no scene"):
        open_source(tmp_path / "run")


def test_an_origin_is_subtracted_once_and_in_double():
    gaussians = random_scene(4).gaussians
    scene = Scene(gaussians, origin=(7.0, 0.0, 0.0))
    assert scene.relative_to((7.0, 0.0, 0.0)) is gaussians
    moved = scene.relative_to((1.0, 2.0, 3.0))
    assert torch.equal(moved.means, (gaussians.means.double() + torch.tensor([6.0, -2.0, -3.0])).float())
