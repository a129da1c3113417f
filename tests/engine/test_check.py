"""The command that checks and measures an adapter."""

import json

import numpy as np
import pytest

from gsplat_edu.engine import adapters, check

SMALL = ("--gaussians", "300", "--size", "40x30", "--rounds", "1")


pytestmark = pytest.mark.usefixtures("device")  # skips where there is none


def test_the_report(device, tmp_path, capsys):
    assert check.main([*SMALL, "--out", str(tmp_path / "a.json")]) == 0
    report = json.loads((tmp_path / "a.json").read_text())
    printed = capsys.readouterr().out
    text, table = printed[: printed.index("\n}\n") + 2], printed[printed.index("\n}\n") + 3 :]
    assert report == json.loads(text)
    assert table.startswith("| stage | ") and "| step | " in table and "(computed)" in table
    assert report["step"]["passes"] > 60 and report["step"]["bytes sent a step"] == 416
    assert len(report["checks"]) == 4 and all(report["checks"].values())
    assert 0 < report["counted"]["visible"] <= 300 <= report["counted"]["pairs"] + 300
    if device.measures:
        passes = report["milliseconds of passes"]
        assert set(passes["render"]) >= {"project", "scatter", "composite"}
        assert all(time >= 0 for part in passes.values() for time in part.values())


def test_as_many_gaussians_as_fit():
    assert check.default_count(True, 2 << 30) == 10_000
    assert check.default_count(False, 2 << 30) == 1_000_000
    assert check.default_count(False, 128 << 20) == (128 << 20) // 180


@pytest.mark.parametrize("broken", ["sort", "bits"])
def test_a_wrong_result_exits_with_1(monkeypatch, capsys, broken):
    """As a driver that sorts wrongly, or adds up in another order each time."""
    if broken == "sort":
        right = check.np.argsort
        monkeypatch.setattr(
            check.np, "argsort", lambda *given, **options: np.roll(right(*given, **options), 1)
        )
    else:
        draw, calls = check.draw_frame, []

        def unstable(*given):
            frame = draw(*given)
            calls.append(frame)
            frame.image[0, 0, 0] += 1e-7 * len(calls)
            return frame

        monkeypatch.setattr(check, "draw_frame", unstable)
    assert check.main(SMALL) == 1
    printed = capsys.readouterr().out
    checks = json.loads(printed[: printed.index("\n}\n") + 2])["checks"]
    (failed,) = [name for name, passed in checks.items() if not passed]
    assert failed == {"sort": "the sort is stable and right", "bits": "two runs have the same bits"}[broken]


def test_bad_input_is_one_line(monkeypatch, capsys):
    with pytest.raises(SystemExit) as raised:
        check.main(["--size", "large"])
    assert raised.value.code == 2
    assert "--size: is 'large', but has to be WIDTHxHEIGHT" in capsys.readouterr().err
    monkeypatch.setattr(adapters, "listed_adapters", lambda: ())
    check.Device.default.cache_clear()
    assert check.main(SMALL) == 2
    assert capsys.readouterr().err.startswith("backend 'webgpu': wgpu finds no adapter")
