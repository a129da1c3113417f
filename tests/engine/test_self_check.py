"""The check that the backend webgpu must pass on an adapter before it is used there."""

import pytest

from gsplat_edu.base.errors import BackendUnavailableError
from gsplat_edu.engine import host
from gsplat_edu.engine.frame import Pool
from gsplat_edu.engine.passes import LIMITS, MODULES
from gsplat_edu.render.backends import load_backend, resolve_backend
from gsplat_edu.render.webgpu import check, render as webgpu

EXACT = load_backend("cpu").rasterize

pytestmark = pytest.mark.usefixtures("webgpu")


@pytest.fixture(autouse=True)
def empty_cache(monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    check.forget_checks()
    yield tmp_path / "gsplat_edu/webgpu_passed.json"
    check.forget_checks()


def test_correct_kernels_are_checked_once(empty_cache, monkeypatch):
    assert check.webgpu_failure(EXACT) is None
    assert webgpu.adapter_name().name in empty_cache.read_text()
    check.forget_checks()  # as in a new process
    monkeypatch.setattr(check, "shader_error", lambda exact: "checked again")
    assert check.webgpu_failure(EXACT) is None
    check.forget_checks()
    monkeypatch.setattr(check, "hash_of_kernels", lambda: "of other shaders")
    assert check.webgpu_failure(EXACT) == "checked again"


def test_a_gradient_that_is_one_percent_too_large_is_refused(empty_cache, monkeypatch):
    """As if a driver had compiled a shader wrongly."""
    right = webgpu.differentiate_frame

    def wrong(*given):
        found = right(*given)
        found.core[:, 5] *= 1.01
        return found

    monkeypatch.setattr(webgpu, "differentiate_frame", wrong)
    with pytest.raises(BackendUnavailableError) as raised:
        resolve_backend("webgpu")
    assert "its kernels failed their check on" in str(raised.value)
    assert "the gradient of quats is wrong by 0.0" in str(raised.value)
    assert not empty_cache.exists()


@pytest.mark.parametrize(
    ("file", "right", "wrong", "message"),
    [
        (
            "lens",
            "arc.s1 = (z * inverse",
            "arc.s1 = 1.01 * (z * inverse",
            "the image of a test scene is wrong by",
        ),
        (
            "sight_backward",
            "let more = s.k * (s.speed.x",
            "let more = 0.9 * s.k * (s.speed.x",
            "the gradient of means is wrong by",
        ),
        ("seam", "return turn *", "return 0.0 *", "the image of a test scene is wrong by"),
        ("loss", "2.0 * pair.x * blurred", "1.9 * pair.x * blurred", "a training's gradient of "),
        ("loss", "sums.x += abs(", "sums.x += 1.01 * abs(", "the loss of a test scene is wrong by 0.0"),
        ("adam", "by.new2 * g * g", "by.new2 * g", "a step of Adam for means is wrong"),
        (
            "adam",
            "1.0);\n    }\n    let far",
            "2.0);\n    }\n    let far",
            "counts other Gaussians as visible",
        ),
        ("noise", "0x9E3779B9u", "0x9E3779B8u", "a training's noise is wrong by "),
    ],
    ids=["lens", "shutter", "seam", "gradient", "value", "adam", "statistics", "noise"],
)
def test_a_wrong_step_is_refused(file, right, wrong, message):
    """As if a driver had compiled a pass of a step wrongly."""

    def changed(module):
        text = host.module_source(module)
        if file in MODULES[module]:
            assert right in text
            text = text.replace(right, wrong)
        return text

    with webgpu.rendering_with(Pool(host.Device(limits=LIMITS, source=changed))):
        failure = check.shader_error(EXACT)
    assert failure is not None and message in failure
