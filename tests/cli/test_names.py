"""Names that are not UTF-8 or contain terminal escape codes, and any names in an ASCII-only locale."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from rich.progress import Task, TaskID

from gsplat_edu.base import text as names
from gsplat_edu.base.text import (
    as_file_name,
    decode_file_name,
    image_file_names,
    legible,
    printable,
    short_number,
    write_text,
)
from gsplat_edu.cli.main import main
from gsplat_edu.cli.terminal import Field, Terminal
from gsplat_edu.data.procedural import procedural_capture
from gsplat_edu.data.writers import write_transforms
from gsplat_edu.evaluate.report import Report, write_report

CHILD = """
import os, sys
import torch
torch.set_num_threads(1)
from gsplat_edu.cli.main import main
data, run = sys.argv[1:]
small = ["--iterations", "2", "--strategy", "none", "--backend", "cpu"]
print("codes", [
    main(["train", data, "--out", run, *small]),
    main(["eval", run, "--backend", "cpu"]),
    main(["info", data]),
    main(["info", run]),
    main(["render", run, "--dataset", "--size", "16", "--backend", "cpu"]),
    main(["render", run, "--frames", "2", "--size", "16", "--backend", "cpu"]),
    main(["doctor", data, "--no-forecast"]),
    main(["doctor", run, "--backend", "cpu"]),
    main(["info", run + "/\\x1b[2Jgone"]),
], flush=True)
"""

ASCII_ONLY = {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}


@pytest.fixture(scope="module")
def odd_capture(tmp_path_factory):
    """A capture in a folder whose name is not UTF-8, with a photo named by a raw byte, one by an ESC, one in Greek."""
    folder = tmp_path_factory.mktemp("names") / os.fsdecode(b"caf\xe9 \xcf\x80")
    write_transforms(folder, *procedural_capture(32, 12, splats=60))
    path = folder / "transforms.json"
    contents = json.loads(path.read_text())
    names = [frame["file_path"] for frame in contents["frames"]]
    for index, new in (
        (1, os.fsdecode(b"images/raw\xff.png")),
        (2, "images/\x1b[31mred\u202e.png"),
        (3, "images/π.png"),
    ):
        (folder / names[index]).rename(folder / new)
        contents["frames"][index]["file_path"] = new
    contents["frames"].append({**contents["frames"][0], "file_path": "images/half\ud800.png"})
    path.write_text(json.dumps(contents))
    return folder


@pytest.mark.own_process
def test_every_command_accepts_odd_names_in_an_ascii_locale(odd_capture, tmp_path):
    """The commands run in a separate process, because the locale belongs to the process."""
    run = os.fsdecode(bytes(tmp_path) + b"/run\xfe \x1b[1m")
    words = [sys.executable, "-c", CHILD, odd_capture, run]
    ended = subprocess.run(
        words, capture_output=True, env={**os.environ, **ASCII_ONLY}, timeout=600, check=False
    )
    said = ended.stdout + ended.stderr
    assert b"codes [0, 0, 0, 0, 0, 0, 0, 0, 2]" in ended.stdout, said.decode("ascii", "replace")
    assert b"\x1b" not in said and said.isascii()
    assert rb"half\ud800.png" in said and rb"run\xfe \x1b[1m" in said
    report = (tmp_path / os.fsdecode(b"run\xfe \x1b[1m") / "report.html").read_bytes().decode("utf-8")
    assert r"run\xfe" in report
    names = {entry["img_name"] for entry in json.loads((Path(run) / "cameras.json").read_text())}
    assert {r"images/raw\xff.png", "images/π.png"} <= names
    assert (Path(run) / "renders" / "views" / "images_π.png").is_file(), "still written as UTF-8"
    assert (Path(run) / "renders" / "orbit.mp4").is_file()


def test_names_as_text():
    assert legible("plain π") == "plain π"
    assert legible(os.fsdecode(b"a\xff")) == r"a\xff"
    assert legible("π".encode().decode("ascii", "surrogateescape")) == "π", (
        "the name as Python reads it under LC_ALL=C"
    )
    assert legible("\ud800\udcff") == r"\ud800\xff"
    for text in ("\x1b[2J", "a\nb", "\r", "\x9b1m", "\u202e", "\ud800", "\x00", "\x7f"):
        shown = printable(text)
        shown.encode("utf-8")
        assert shown.isprintable() and "\\" in shown, repr(text)
    assert printable("90 % of π, “quoted”") == "90 % of π, “quoted”"
    assert as_file_name("\ud800") == "\ud800" and as_file_name("π") == "π"


def test_the_terminal_prints_text_unchanged(capsys):
    """Markup, emoji codes and escape codes are not interpreted."""
    Terminal().print("[red]x[/] :car: \x1b[31m", "b\nc", sep="\n", soft_wrap=True)
    assert capsys.readouterr().out == "[red]x[/] :car: \\x1b[31m\nb\\nc\n"


@pytest.mark.parametrize(
    "words", [["info", "\x1b[2J"], ["train", "\x1b[2J", "--out", "x"], ["\x1b[2J"], ["info", "a", "\x1b[2J"]]
)
def test_an_error_message_sends_no_escape_codes_to_the_terminal(capsys, tmp_path, monkeypatch, words):
    monkeypatch.chdir(tmp_path)
    try:
        code = main(words)
    except SystemExit as end:
        code = end.code
    said = capsys.readouterr()
    assert code == 2 and "\x1b" not in said.err + said.out and "x1b[2J" in said.err


def test_a_report_takes_any_title(tmp_path):
    path = tmp_path / "report.html"
    write_report(path, Report("half \ud800 raw \udcff", {}, notes=["\udcfe"]))
    page = path.read_bytes().decode("utf-8")
    assert r"half \ud800 raw \xff" in page and r"\xfe" in page
    write_text(tmp_path / "a.txt", "\ud800")
    assert (tmp_path / "a.txt").read_bytes() == rb"\ud800"


def test_many_images_of_one_name_get_file_names_in_linear_work():
    """The search for a free number starts at the last one; starting at 2 would take a billion comparisons."""
    names = image_file_names(["a.png"] * 50_000 + ["A.jpg", "b", "a_7.png"])
    assert names[:3] == ["a.png", "a_2.png", "a_3.png"] and len({name.lower() for name in names}) == 50_003


def test_a_progress_bar_prints_names_unchanged():
    """rich would read "[/x]" in a description as a closing tag without an opening one, and would pass ESC through."""
    task = Task(TaskID(0), "checking [/x]\x1b[2J.ply", 1, 0, _get_time=lambda: 0.0)
    assert Field("{task.description}").render(task).plain == r"checking [/x]\x1b[2J.ply"


@pytest.mark.parametrize(
    ("value", "digits", "text"),
    [
        (99.7, 2, "100"),  # this percentage used to print as "1e+02 %"
        (1432.0, 3, "1,432"),
        (-451234.6, 4, "-451,235"),
        (0.0123, 2, "0.012"),
        (819.23, 4, "819.2"),
        (0.0, 4, "0"),
        (3e38, 3, "3e+38"),
        (float("nan"), 3, "nan"),
        (float("inf"), 3, "inf"),
    ],
)
def test_only_huge_numbers_are_printed_with_an_exponent(value, digits, text):
    assert short_number(value, digits) == text


def test_a_name_of_any_bytes_is_decoded_on_windows_too(monkeypatch):
    """Windows decodes names strictly, but a damaged COLMAP model may contain any bytes."""
    assert os.fsencode(decode_file_name(b"view\xff.png")) == b"view\xff.png"
    monkeypatch.setattr(names.os, "fsdecode", lambda raw: raw.decode("utf-8", "surrogatepass"))
    assert decode_file_name("né.png".encode()) == "né.png"
    assert legible(decode_file_name(b"view\xff.png")) == legible("view\udcff.png")
    assert as_file_name("view\udcff.png") == "view\udcff.png"
