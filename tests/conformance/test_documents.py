"""The kit's documents name existing cases and arrays, and the example of its README runs."""

import re
import sys
from pathlib import Path

import run

KIT = Path(run.__file__).parent
README = (KIT / "README.md").read_text()
SPECIFICATION = (KIT / "SPECIFICATION.md").read_text()
LENSES = (KIT / "LENSES.md").read_text()


def test_the_documents_name_cases_and_arrays_that_exist():
    cases = run.load_cases()
    names, settings = {case.name for case in cases}, set(cases[0].settings)
    assert f"{len(names)} small scenes" in README
    assert f"which {sum(bool(case.needs) for case in cases)} of the cases have" in README
    assert f"{sum(not case.needs for case in cases)} cases of a pinhole" in SPECIFICATION
    kinds = "|".join(sorted({name.partition("_")[0] for name in names if "_" in name}))
    named = set(re.findall(rf"`((?:{kinds})_[\w.]+)`", README + SPECIFICATION))
    assert len(named - settings) >= 5 and named - settings <= names
    for name in (*run.OUTPUTS, *run.GRADIENTS):
        assert re.search(rf"\b{name}\b", README), name
    for name in run.LENSES:
        assert f"`lens.{name}`" in README, name
    for name in run.PINHOLE:
        assert f"`{name}`" in LENSES and re.search(rf"\b{name}\b", README), name


def test_the_documents_state_the_runner_s_numbers():
    assert run.INPUT_ROUNDINGS == 16 and "`allowed = 16 eps S + F M`" in SPECIFICATION
    assert run.FLOOR == {"float32": 100 * 2.0**-23, "float64": 1e-12}
    assert "`F` is 100 `eps` in float32" in SPECIFICATION and "In float64 it is\n  1e-12" in SPECIFICATION
    assert run.EPSILON == {"float32": 2.0**-23, "float64": 2.0**-52} and run.T_STOP == 1e-4


def test_the_specification_is_about_a_page_long():
    """The appendix on gsplat does not count."""
    conventions = SPECIFICATION.partition("## gsplat")[0]
    assert len(conventions.split()) <= 1100
    assert len(LENSES.split()) <= 1100


def test_the_example_of_the_readme_runs(tmp_path, monkeypatch, capsys):
    (snippet,) = re.findall(r"```python\n(.*?)```", README, flags=re.DOTALL)
    command = next(line for line in README.splitlines() if "mine:render --precision" in line)
    zeros = "import numpy as np\ndef my_renderer(_):\n    return np.zeros((20, 24, 3)), np.zeros((20, 24))\n"
    (tmp_path / "mine.py").write_text(zeros + snippet)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))
    assert run.main([*command.split()[2:], "--case", "random"]) == 1
    out = capsys.readouterr().out
    assert "2 arrays compared" in out and "random failed." in out
    assert "Left out: alpha, depth, features, lens, median_depth, all gradients." in out
