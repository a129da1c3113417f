"""The page of the course has the right chapters, needs, hours, plans and answers; `make course` opens JupyterLab."""

import json
import math
import os
import re
import signal
import subprocess
import tomllib
import urllib.error
import urllib.request

import jupytext
import numpy as np
import pytest

import gsplat_edu
from chapters import ROOT, SOURCES
from waiting import PATIENCE, until

PAGE = (ROOT / "notebooks" / "README.md").read_text(encoding="utf-8")
ROW = re.compile(r"^\| \[(\d\d) [^]]*\]\((\w+)\.ipynb\) \|[^|]*\| (\d+) \| ([\w, ]*)\|$", re.M)


def rows():
    """Return file name, hours and needs of each chapter by its number."""
    return {number: (stem, int(hours), needs.strip()) for number, stem, hours, needs in ROW.findall(PAGE)}


def numbers(text):
    """Return the chapters that a text names: 04, 10 to 13."""
    ranges = re.findall(r"\b(\d\d) to (\d\d)\b", text)
    between = {f"{n:02d}" for first, last in ranges for n in range(int(first), int(last) + 1)}
    return between | set(re.findall(r"\b\d\d\b", text))


def test_the_table_has_every_chapter_and_what_it_needs():
    assert [stem for stem, *_ in rows().values()] == [path.stem for path in SOURCES]
    for source in SOURCES:
        text = source.read_text(encoding="utf-8")
        needs = {
            "clone": "ROOT = " in text,
            "compiler": bool(re.search(r"^from ladder", text, re.M)),
            "sfm": "import pycolmap" in text,
        }
        assert rows()[source.stem[:2]][2] == ", ".join(name for name, needed in needs.items() if needed)
        assert ("> **Needs.** " in text) == any(needs.values()), (
            f"{source.name} says at its top what it needs"
        )


def test_the_hours_of_a_track_are_those_of_its_chapters():
    tracks = re.findall(r"^- \*\*\w+ it\*\* \((\d+) hours\): ([^.]*?)(?:, and the|, with)", PAGE, re.M)
    assert len(tracks) == 3
    for hours, chapters in tracks:
        assert int(hours) == sum(rows()[number][1] for number in numbers(chapters))


def test_ten_weeks_have_every_chapter_once_and_six_lose_those_they_name():
    weeks = dict(re.findall(r"^\| (\d+) \| ([\d, ]+) \| [^|]+\|$", PAGE, re.M))
    assert list(weeks) == [str(n) for n in range(1, 11)]
    assert sorted(", ".join(weeks.values()).split(", ")) == sorted(rows())
    least, most = re.search(r"Two hours of class a week, .* at home: (\d+) to (\d+)\.", PAGE).groups()
    hours = [sum(rows()[number][1] for number in week.split(", ")) for week in weeks.values()]
    assert (int(least), int(most)) == (min(hours) - 2, max(hours) - 2)
    left_out, kept = re.search(r"\*\*six weeks\*\*, leave out ([^:]*): weeks ([^.]*)\.", PAGE).groups()
    lost = numbers(left_out)
    assert {number for week in re.findall(r"\d+", kept) for number in weeks[week].split(", ")} == set(
        rows()
    ) - lost


def test_the_answers_of_the_entry_test_are_right():
    asked, answered = (re.findall(r"^(\d+)\. (.*)$", part, re.M) for part in PAGE.split("<summary>Answers"))
    assert [n for n, _ in asked] == [n for n, _ in answered] == [str(n) for n in range(1, 11)]
    x = 1e-6
    assert [[float(n) for n in re.findall(r"-?[\d.]+", text)] for _, text in answered] == [
        [*(np.ones((3, 1)) + np.ones(4)).shape],
        [*np.arange(6).reshape(2, 3)[:, 1]],
        pytest.approx(np.linalg.eigvalsh([[2, 1], [1, 2]])),
        [1],
        [round((math.exp(-((1 + x) ** 2) / 2) - math.exp(-((1 - x) ** 2) / 2)) / (2 * x), 3)],
        [2 * 2 * 3, 2**2],
        [pytest.approx(math.sin(3 * x) / x)],
        [4 + 9],
        [500 * 2 / 10],
        [1 - 0.1 * 2],
    ]


def address_or_end(program, log):
    """Find the address, with a token, that JupyterLab prints; fail if it ended."""
    text = log.read_text()
    assert program.poll() is None, text
    return re.search(r"(http://127\.0\.0\.1:\d+)/lab/tree/\S*\?token=(\w+)", text)


def answer_of(page):
    """Read an answer in JSON; None if nobody listens: JupyterLab prints its address before it does."""
    try:
        with urllib.request.urlopen(page, timeout=PATIENCE) as answer:
            return json.load(answer)
    except urllib.error.URLError as error:
        if isinstance(error.reason, ConnectionRefusedError):
            return None
        raise


@pytest.mark.slow
def test_make_course_opens_the_first_chapter(tmp_path):
    """JupyterLab serves the chapter on a free port to who has its token."""
    options = "--no-browser --allow-root --ServerApp.port=0"
    with (tmp_path / "log").open("w") as log:
        started = subprocess.Popen(
            ["make", "course", f"JUPYTER={options}"],
            cwd=ROOT,
            stdout=log,
            stderr=log,
            env=os.environ | {"JUPYTER_RUNTIME_DIR": str(tmp_path / "runtime")},
            start_new_session=True,
        )
    try:
        found = until(lambda: address_or_end(started, tmp_path / "log"), "JupyterLab's address")
        address, token = found.groups()
        page = f"{address}/api/contents/notebooks/01_points.ipynb?token={token}"
        chapter = until(lambda: answer_of(page), "JupyterLab's answer")
    finally:
        os.killpg(started.pid, signal.SIGKILL)
        started.wait()
    assert chapter["name"] == "01_points.ipynb" and chapter["type"] == "notebook"
    assert "/lab/tree/notebooks/01_points.ipynb" in found[0]


CITED = re.compile(r"([A-Z][\w-]+(?: Bulò)?(?: et al\.| and [A-Z]\w+)?),? \(?((?:19|20)\d\d)\b")


def test_the_bibliography_has_the_papers_of_the_chapters_and_says_which():
    entries = (ROOT / "docs" / "BIBLIOGRAPHY.md").read_text(encoding="utf-8").split("\n- ")[1:]
    listed = {}
    for entry in entries:
        name, year, chapters = re.fullmatch(
            r"(.*?) (\d{4})\. \[.*?\]\(https://\S+\)\.\s.*? Chapters? ([\d, ]+)\.\n?", entry, re.S
        ).groups()
        listed[f"{name} {year}"] = chapters.split(", ")
    assert [key[-4:] for key in listed] == sorted(key[-4:] for key in listed)
    found = {}
    for source in SOURCES:
        prose = " ".join(c.source for c in jupytext.read(source).cells if c.cell_type == "markdown")
        for name, year in CITED.findall(" ".join(prose.split())):
            found.setdefault(f"{name} {year}", set()).add(source.stem[:2])
        if "Kerbl et al.'s code" in prose:
            found.setdefault("Kerbl et al. 2023", set()).add(source.stem[:2])
    assert {name: sorted(chapters) for name, chapters in found.items()} == listed


def test_quizzes_have_five_questions_for_each_chapter_and_right_answers():
    asked = tomllib.loads((ROOT / "notebooks" / "quizzes.toml").read_text(encoding="utf-8"))
    assert list(asked) == [path.stem[:2] for path in SOURCES]
    names = {"np": np, "DILATION": gsplat_edu.DILATION, "C0": gsplat_edu.C0}
    places = []
    for questions in asked.values():
        assert len(questions) == 5
        for one in questions:
            assert one["ask"].endswith(("?", ".")) and one["why"].endswith(".")
            if "options" in one:
                assert set(one) == {"ask", "options", "answer", "why"}
                assert len(set(one["options"])) == len(one["options"]) == 3
                places.append(one["options"][one["answer"]] and one["answer"])
            else:
                assert one["answer"] == pytest.approx(eval(one["check"], names), rel=0.003), one["ask"]
    assert all(places.count(place) > len(places) / 4 for place in range(3)), "the right option is anywhere"
