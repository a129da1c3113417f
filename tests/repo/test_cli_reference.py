"""docs/CLI.md matches the parsers, and `train --help` shows what a user needs."""

import re
from pathlib import Path

import pytest

from build_cli_reference import reference
from gsplat_edu.cli import main as command_line
from gsplat_edu.options import train

ROOT = Path(__file__).parents[2]
WRITTEN = (ROOT / "docs" / "CLI.md").read_text()

MOST, MOST_OF_TRAIN = 100, 60
"""Options of all commands, each counted once, and those of `train`; further numbers are settings of `--set`."""


@pytest.fixture
def shown(capsys):
    """Return the options that begin a line of help."""

    def run(*words):
        with pytest.raises(SystemExit) as stop:
            command_line.main(list(words))
        assert stop.value.code == 0
        return re.findall(r"^  (?:-h, )?(--[a-z0-9-]+)", capsys.readouterr().out, flags=re.MULTILINE)

    return run


def test_the_reference_of_the_command_line_is_current():
    assert reference() == WRITTEN, "run python tools/build_cli_reference.py"


def test_a_changed_option_makes_it_stale(monkeypatch):
    monkeypatch.setattr(train, "FROM_SCENE", {"means_rate": 0.5})
    assert "means_rate is 0.5 unless --set gives it" in reference()
    assert reference() != WRITTEN


@pytest.mark.parametrize("command", command_line.COMMANDS)
def test_every_option_is_in_the_reference(command, shown):
    section = WRITTEN.split(f"\n## gsplat-edu {command}\n")[1].split("\n## ")[0]
    options = shown(command, "--help-all" if command == "train" else "--help")
    documented = re.findall(r"^\| `(--[a-z0-9-]+)", section, flags=re.MULTILINE)
    assert sorted(documented) == sorted(set(options) - {"--help", "--help-all", "--debug"})


def test_the_help_of_train_shows_about_twenty_options_and_the_rest_on_request(shown):
    some, every = shown("train", "--help"), shown("train", "--help-all")
    assert 15 <= len(some) <= 25 and set(some) < set(every)
    flags = {"scene": "--from", "settings": "--set"}
    assert {flags.get(name, f"--{name.replace('_', '-')}") for name in train.COMMON} <= set(some)
    assert len(every) <= MOST_OF_TRAIN


def test_the_command_line_stays_small():
    section = re.compile(r"^## gsplat-edu .*?(?=^## )", re.MULTILINE | re.DOTALL)
    options = {
        flag
        for text in section.findall(WRITTEN)
        for flag in re.findall(r"^\| `(--[a-z0-9-]+)", text, re.MULTILINE)
    }
    assert 60 < len(options) <= MOST


def test_an_option_that_help_hides_is_still_suggested(capsys):
    with pytest.raises(SystemExit):
        command_line.main(["train", "a", "--out", "b", "--grad-treshold", "1"])
    assert "did you mean --set grad_threshold=VALUE?" in capsys.readouterr().err
