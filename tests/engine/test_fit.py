"""What does not fit a device is one line that says what would: limits are forced down, and buffers really allocated."""

import re

import numpy as np
import pytest
import torch

from engine.frames import packed, plain_view, view_of
from gsplat_edu.base.errors import BackendUnavailableError
from gsplat_edu.cli.main import main
from gsplat_edu.data.procedural import procedural_capture
from gsplat_edu.data.writers import write_colmap
from gsplat_edu.engine import frame, host
from gsplat_edu.engine.fit import HARMONICS, most_that_fit, why_too_large
from gsplat_edu.engine.frame import draw_frame
from gsplat_edu.engine.passes import LIMITS
from gsplat_edu.engine.step import step_program
from gsplat_edu.io.ply import save_ply
from gsplat_edu.render.webgpu.render import rendering_with
from native_scenes import random

DEFAULT = LIMITS["max-storage-buffer-binding-size"]


def tight(most):
    return host.Device(limits=LIMITS | {"max-storage-buffer-binding-size": most})


def counts_of(gaussians, degree, pairs=4096, pixels=100):
    rest = gaussians * HARMONICS[degree]
    return {"gaussians": gaussians, "rest": rest, "pixels": pixels, "edges": 3, "pairs": pairs, "live": 8}


def test_a_browser_s_default_holds_745654_gaussians_of_degree_3():
    program = step_program(8)
    for degree, expected in ((3, 745654), (2, 1398101), (1, 2097152), (0, 2097152)):
        assert most_that_fit(program, counts_of(1000, degree), DEFAULT, "gaussians") == expected
        assert why_too_large(program, counts_of(expected, degree), DEFAULT, "A") is None
        assert why_too_large(program, counts_of(expected + 1, degree), DEFAULT, "A") is not None
    assert most_that_fit(program, counts_of(1, 3), DEFAULT, "pairs") == 3355443
    assert most_that_fit(program, counts_of(1, 3), DEFAULT, "pixels") == 3728270


def test_the_line_names_what_fits_and_the_remedy():
    program = step_program(8)
    line = why_too_large(program, counts_of(10**6, 3), DEFAULT, "A")
    assert line.startswith("the buffer rest needs 172 MiB for 1000000 gaussians, ")
    assert line.endswith(
        "but A allows 128: 745654 gaussians fit; all fit with `sh_degree=2`; train with a lower "
        "`max_gaussians` or `sh_degree`, reduce the scene"
    )
    line = why_too_large(program, counts_of(3 * 10**6, 3), DEFAULT, "A")
    assert "745654 gaussians fit; train with a lower `max_gaussians` or `sh_degree`" in line
    line = why_too_large(program, counts_of(3 * 10**6, 0), DEFAULT, "A")
    assert "2097152 gaussians fit; train with a lower `max_gaussians`, reduce" in line
    line = why_too_large(program, counts_of(10, 0, pairs=4 * 10**6), DEFAULT, "A")
    assert "3355443 pairs fit; make the image smaller (`resolution`, `size`), lower `max_gaussians`" in line
    line = why_too_large(program, counts_of(10, 0, pixels=4 * 10**6), DEFAULT, "A")
    assert "3728270 pixels fit; make the image smaller (`resolution`, `size`)" in line


@pytest.mark.parametrize("count", [364, 365])
def test_as_many_as_the_line_names_are_drawn_and_one_more_is_refused(count):
    """64 KiB hold 45 harmonics of 364 Gaussians: the device itself enforces the limit for those that are drawn."""
    scene = random(count, (40, 24), seed=1, log_scales=np.full((count, 3), -4.0))
    pool = frame.Pool(tight(1 << 16), most=0)
    pool._pairs[(count, view_of(scene).tiles)] = 1600
    if count == 364:
        assert len(draw_frame(pool, packed(scene), view_of(scene)).visible) > 0
    else:
        with pytest.raises(
            BackendUnavailableError, match=r": 364 gaussians fit; all fit with `sh_degree=2`"
        ) as raised:
            draw_frame(pool, packed(scene), view_of(scene))
        assert re.fullmatch(r"backend 'webgpu': .*, or use the backend cpu", str(raised.value))


def test_an_image_with_too_many_pairs_is_refused_once_they_are_counted():
    scene = random(300, (100, 80), seed=1, log_scales=np.full((300, 3), -1.0))
    with pytest.raises(
        BackendUnavailableError, match=r"the buffer slots needs .* 6553 pairs fit; make the image"
    ):
        draw_frame(frame.Pool(tight(1 << 18)), packed(scene), view_of(scene))


def test_an_image_that_is_too_large_is_refused():
    scene = packed(random(3, (8, 8)))
    with pytest.raises(
        BackendUnavailableError, match=r"the buffer image needs .* 10922 pixels fit; make the image"
    ):
        draw_frame(frame.Pool(tight(1 << 18)), scene, plain_view(128, 128))


@pytest.fixture
def narrow():
    """Let the backend use a device with small buffers."""
    with rendering_with(frame.Pool(tight(1 << 18))):
        yield


@pytest.mark.usefixtures("narrow")
def test_commands_say_it_in_one_line_and_write_nothing(tmp_path, capsys):
    save_ply(tmp_path / "a.ply", random(2000, (8, 8)).gaussians(torch.float32))
    command = ["render", str(tmp_path / "a.ply"), "--frames", "1", "--size", "20", "--backend", "webgpu"]
    assert main([*command, "--out", str(tmp_path / "frames")]) == 2
    line = capsys.readouterr().err.splitlines()[-1]
    assert "1456 gaussians fit; all fit with --sh-degree 2; train with a lower --max-gaussians" in line
    write_colmap(tmp_path / "egg", *procedural_capture(120, 4, splats=80))
    command = ["train", str(tmp_path / "egg"), "--out", str(tmp_path / "run"), "--backend", "webgpu"]
    assert main([*command, "--iterations", "5"]) == 2
    line = capsys.readouterr().err.splitlines()[-1]
    assert (
        "hold a view of 7,281 pixels, but photos have 120x90; give --resolution 90, or --backend cpu" in line
    )
    assert not list((tmp_path / "run").glob("**/*.ply"))
