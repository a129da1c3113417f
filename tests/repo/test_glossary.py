"""The glossary explains the words of the course, and chapters link it."""

import re

from chapters import ROOT

TEXT = (ROOT / "docs" / "GLOSSARY.md").read_text()
WORDS = re.findall(r"^## (.*)$", TEXT, flags=re.MULTILINE)


def test_each_word_is_linked_from_a_chapter_and_each_link_finds_a_word():
    pages = sorted((ROOT / "notebooks").glob("*/*.py"))
    linked = {anchor for page in pages for anchor in re.findall(r"GLOSSARY\.md#([\w-]+)", page.read_text())}
    assert linked == {word.lower().replace(" ", "-") for word in WORDS}


def test_words_are_sorted_and_name_their_chapter():
    assert sorted(WORDS, key=str.lower) == WORDS
    for entry in TEXT.split("\n## ")[1:]:
        assert re.search(r"\[Chapter\s\d\d\]\(\.\./notebooks/\d\d_\w+\.ipynb\)", entry), entry


GREEK = (
    "alpha|beta|gamma|Gamma|delta|Delta|epsilon|varepsilon|zeta|eta|theta|Theta|kappa|lambda|Lambda|mu|nu|xi|Xi|pi|Pi"
    "|rho|sigma|Sigma|tau|phi|varphi|Phi|chi|psi|Psi|omega|Omega|ell"
)
"""Greek letters by their TeX names."""


def letters(formula):
    """Return the capital and Greek letters of a formula; words in it have none."""
    formula = re.sub(r"\\(?:mathrm|text|operatorname)\{[^}]*\}", " ", formula)
    greek = {f"\\{name}" for name in re.findall(rf"\\({GREEK})(?![a-zA-Z])", formula)}
    return greek | set(re.findall(r"[A-Z]", re.sub(r"\\[a-zA-Z]+", " ", formula)))


def test_one_letter_means_one_thing_in_a_chapter_and_the_table_says_what():
    used = {}
    for source in sorted((ROOT / "notebooks" / "source").glob("*.py")):
        cells = source.read_text().split("# %%")
        prose = "".join(cell.replace("\n# ", "\n") for cell in cells if cell.startswith(" [markdown]"))
        found = re.findall(r"\$\$(.+?)\$\$|\$([^$]+?)\$", prose, flags=re.DOTALL)
        used[source.name[:2]] = set().union(*(letters(one or other) for one, other in found))
    rows = re.findall(r"^\| (\$.*?\$) \| .* \| ([\d ]+) \|$", TEXT, flags=re.MULTILINE)
    said = [
        (letter, chapter) for row, chapters in rows for letter in letters(row) for chapter in chapters.split()
    ]
    assert len(said) == len(set(said))
    assert set(said) == {(letter, chapter) for chapter, found in used.items() for letter in found}
    for alone in ("\\ell", "\\lambda", "\\tau", "R", "T", "W"):
        assert sum(alone in letters(row) for row, _ in rows) == 1, alone
