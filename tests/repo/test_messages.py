"""Errors of the library never advise options of the command line: a program that uses it has none."""

import ast
import re
from pathlib import Path

import pytest

from gsplat_edu.cli.main import main

SOURCE = Path(__file__).parents[2] / "src" / "gsplat_edu"

COMMANDS = {
    "cli": None,
    "options": None,
    "studio": 1,
    "grading": 1,
    "blocks": 8,
    "budget": 5,
    "runs": 24,
    "sfm": 20,
    "viewer": 3,
}
"""Rooms that serve commands, and how many of their errors may name an option: these limits only go down. None for
those that declare options."""

OTHERS = {"usdcat --flatten"}
"""Commands of other programs."""

LIBRARY = ("scene", "render", "train", "data", "io", "compat", "ops")
"""Rooms that a user of the library reaches. None of their texts may name an option, because errors use them."""

NO_ERRORS = {
    "train/config.py": {
        "refine the cameras of the whole first, with --resolution": "what `train --blocks` refuses with",
        "Values of the maps of --depth.": "a setting's meaning in `train --help` and RECIPE.md",
        "World units for a unit of the maps of --depth;": "a setting's meaning in `train --help` and RECIPE.md",
    },
    "train/setting.py": {"--set ": "`Setting.written`, which the command line names a setting with"},
    "data/loading_notes.py": {
        "train --lens native renders it": "a note that the command prints, of photos that were loaded",
        "raise --image-memory, or load smaller photos with --resolution": "a note that the command prints",
    },
    "data/notes.py": {
        "published scores of Blender scenes are on white, as with --white-background": "a note that the command prints",
        "--set region=none uses all of them": "a note that the command prints",
    },
}
"""Texts of these rooms that name an option and are no errors, by file, each with the reason."""

OPTION = re.compile(r"(?<![\w-])--[a-z][a-z-]+")


def advice(tree):
    """Return line and text of the errors that name an option: of what is raised, and of what memory is missing for."""
    for node in ast.walk(tree):
        call = isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id
        if isinstance(node, ast.Raise) or call == "require_memory":
            strings = [
                each.value
                for each in ast.walk(node)
                if isinstance(each, ast.Constant) and isinstance(each.value, str)
            ]
            text = "".join(strings)
            for other in OTHERS:
                text = text.replace(other, "")
            if OPTION.search(text):
                yield node.lineno, text


def texts(tree):
    """Return line and text of the strings that name an option, except docstrings and strings that nothing uses."""
    unused = {id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr)}
    for node in ast.walk(tree):
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in unused:
            text = node.value
            for other in OTHERS:
                text = text.replace(other, "")
            if OPTION.search(text):
                yield node.lineno, text


def test_no_text_behind_the_library_names_an_option():
    """An error's words can come from a variable, a table or another function: `advice` sees only what is raised."""
    found, used = [], set()
    for path in sorted(path for room in LIBRARY for path in (SOURCE / room).rglob("*.py")):
        name = path.relative_to(SOURCE).as_posix()
        for line, text in texts(ast.parse(path.read_text(encoding="utf-8"))):
            known = [words for words in NO_ERRORS.get(name, ()) if words in text]
            used |= {(name, words) for words in known}
            if not known:
                found.append(f"{name}:{line}: {text}")
    assert found == []
    listed = {(name, words) for name, reasons in NO_ERRORS.items() for words in reasons}
    assert listed - used == set(), "what is gone is not listed"


@pytest.mark.parametrize(
    ("code", "count"),
    [
        ("ADVICE = {'a': 'give --voxel'}\nraise ValueError(ADVICE['a'])", 1),
        ("def words(x):\n    'See --voxel.'\n    return f'{x}: less of ' '--voxel'", 1),
        ("size = 'use `voxel`'", 0),
        ("'as --voxel does'", 0),
    ],
)
def test_texts_are_found(code, count):
    assert len(list(texts(ast.parse(code)))) == count


def of_room(room):
    return [
        f"{path.relative_to(SOURCE)}:{line}: {text}"
        for path in sorted((SOURCE / room).rglob("*.py"))
        for line, text in advice(ast.parse(path.read_text(encoding="utf-8")))
    ]


def test_no_error_of_the_library_names_an_option():
    rooms = [path.name for path in SOURCE.iterdir() if path.is_dir() and list(path.glob("*.py"))]
    assert len(rooms) > 20 and set(COMMANDS) < set(rooms)
    assert [line for room in rooms if room not in COMMANDS for line in of_room(room)] == []


@pytest.mark.parametrize("room", [room for room, most in COMMANDS.items() if most is not None])
def test_fewer_and_fewer_errors_behind_commands_do(room):
    assert len(of_room(room)) <= COMMANDS[room], of_room(room)


@pytest.mark.parametrize(
    ("code", "count"),
    [
        ("raise ValueError(f'{x}: use ' '--voxel 3')", 1),
        ("require_memory('a', 3, 'render less (--size)')", 1),
        ("raise ValueError('voxel: a -- b, --, `voxel`')", 0),
        ("say('--voxel')", 0),
        ("raise ValueError('use usdcat --flatten')", 0),
    ],
)
def test_advice_is_found(code, count):
    assert len(list(advice(ast.parse(code)))) == count


def test_the_command_line_writes_settings_as_its_options(tmp_path, capsys, written_scene):
    """The library says `size`, the command --size."""
    assert main(["convert", str(written_scene), str(tmp_path / "a.sog"), "--size", "10B"]) == 2
    said = capsys.readouterr().err
    assert "--size: " in said and "bytes are too few" in said and "`" not in said


@pytest.fixture
def written_scene(tmp_path):
    import torch

    from gsplat_edu import write_scene
    from gsplat_edu.train.initialize import random_ball

    write_scene(tmp_path / "ball.ply", random_ball(100, torch.Generator().manual_seed(0)))
    return tmp_path / "ball.ply"
