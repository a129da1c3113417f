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
