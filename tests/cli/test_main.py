import re
import signal
from importlib.metadata import version

import pytest

from gsplat_edu.cli.main import COMMANDS, main
from gsplat_edu.cli.process import interruptible

TINY = ["demo", "--iters", "2", "--k0", "5", "--cap", "8", "--size", "16"]


def test_demo_writes_figure_curves_and_scene(tmp_path, capsys):
    assert main([*TINY, "--out", str(tmp_path / "a" / "s.png")]) == 0
    printed = capsys.readouterr().out
    assert "2/2" in printed, "the progress bar was completed"
    assert re.search(r"held-out L1: init 0\.\d{4} -> final 0\.\d{4}", printed)
    assert sorted(p.name for p in (tmp_path / "a").iterdir()) == ["s.ply", "s.png", "s_curves.png"]


def test_signal_handlers_not_installed_by_python_are_tolerated(monkeypatch):
    """`signal.signal` returns None for a handler that C installed, but does not accept None to restore it."""
    table = dict.fromkeys((signal.SIGINT, signal.SIGTERM))

    def install(number, handler):
        assert handler is not None
        before, table[number] = table[number], handler
        return before

    monkeypatch.setattr(signal, "signal", install)
    with interruptible() as interrupted:
        assert not interrupted()
        table[signal.SIGTERM](signal.SIGTERM, None)
        assert interrupted()
    assert table == dict.fromkeys(table, signal.SIG_DFL)


def test_a_name_in_brackets_is_printed_unchanged(tmp_path, capsys):
    out = tmp_path / "[red]x" / "s.png"
    assert main([*TINY, "--out", str(out)]) == 0
    assert str(out) in capsys.readouterr().out.replace("\n", "")


def test_the_seed_decides_the_run(tmp_path, capsys):
    scenes = []
    for seed, name in (("4", "a"), ("4", "b"), ("5", "c")):
        assert main([*TINY, "--seed", seed, "--out", str(tmp_path / f"{name}.png")]) == 0
        scenes.append((tmp_path / f"{name}.ply").read_bytes())
    assert scenes[0] == scenes[1] != scenes[2]


def test_the_backend_determines_the_budget_that_is_not_given(tmp_path, capsys):
    arguments = ["demo", "--iters", "1", "--size", "16", "--k0", "5", "--out", str(tmp_path / "s.png")]
    assert main([*arguments, "--backend", "torch"]) == 0
    assert "reduced to --cap 800 (the chapter uses --cap 1600)" in capsys.readouterr().out
    assert main(arguments) == 0
    assert "reduced" not in capsys.readouterr().out, "the backend cpu uses the chapter's budget"


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["--iters", "0"], "--iters: is 0, but has to be a whole number of at least 1"),
        (["--iters", "many"], "argument --iters: 'many' is not a whole number"),
        (["--size", "-3"], "--size: is -3"),
        (["--k0", "0"], "--k0: is 0"),
        (["--k0", "1700"], "--k0: is 1700, more than --cap 1600"),
        (["--cap", "3"], "--k0: is 400, more than --cap 3"),
        (["--seed", "-1"], "--seed: is -1"),
        (["--seed", "99999999999999999999999"], "--seed: is 99999999999999999999999"),
        (["--iter", "3"], "unrecognized argument --iter: did you mean --iters? see gsplat-edu demo --help"),
        (
            ["--backend", "abacus"],
            "backend 'abacus': not in this version of gsplat_edu; use auto or one of: cuda, webgpu, cpu, torch",
        ),
        (["--out", "sphere.jpg"], "--out: 'sphere.jpg' must end in .png"),
        (["--out", "taken/sphere.png"], "--out: cannot write taken/sphere.png"),
        (["--out", "folder.png"], "--out: folder.png is a folder"),
        (["--itres", "3"], "unrecognized argument --itres: did you mean --iters?"),
    ],
)
def test_bad_input_is_one_line_and_exit_code_2(arguments, says, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "taken").write_text("a file where a folder is needed")
    (tmp_path / "folder.png").mkdir()
    try:
        code = main(["demo", *arguments])
    except SystemExit as exit_:
        code = exit_.code
    printed = capsys.readouterr()
    assert code == 2
    assert printed.err.count("\n") == 1 and says in printed.err
    assert printed.err.startswith("gsplat-edu")
    assert "0/" not in printed.out, "no progress bar was started"
    assert sorted(p.name for p in tmp_path.iterdir()) == ["folder.png", "taken"]


def test_an_unknown_command_is_one_line(capsys):
    with pytest.raises(SystemExit) as exit_:
        main(["trian"])
    assert exit_.value.code == 2
    assert capsys.readouterr().err.count("\n") == 1


def test_debug_adds_the_traceback(capsys):
    assert main(["demo", "--iters", "0", "--debug"]) == 2
    error = capsys.readouterr().err
    assert "Traceback" in error and error.splitlines()[-1].startswith("gsplat-edu demo: --iters")


def test_without_a_command_the_help_is_shown(capsys):
    assert main([]) == 2
    assert "demo" in capsys.readouterr().out


@pytest.mark.parametrize("command", COMMANDS)
def test_help_shows_an_example_that_parses(command, capsys):
    with pytest.raises(SystemExit) as exit_:
        main([command, "--help"])
    assert exit_.value.code == 0
    assert f"example: gsplat-edu {command} " in capsys.readouterr().out


def test_version(capsys):
    with pytest.raises(SystemExit):
        main(["--version"])
    assert capsys.readouterr().out == f"gsplat-edu {version('gsplat-edu')}\n"
