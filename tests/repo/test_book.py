"""The course as EPUB and PDF has every chapter, every figure, and an index that is right."""

import json
import re
import shutil
import xml.etree.ElementTree as ElementTree
import zipfile

import pytest

import build_book
from chapters import ROOT, SOURCES


def figures():
    """Return the number of figures of all notebooks."""
    count = 0
    for page in build_book.CHAPTERS:
        cells = json.loads((ROOT / page).read_text(encoding="utf-8"))["cells"]
        outputs = [output.get("data", {}) for cell in cells for output in cell.get("outputs", [])]
        count += sum(bool({"image/png", "image/jpeg"} & set(data)) for data in outputs)
    return count


def test_links_out_of_the_book_become_text():
    page = "notebooks/01_points.ipynb"
    text = "[a](02_gaussians_in_2d.ipynb), [b](../docs/GLOSSARY.md#splat), [c](../src/gsplat_edu/cli/main.py), [d](https://e.org)"
    assert build_book.within(text, page) == (
        "[a](02_gaussians_in_2d.ipynb), [b](../docs/GLOSSARY.md#splat), c, [d](https://e.org)"
    )


def test_the_index_has_each_word_with_the_chapters_that_link_to_it():
    rows = dict(re.findall(r"^- \[.+?\]\(docs/GLOSSARY\.md#([^)]+)\)(.*)$", build_book.index(), re.M))
    words = re.findall(r"^## (.+)$", (ROOT / "docs" / "GLOSSARY.md").read_text(encoding="utf-8"), re.M)
    assert len(rows) == len(words)
    for anchor, row in rows.items():
        linking = [
            s.stem[:2] for s in SOURCES if f"../docs/GLOSSARY.md#{anchor})" in s.read_text(encoding="utf-8")
        ]
        assert set(linking) <= set(re.findall(r"\[(\d\d)\]", row)), anchor  # exercises link, too
    assert rows["relocation"].startswith(": [16](notebooks/16")


@pytest.mark.slow
def test_the_book_is_made_with_every_chapter_and_figure(tmp_path, capsys):
    assert build_book.main(["--out", str(tmp_path)]) == 0
    with zipfile.ZipFile(tmp_path / "gsplat_edu.epub") as book:
        names = book.namelist()
        assert names[0] == "mimetype" and book.read("mimetype") == b"application/epub+zip"
        pages = {name: ElementTree.fromstring(book.read(name)) for name in names if name.endswith(".xhtml")}
    shown = set()
    for source in SOURCES:
        images = pages[f"notebooks/{source.stem}.xhtml"].iter("{http://www.w3.org/1999/xhtml}img")
        found = {image.get("src").removeprefix("../") for image in images}
        assert found and found <= set(names)
        shown |= found
    assert len(shown) == figures()
    if shutil.which("chromium"):
        pdf = (tmp_path / "gsplat_edu.pdf").read_bytes()
        assert pdf.startswith(b"%PDF-") and pdf.count(b"/Subtype /Image") >= figures()
    else:
        assert "chromium is not installed" in capsys.readouterr().out
