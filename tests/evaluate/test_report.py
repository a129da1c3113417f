import base64
import io
from html.parser import HTMLParser

import numpy as np
import pytest
from PIL import Image

from gsplat_edu.evaluate.figures import run_curves_figure, svg_element
from gsplat_edu.evaluate.metrics import ImageScore, summarize
from gsplat_edu.evaluate.report import Picture, Report, machine_facts, write_report

VOID = {"meta", "img", "br", "link", "input", "hr"}


class Page(HTMLParser):
    """Checks that tags close in order, and collects what a page refers to."""

    def __init__(self, path):
        super().__init__()
        self.open, self.references, self.words, self.tags = [], [], [], []
        self.feed(path.read_text("utf-8"))
        self.close()
        assert self.open == []

    def handle_starttag(self, tag, attributes):
        self.tags.append(tag)
        self.references += [
            value for key, value in attributes if key in ("src", "href", "xlink:href", "data")
        ]
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attributes):
        self.handle_starttag(tag, attributes)
        if tag not in VOID:
            self.open.pop()

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.words.append(data)

    @property
    def text(self):
        return " ".join(" ".join(self.words).split())


def score(name, psnr):
    return ImageScore(name, psnr, psnr - 0.1, 0.9, 0.02)


def picture(name, value=0):
    return Picture.of(name, np.full((30, 40, 3), value, np.uint8), np.full((30, 40, 3), 200, np.uint8))


def full_report(count=20):
    scores = [score(f"{i}.png", 20.0 + (i * 7) % 20) for i in range(count)]
    log = [{"iteration": i, "loss": 1 / (i + 1), "num_gaussians": 100 + i, "ms": 20.0} for i in range(1000)]
    log[::100] = [{**line, "psnr": 20 + line["iteration"] / 100} for line in log[::100]]
    return Report(
        title="<run> & co",
        metrics={"test": summarize(scores), "train": summarize([]), "num_gaussians": 1234, "seconds": 61.5},
        log=log,
        config={"data": {"path": "a<b>\"c'&d", "background": [0, 0, 0]}, "backend": "cpu"},
        scores=scores,
        pictures=[picture(f"{i}.png", i) for i in range(count)],
        notes=["a <script>alert(1)</script> note"],
    )


def test_a_page_is_whole_and_needs_nothing_else(tmp_path):
    path = tmp_path / "new" / "report.html"
    write_report(path, full_report())
    page = Page(path)
    assert path.read_text("utf-8").startswith("<!DOCTYPE html>")
    assert "script" not in page.tags and "link" not in page.tags
    assert page.references and all(r.startswith(("data:", "#")) for r in page.references)
    assert "url(http" not in path.read_text("utf-8")
    assert page.tags.count("svg") == 1 and page.tags.count("img") == 3 * 8
    for said in (
        "<run> & co",
        "a<b>\"c'&d",
        "<script>alert(1)</script> note",
        "1234",
        "61.5",
        "data.background",
    ):
        assert said in page.text, said
    assert machine_facts()["torch"] in page.text


def test_best_and_worst_are_named_and_shown(tmp_path):
    report = full_report()
    write_report(tmp_path / "r.html", report)
    page = Page(tmp_path / "r.html")
    # 20 + 7 i mod 20: the least is 20 at i = 0, the largest 39 at i = 17
    assert "Best: 17.png (39.00 dB). Worst: 0.png (20.00 dB)." in page.text
    shown = [words for words in page.words if words.rstrip().endswith("SSIM 0.9000")]
    assert len(shown) == 8 and any(w.startswith("17.png: PSNR 39.00") for w in shown)


def test_pictures_are_render_photo_and_difference(tmp_path):
    (_, render), (_, photo), (_, difference) = picture("a", 50).panels
    means = [np.array(Image.open(io.BytesIO(data))).mean() for data in (render, photo, difference)]
    np.testing.assert_allclose(means, (50, 200, 150), atol=1)  # JPEG of one colour: within a step
    big = np.zeros((900, 1600, 3), np.uint8)
    assert Image.open(io.BytesIO(Picture.of("b", big, big).panels[0][1])).size == (640, 360)
    write_report(tmp_path / "r.html", Report("t", {}, scores=[score("a", 20.0)], pictures=[picture("a", 50)]))
    sources = Page(tmp_path / "r.html").references
    assert base64.b64decode(sources[0].removeprefix("data:image/jpeg;base64,")) == render


def test_nothing_to_show_is_a_page_too(tmp_path):
    write_report(tmp_path / "r.html", Report("empty", {"test": summarize([])}))
    page = Page(tmp_path / "r.html")
    assert "No view was held out" in page.text and "svg" not in page.tags


@pytest.mark.parametrize("count", [1, 5, 8, 9])
def test_few_views_are_all_shown(tmp_path, count):
    write_report(tmp_path / "r.html", full_report(count))
    assert Page(tmp_path / "r.html").tags.count("img") == 3 * min(count, 8)


def test_curves_are_of_what_the_log_has():
    assert run_curves_figure([]) is None
    assert run_curves_figure([{"iteration": 1, "loss": None}, {"loss": 2.0}]) is None
    log = [{"iteration": i, "loss": 0.0, "psnr": float("nan")} for i in range(5000)]  # no logarithm of zero
    log[7]["num_gaussians"] = 40
    figure = run_curves_figure(log)
    drawn = {axes.get_title(): axes.lines[0].get_xydata() for axes in figure.axes if axes.lines}
    assert list(drawn) == ["training loss", "density control"]
    np.testing.assert_array_equal(drawn["density control"], [[7, 40]])
    thinned = drawn["training loss"]
    assert len(thinned) == 400 and thinned[0, 0] == np.mean(range(13)) and (thinned[:, 1] == 0).all()


def test_a_drawing_stands_in_a_page_and_is_repeatable():
    log = [{"iteration": i, "loss": 1.0 / (i + 1)} for i in range(5000)]
    first, second = (svg_element(run_curves_figure(log)) for _ in range(2))
    assert first == second and first.startswith("<svg") and len(first) < 100_000


def test_exports_are_told_with_their_figures(tmp_path):
    entry = {
        "path": "a/<b>.spz",
        "num_bytes": 123456,
        "psnr": 51.234,
        "worst_psnr": 40.5,
        "worst_view": "7.png",
        "num_views": 8,
    }
    write_report(tmp_path / "report.html", Report("title", {"exports": [entry, {"path": "bare.html"}]}))
    page = Page(tmp_path / "report.html")
    for words in ("Exports", "a/<b>.spz", "51.23", "40.50", "7.png", "123456", "bare.html"):
        assert words in page.text, words
    for nothing in ([], None, ["text"], "text"):
        write_report(tmp_path / "report.html", Report("title", {"exports": nothing}))
        assert "Exports" not in Page(tmp_path / "report.html").text
