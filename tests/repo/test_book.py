"""The course as EPUB, PDF and slides has every chapter and every figure, and an index that is right."""

import json
import re
import shutil
import xml.etree.ElementTree as ElementTree
import zipfile

import pytest

import build_book
import build_slides
from chapters import ROOT, SOURCES
from waiting import awaited


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


def test_slides_have_every_heading_prediction_and_figure(tmp_path):
    assert build_slides.main(["--out", str(tmp_path)]) == 0
    assert sorted(path.stem for path in tmp_path.iterdir()) == [source.stem for source in SOURCES]
    shown = 0
    for source in SOURCES:
        page = (tmp_path / f"{source.stem}.html").read_text(encoding="utf-8")
        text = source.read_text(encoding="utf-8")
        assert page.count("<blockquote>") == text.count("> **Predict.**")
        assert page.count("<h1>") == 1
        for heading in re.findall(r"^# ## (.+)$", text, re.M):
            assert f"<h2>{build_slides.shown(heading)}</h2>\n<p>" in page, heading
        assert "$" not in re.sub(r"<script>.*?</script>|<annotation.*?</annotation>", "", page, flags=re.S)
        assert "](" not in page
        shown += page.count("<img ")
    assert shown == figures()


def test_a_slide_opens_with_whole_sentences_and_shows_formulas():
    text = "$$a = 1$$\n\nOne [link](x.md) of $a^2$. Two. Three.\n\n$$b = 2$$\n\n$$c$$"
    assert build_slides.opening(text) == "One [link](x.md) of $a^2$. Two."
    html = build_slides.shown(build_slides.opening(text))
    assert html.startswith("One link of <math") and html.endswith("</math>. Two.")
    assert build_slides.equations(text).count("<math") == build_slides.EQUATIONS
    assert build_slides.shown("`a<b` *and* **c**") == "<code>a&lt;b</code> <em>and</em> <em>c</em>"


@pytest.mark.slow
def test_arrow_keys_turn_the_slides(browser, tmp_path):
    build_slides.main(["--out", str(tmp_path)])
    tab = browser.new_page(viewport={"width": 960, "height": 600})
    tab.goto((tmp_path / "04_splatting.html").as_uri())
    first, second = tab.locator("section").nth(0), tab.locator("section").nth(1)
    assert first.bounding_box()["y"] == 0
    tab.keyboard.press("ArrowRight")
    awaited(tab, lambda: second.bounding_box()["y"] == 0)
    tab.keyboard.press("ArrowLeft")
    awaited(tab, lambda: first.bounding_box()["y"] == 0)


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
