"""Every refusal of the studio has a sentence for people: no path, option, field or number of a job on a page."""

import ast
import re
from pathlib import Path

import pytest

import gsplat_edu.jobs.queue as queue_module
import gsplat_edu.server as server_package
import gsplat_edu.studio as studio_package
from gsplat_edu.base.text import Told
from gsplat_edu.studio.spoken import MISMATCH, spoken

REFUSALS = ("RefusedError", "conflict", "too_large", "not_found", "ArgumentError")

TECHNICAL = re.compile(
    r"(?<![\w.])/\w|--[a-z]|\bjob \d|\bjobs/\d|gsplat-edu|\.json\b|\bbody\b|\b(?:file|path|zip|options|outputs): "
)
"""What only a command line or a program that sends requests can use."""

SAMPLES = {
    "kind": "photos",
    "self.name": "runs/toy",
    "studio.library.name": "runs/toy",
    "subject": "runs/toy",
    "inputs[0]": "captures/toy",
    "old": "captures/toy",
    "entry.name": "toy",
    "title": "training of toy",
    "job.id": "000007",
    "source": "/home/me/some photos",
    "place": "/home/me/library/photos",
    "path.name": "a.jpg",
    "target.name": "a.jpg",
    "wanted": "day 1/a.jpg",
    "why": "is used by “training of toy”; wait until that has ended, or stop it",
    "used": "is used by “training of toy”; wait until that has ended, or stop it",
    "unreadable": "/home/me/some photos: cannot be read (permission denied); change its permissions",
    "job.state": "done",
}
"""A value for an expression in a message, by how its source begins; otherwise it is a number."""


def sample_of(node):
    """Return a message as it may look; None if it is not written where it is raised."""
    if isinstance(node, ast.Constant) and isinstance(node.value, str):
        return node.value
    if not isinstance(node, ast.JoinedStr):
        return None
    words = []
    for part in node.values:
        if isinstance(part, ast.Constant):
            words.append(part.value)
            continue
        source = ast.unparse(part.value)
        name = next((name for name in SAMPLES if source.startswith(name)), None)
        words.append(SAMPLES.get(name, "17"))
    return "".join(words)


def refusals():
    """Return where a refusal is raised and what it may say, for all of the studio, its queue and its server."""
    files = [Path(queue_module.__file__)]
    for package in (studio_package, server_package):
        files += sorted(Path(package.__path__[0]).glob("*.py"))
    found = []
    for file in files:
        for node in ast.walk(ast.parse(file.read_text("utf-8"))):
            if isinstance(node, ast.Call) and getattr(node.func, "id", "") in REFUSALS and node.args:
                text = sample_of(node.args[0])
                if text is not None:
                    text += (
                        "" if node.func.id != "not_found" else ": does not exist; it may have been removed"
                    )
                    found.append((f"{file.name}:{node.lineno}", text))
    return found


@pytest.mark.parametrize(("place", "line"), refusals(), ids=lambda value: str(value)[:40])
def test_every_refusal_has_a_sentence_for_people(place, line):
    said = spoken(line)
    assert said and not TECHNICAL.search(said), (place, said)
    assert said[0] == said[0].upper() and said.endswith(".") and ";" not in said, (place, said)


def test_the_walk_sees_the_refusals():
    assert len(refusals()) > 80


@pytest.mark.parametrize(
    ("line", "said"),
    [
        ("file: is empty; choose another one", "The file is empty. Choose another one."),
        ("photos/walk: exists already; choose another name", "“walk” exists already. Choose another name."),
        (
            "job 000007: “training of toy” works there; wait until it has ended, or stop it",
            "“training of toy” works there. Wait until it has ended, or stop it.",
        ),
        (
            "gsplat-edu sfm: /home/me/my library/photos/walk: holds one photo; take several of the same place",
            "“walk” holds one photo. Take several of the same place.",
        ),
        (
            "file: has 9 bytes, but there is room for 0; empty the trash, remove something first, or set --max-library",
            "The file has 9 bytes, but there is room for 0. Empty the trash, remove something first.",
        ),
        ("options.iterations: has to be a whole number", MISMATCH),
        ("outputs: are not what train writes: one of runs", MISMATCH),
        (Told("train with --sky shell", "train with a sky"), "train with a sky"),
        (
            "gsplat-edu train: --iterations needs a number; see gsplat-edu train --help",
            "This cannot be done.",
        ),
    ],
)
def test_lines_become_sentences(line, said):
    assert spoken(line) == said


def test_answers_have_both(page):
    answer = page.post("/api/adopt", json={"kind": "photos", "path": "/nowhere/at all", "name": "x"}).json()
    assert answer["error"] == "path: /nowhere/at all does not exist; correct it"
    assert answer["plain"] == "“at all” does not exist. Correct it."
    quiet = page.get("/api/photos/gone?quiet=1").json()
    assert quiet["plain"] == "“gone” does not exist. It may have been renamed or removed."
