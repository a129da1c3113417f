"""Write docs/CLI.md, the command-line reference, from the parsers.

    python tools/build_cli_reference.py

`tests/repo/test_cli_reference.py` fails if the file differs from this script's output.
"""

from __future__ import annotations

import argparse
import importlib.util
import sys
from pathlib import Path

from gsplat_edu.base.files import written_aside
from gsplat_edu.cli.main import COMMANDS, build_parser
from gsplat_edu.options import demo
from gsplat_edu.options.parser import OneLineParser

ROOT = Path(__file__).resolve().parent.parent
REFERENCE = ROOT / "docs" / "CLI.md"

PREAMBLE = """# Command line

<!-- Written by tools/build_cli_reference.py; edit the help texts in src/gsplat_edu/options instead. -->

Bad input prints one line that says what is wrong and what to do next, and exits with code 2; `--debug` adds the
traceback. Ctrl-C and SIGTERM exit with code 130 (`view` with 0), and `train` saves a checkpoint first. `doctor` exits
with 1 if training would be pointless. Output paths are checked before long work starts. Options cannot be abbreviated.
Every command explains itself with `--help`; `train --help` shows the common options, `train --help-all` all of them.

Durations are written as `90s`, `20m`, `1h30m`; sizes as `500MB`, `4GiB`. [TOUR.md](TOUR.md) shows the commands at
work, [FORMATS.md](FORMATS.md) lists the scene formats, [RECIPE.md](RECIPE.md) explains the training parameters.
"""

EVERYWHERE = ("help", "help_all", "debug")
"""Options that the preamble explains."""


def reference() -> str:
    """Return the text of docs/CLI.md."""
    summary = [
        f"| [`gsplat-edu {name}`](#gsplat-edu-{name}) | {_cell(text)} |" for name, text in COMMANDS.items()
    ]
    parts = [PREAMBLE, "\n".join(["| command | what it does |", "|---|---|", *summary]) + "\n"]
    for name in COMMANDS:
        parts.append(_section(f"gsplat-edu {name}", _command(name)))
    parts += [
        _section("python train/train_2d.py", _script("train_2d.py").build_parser()),
        _train_3d(),
        _section("python train/own_loop.py", _script("own_loop.py").build_parser()),
    ]
    return "\n".join(parts)


def _command(name: str) -> argparse.ArgumentParser:
    """Return the parser of one command."""
    subparsers = build_parser([name])._subparsers
    assert subparsers is not None
    commands = subparsers._group_actions[0].choices
    assert isinstance(commands, dict)
    parser: argparse.ArgumentParser = commands[name]
    return parser


def _script(name: str):  # noqa: ANN202 - a module
    spec = importlib.util.spec_from_file_location(Path(name).stem, ROOT / "train" / name)
    assert spec is not None and spec.loader is not None
    module = sys.modules[spec.name] = importlib.util.module_from_spec(spec)  # dataclasses look it up there
    spec.loader.exec_module(module)
    return module


def _section(title: str, parser: argparse.ArgumentParser) -> str:
    """Describe one parser: a table per group of options."""
    description, example = parser.description or "", (parser.epilog or "").removeprefix("example: ")
    lines = [f"## {title}", "", f"{description[0].upper()}{description[1:].rstrip('.')}.", ""]
    lines += ["```", example, "```", ""]
    for group in parser._action_groups:
        actions = [action for action in group._group_actions if action.dest not in EVERYWHERE]
        if not actions:
            continue
        if group.title not in ("positional arguments", "options"):
            lines += [f"### {title.removeprefix('gsplat-edu ')}: {group.title}", ""]
        if group.description:
            lines += [group.description, ""]
        heading = "argument" if group.title == "positional arguments" else "option"
        lines += [f"| {heading} | meaning |", "|---|---|"]
        lines += [f"| `{_invocation(action)}` | {_meaning(parser, action)} |" for action in actions]
        lines.append("")
    return "\n".join(lines)


def _invocation(action: argparse.Action) -> str:
    """Return an option with its values, as in --help."""
    if not action.option_strings:
        return _cell(f"{action.metavar} ..." if action.nargs == "+" else str(action.metavar))
    names = ", ".join(action.option_strings)
    if action.nargs == 0:
        return names
    shown = (
        "|".join(map(str, action.choices)) if action.metavar is None and action.choices else action.metavar
    )
    values = shown if isinstance(shown, tuple) else (str(shown),)
    text = " ".join(values)
    text = {"?": f"[{text}]", "+": f"{text} [{text} ...]"}.get(str(action.nargs), text)
    return _cell(f"{names} {text}")


def _meaning(parser: argparse.ArgumentParser, action: argparse.Action) -> str:
    return _cell(parser._get_formatter()._expand_help(action))


def _cell(text: str) -> str:
    """Escape characters that would end a table cell."""
    return " ".join(text.split()).replace("|", "\\|")


def _train_3d() -> str:
    """Describe the script that shares the options of `gsplat-edu demo`."""
    parser = OneLineParser(prog="train_3d.py")
    demo.add_arguments(parser)
    flags = [action.option_strings[0] for action in parser._actions[1:]]
    return (
        "## python train/train_3d.py\n\nTrain the sphere as `gsplat-edu demo` does, and print the chapter's log."
        f" Options: {', '.join(f'`{flag}`' for flag in flags)} and `--debug`.\n"
    )


def main() -> None:
    """Write the file."""
    argparse.ArgumentParser(description="Write docs/CLI.md from the parsers.").parse_args()
    with written_aside(REFERENCE) as aside:
        aside.write_text(reference(), encoding="utf-8")
    print(f"wrote {REFERENCE.relative_to(ROOT)}")


if __name__ == "__main__":
    main()
