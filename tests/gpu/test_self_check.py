"""The check that the backend cuda has to pass on a device before its first use."""

import pytest
import torch

from gsplat_edu.base.errors import BackendUnavailableError, BackendWarning
from gsplat_edu.cli.main import main
from gsplat_edu.io.ply import save_ply
from gsplat_edu.ops import kernels
from gsplat_edu.render import backends
from gsplat_edu.render.backends import resolve_backend
from gsplat_edu.render.cuda import check, render as rasterize
from gsplat_edu.render.self_check import check_scene

EXACT = backends.load_backend("torch").rasterize


@pytest.fixture(autouse=True)
def empty_cache(monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    check.forget_checks()
    backends.warn_once.cache_clear()
    yield tmp_path / "gsplat_edu/cuda_passed.json"
    check.forget_checks()


def test_correct_kernels_are_checked_once(device, empty_cache, monkeypatch):
    assert check.cuda_failure(EXACT, torch.device(device)) is None
    assert "triton" in empty_cache.read_text()
    check.forget_checks()  # a new process starts like this
    monkeypatch.setattr(check, "kernel_error", lambda exact, device: "checked again")
    assert check.cuda_failure(EXACT, torch.device(device)) is None


def test_changed_kernels_are_checked_again(device, empty_cache, monkeypatch):
    empty_cache.parent.mkdir()
    for content in ("{", "[" * 100_000, '{"a": 1}', '["another device"]', "[1]"):
        empty_cache.write_text(content)
        monkeypatch.setattr(check, "kernel_error", lambda exact, device: "checked again")
        check.forget_checks()
        assert check.cuda_failure(EXACT, torch.device(device)) == "checked again"


def test_a_shifted_image_fails(device, empty_cache, monkeypatch):
    right = rasterize.camera_row

    def shifted(call, device):
        row = right(call, device).clone()
        row[torch.isclose(row, torch.tensor(23.1, device=row.device))] += 0.01
        return row

    monkeypatch.setattr(rasterize, "camera_row", shifted)
    assert "the image of a test scene is wrong by" in check.cuda_failure(EXACT, torch.device(device))
    assert not empty_cache.exists()


@pytest.mark.parametrize("name", rasterize.RAW)
def test_a_gradient_that_is_one_percent_too_large_fails(device, monkeypatch, name):
    right = rasterize.render_triton

    def wrong(gaussians, camera, settings, background):
        def perturbed(tensor):
            moved = tensor * 1.0
            if tensor is gaussians.tensors()[name]:
                moved.register_hook(lambda gradient: 1.01 * gradient)
            return moved

        return right(gaussians.map(perturbed), camera, settings, background)

    monkeypatch.setattr(rasterize, "render_triton", wrong)
    assert f"the gradient of {name} is wrong by 0.01" in check.cuda_failure(EXACT, torch.device(device))


@pytest.mark.skipif(kernels.REASON is None and torch.cuda.is_available(), reason="this machine has a GPU")
def test_auto_uses_the_cpu_if_the_kernels_do_not_run(monkeypatch, tmp_path, capsys):
    """torch's CPU build acts like a GPU whose driver fails, because the first CUDA call raises."""
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setenv("TRITON_INTERPRET", "0")
    with pytest.warns(
        BackendWarning, match=r"^the GPU is not used: its kernels failed their check on this GPU: "
    ):
        assert resolve_backend("auto") == "cpu"
    with pytest.raises(BackendUnavailableError, match=r"^backend 'cuda': .*; the backend cpu needs no GPU$"):
        resolve_backend("cuda")

    backends.warn_once.cache_clear()
    save_ply(tmp_path / "a.ply", check_scene(torch.float32))
    out = tmp_path / "frames"
    command = ["render", str(tmp_path / "a.ply"), "--frames", "1", "--size", "20", "--out", str(out)]
    assert main(command) == 0
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1 and lines[0].startswith(
        "gsplat-edu render: the GPU is not used: its kernels failed"
    )
    assert len(list(out.iterdir())) == 1
