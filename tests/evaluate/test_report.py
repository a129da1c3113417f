import base64
import io
import re
import shlex
from html.parser import HTMLParser

import numpy as np
import pytest
from PIL import Image

import gsplat_edu.evaluate.report as report_module
from gsplat_edu.evaluate.figures import run_curve_figures, svg_element
from gsplat_edu.evaluate.metrics import ImageScore, summarize
from gsplat_edu.evaluate.report import SCRIPT, Picture, Report, machine_facts, write_report
from gsplat_edu.evaluate.verdict import verdict
from viewer.handles import until

VOID = {"meta", "img", "br", "link", "input", "hr"}


class Page(HTMLParser):
    """Checks that tags are closed in order, and collects the addresses, scripts and pictures of a page."""

    def __init__(self, path):
        super().__init__()
        self.open, self.references, self.words, self.tags, self.handlers = [], [], [], [], []
        self.feed(path.read_text("utf-8"))
        self.close()
        assert self.open == []

    def handle_starttag(self, tag, attributes):
        self.tags.append(tag)
        self.handlers += [key for key, _ in attributes if key.startswith("on")]
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
    return ImageScore(name, psnr, psnr - 0.1, 0.9, 0.02, psnr + 0.2)


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


def test_a_page_is_well_formed_and_self_contained(tmp_path):
    path = tmp_path / "new" / "report.html"
    write_report(path, full_report())
    page = Page(path)
    assert path.read_text("utf-8").startswith("<!DOCTYPE html>")
    # The only script is our own, which a policy can allow by its hash, and there are no inline event handlers.
    assert page.tags.count("script") == 1 and f"<script>{SCRIPT}</script>" in path.read_text("utf-8")
    assert "link" not in page.tags and not page.handlers
    assert page.references and all(r.startswith(("data:", "#")) for r in page.references)
    assert "url(http" not in path.read_text("utf-8")
    assert page.tags.count("svg") == 4 and page.tags.count("img") == 3 * 8
    for said in (
        "<run> & co",
        "a<b>\"c'&d",
        "<script>alert(1)</script> note",
        "1,234",
        "1 min 2 s",
        "data.background",
    ):
        assert said in page.text, said
    assert machine_facts()["torch"] in page.text


def test_best_and_worst_are_named_and_shown(tmp_path):
    report = full_report()
    write_report(tmp_path / "r.html", report)
    page = Page(tmp_path / "r.html")
    # 20 + (7 i mod 20): the smallest is 20 at i = 0, the largest 39 at i = 17.
    assert "Best: 17.png (39.00 dB). Worst: 0.png (20.00 dB)." in page.text
    shown = [words for words in page.words if words.rstrip().endswith("SSIM 0.9000")]
    assert len(shown) == 8 and any(w.startswith("17.png: PSNR 39.00") for w in shown)


def test_pictures_are_render_photo_and_difference(tmp_path):
    (_, render), (_, photo), (_, difference) = picture("a", 50).panels
    means = [np.array(Image.open(io.BytesIO(data))).mean() for data in (render, photo, difference)]
    np.testing.assert_allclose(means, (50, 200, 150), atol=1)  # a JPEG of one colour is exact up to one step
    big = np.zeros((900, 1600, 3), np.uint8)
    assert Image.open(io.BytesIO(Picture.of("b", big, big).panels[0][1])).size == (640, 360)
    write_report(tmp_path / "r.html", Report("t", {}, scores=[score("a", 20.0)], pictures=[picture("a", 50)]))
    sources = Page(tmp_path / "r.html").references
    assert base64.b64decode(sources[0].removeprefix("data:image/jpeg;base64,")) == photo
    assert base64.b64decode(sources[1].removeprefix("data:image/jpeg;base64,")) == render


@pytest.mark.parametrize(
    ("step", "times"), [(0, 16), (3, 16), (15, 16), (16, 8), (60, 4), (127, 2), (128, 1), (200, 1)]
)
def test_differences_are_amplified_until_visible_and_say_by_how_much(step, times):
    """The difference of a good render is a few steps of 255 and used to look black."""
    title, data = Picture.of(
        "a", np.full((30, 40, 3), step, np.uint8), np.zeros((30, 40, 3), np.uint8)
    ).panels[2]
    assert title == ("difference" if times == 1 else f"difference, {times}x amplified")
    assert np.array(Image.open(io.BytesIO(data))).mean() == pytest.approx(step * times, abs=1)


def test_the_final_evaluation_is_on_the_curve(tmp_path, monkeypatch):
    """The final evaluation is in the metrics, not in the log."""
    drawn = []
    monkeypatch.setattr(report_module, "run_curve_figures", lambda log, cap: drawn.append(log) or [])
    log = [{"iteration": i, "loss": 0.1} for i in (1, 2, 3)] + [{"iteration": 2, "psnr": 20.0}]
    metrics = {"test": {"psnr": 25.0, "num_images": 1}, "iterations": 3}
    for lines in (log, [*log, {"iteration": 3, "psnr": 24.0}]):
        write_report(tmp_path / "r.html", Report("t", metrics, lines))
        evaluations = [(line["iteration"], line["psnr"]) for line in drawn.pop() if "psnr" in line]
        assert evaluations == [(2, 20.0), (3, 25.0)]


def test_a_report_begins_with_the_verdict_and_folds_the_figures(tmp_path):
    scores = [score("<i>low</i>", 12.5), score("high", 40.0)]
    views = [{"name": one.name, "psnr": one.psnr} for one in scores]
    means = {"test": {"psnr": 21.0, "num_images": 2}, "train": {"psnr": 29.5, "num_images": 12}}
    metrics = {"iterations": 1500, "test_views": views, **means}
    found = verdict(metrics, {})
    write_report(tmp_path / "r.html", Report("t", metrics, scores=scores))
    page, text = Page(tmp_path / "r.html").text, (tmp_path / "r.html").read_text()
    assert found.details.startswith("After 1,500 iterations, ") and "<i>low</i> at 12.5 dB" in found.details
    assert str(found) in page and found.details in page and "<i>" not in text
    assert text.index("Fair: ") < text.index("<details><summary>Details") < text.index("After 1,500")


def test_the_page_is_linked_or_the_command_to_write_it_is_shown(tmp_path):
    folder = tmp_path / "a run's <folder>"
    write_report(folder / "report.html", Report("t", {"exports": [{"path": str(tmp_path / "gone.html")}]}))
    page = Page(folder / "report.html")
    (command,) = (words for words in page.words if words.startswith("gsplat-edu"))
    assert shlex.split(command) == ["gsplat-edu", "convert", str(folder), str(folder / "page.html")]
    (tmp_path / "my page.html").write_text("")
    write_report(folder / "report.html", Report("t", {"exports": [{"path": str(tmp_path / "my page.html")}]}))
    assert Page(folder / "report.html").references == ["../my%20page.html"]
    (folder / "page.html").write_text("")
    write_report(folder / "report.html", Report("t", {}))
    assert Page(folder / "report.html").references == ["page.html"]


def test_the_machine_is_stated_once_and_the_configuration_is_folded(tmp_path):
    config = {"machine": machine_facts(), "train": {"seed": 1}}
    write_report(tmp_path / "r.html", Report("t", {}, config=config))
    page = Page(tmp_path / "r.html")
    assert page.text.count(machine_facts()["torch"]) == 1 and "machine." not in page.text
    text = (tmp_path / "r.html").read_text()
    assert text.index("<details>") < text.index("train.seed") < text.index("</details>")
    write_report(tmp_path / "r.html", Report("t", {}, config={"machine": {"processor": "<another>"}}))
    text = Page(tmp_path / "r.html").text
    assert "Training machine processor <another>" in text and "Evaluation machine" in text


@pytest.mark.parametrize("width", [1440, 390])
def test_in_a_browser_nothing_breaks_and_the_slider_takes_keys_and_fingers(browser, tmp_path, width):
    scores = [
        score("a_rather_long_folder_name/with_a_photo_0001.jpg", 20.0),
        score('" onload="alert(1)', 30.0),
    ]
    pictures = [picture(each.name, 150) for each in scores]
    config = {"data": {"path": "/a/very/long/path" * 9}}
    metrics = {"test": summarize(scores), "train": summarize(scores), "num_gaussians": 1234567}
    write_report(tmp_path / "r.html", Report("t", metrics, config=config, scores=scores, pictures=pictures))
    context = browser.new_context(viewport={"width": width, "height": 800}, has_touch=True)
    tab, complaints = context.new_page(), []
    tab.on("console", lambda message: complaints.append(message.text))
    tab.on("dialog", lambda dialog: complaints.append(dialog.message))
    tab.goto((tmp_path / "r.html").as_uri())
    assert tab.evaluate("document.documentElement.scrollWidth") <= width
    tab.evaluate("document.querySelectorAll('details').forEach((each) => { each.open = true; })")
    assert tab.evaluate("document.documentElement.scrollWidth") <= width
    # A cell with a number has the height of one line.
    heights = tab.evaluate("[...document.querySelectorAll('td.n')].map((e) => e.getClientRects()[0].height)")
    lines = tab.evaluate(
        "[...document.querySelectorAll('td.n')].map((e) => {const r = document.createRange();"
        " r.selectNodeContents(e); return r.getClientRects().length; })"
    )
    assert len(heights) == 22 and set(lines) == {1}
    at = "getComputedStyle(document.querySelector('.pair')).getPropertyValue('--at')"
    slider = tab.locator(".pair input").first
    slider.focus()
    assert tab.evaluate(at) == "50%"
    tab.keyboard.press("ArrowRight")
    assert tab.evaluate(at) == "51%"
    box = slider.bounding_box()
    tab.touchscreen.tap(box["x"] + 0.2 * box["width"], box["y"] + 0.5 * box["height"])
    until(tab, f"Math.abs(parseFloat({at}) - 20) < 4")
    # The photo (200) is left of the line, the render (150) right of it.
    shot = np.array(Image.open(io.BytesIO(tab.locator(".pair").first.screenshot())))
    row = shot[shot.shape[0] // 2, :, 0].astype(int)
    assert abs(row[int(0.1 * len(row))] - 200) < 4 and abs(row[int(0.6 * len(row))] - 150) < 4
    assert complaints == []


@pytest.mark.parametrize("scheme", ["dark", "light"])
def test_a_report_has_the_colours_of_its_reader(browser, tmp_path, scheme):
    log = [{"iteration": i, "loss": 1 / i, "num_gaussians": i} for i in range(1, 20)]
    write_report(tmp_path / "r.html", Report("t", {}, config={"a": 1}, log=log))
    tab = browser.new_context(color_scheme=scheme, viewport={"width": 800, "height": 900}).new_page()
    tab.goto((tmp_path / "r.html").as_uri())
    curve = np.array(Image.open(io.BytesIO(tab.locator(".curves svg").first.screenshot())).convert("L"))
    whole = np.array(Image.open(io.BytesIO(tab.screenshot())).convert("L"))
    for shot in (curve, whole):  # most of it is ground, and something is written on it
        assert (np.median(shot) < 60) == (scheme == "dark"), np.median(shot)
        assert (shot > 150).any() and (shot < 100).any()


def test_a_report_without_content_is_a_valid_page(tmp_path):
    write_report(tmp_path / "r.html", Report("empty", {"test": summarize([])}))
    page = Page(tmp_path / "r.html")
    assert "No view was held out for testing" in page.text and "svg" not in page.tags


@pytest.mark.parametrize("count", [1, 5, 8, 9])
def test_few_views_are_all_shown(tmp_path, count):
    write_report(tmp_path / "r.html", full_report(count))
    assert Page(tmp_path / "r.html").tags.count("img") == 3 * min(count, 8)


def test_every_kind_of_number_has_its_own_curve():
    log = [
        {"iteration": i, "loss": 1.0 + i, "psnr": 20.0 + i, "num_gaussians": 300 + i, "ms": 4.0 + i}
        for i in (1, 2)
    ]
    panels = [axes for figure in run_curve_figures(log) for axes in figure.axes]
    assert [axes.get_title() for axes in panels] == [
        "training loss",
        "held-out views",
        "density control",
        "speed",
    ]
    assert [axes.lines[0].get_ydata()[0] for axes in panels] == [2.0, 21.0, 301.0, 5.0]


def test_the_size_of_the_photos_and_the_cap_are_drawn_if_a_run_has_them():
    log = [{"iteration": i, "num_gaussians": 100 * i, "photo_factor": 4.0 / i} for i in (1, 2)]
    count, size = (figure.axes[0] for figure in run_curve_figures(log, cap=900))
    assert size.get_title() == "size of the photos" and size.lines[0].get_ydata().tolist() == [4.0, 2.0]
    assert count.lines[1].get_ydata() == [900, 900] and count.get_ylim()[1] > 900
    constant = [line | {"photo_factor": 1.0} for line in log]
    (alone,) = run_curve_figures(constant)
    assert len(alone.axes[0].lines) == 1


def test_a_report_draws_the_cap_of_its_run(tmp_path):
    log = [{"iteration": i, "num_gaussians": 100 * i} for i in (1, 2)]
    for name, cap in (("capped", 900), ("free", None)):
        config = {"train": {"max_gaussians": cap}}
        write_report(tmp_path / f"{name}.html", Report(name, {"test": summarize([])}, log, config))
    assert len(Page(tmp_path / "capped.html").tags) > len(Page(tmp_path / "free.html").tags)


def test_only_values_in_the_log_get_curves():
    assert run_curve_figures([]) == run_curve_figures([{"iteration": 1, "loss": None}, {"loss": 2.0}]) == []
    log = [{"iteration": i, "loss": 0.0, "psnr": float("nan")} for i in range(5000)]  # zero has no logarithm
    log[7]["num_gaussians"] = 40
    every = [axes for figure in run_curve_figures(log) for axes in figure.axes]
    drawn = {axes.get_title(): axes.lines[0].get_xydata() for axes in every}
    assert list(drawn) == ["training loss", "density control"]
    np.testing.assert_array_equal(drawn["density control"], [[7, 40]])
    thinned = drawn["training loss"]
    assert len(thinned) == 400 and thinned[0, 0] == np.mean(range(13)) and (thinned[:, 1] == 0).all()


def test_a_drawing_has_unique_ids_and_is_repeatable():
    log = [{"iteration": i, "loss": 1.0 / (i + 1)} for i in range(5000)]
    first, second = (svg_element(*run_curve_figures(log)) for _ in range(2))
    other = svg_element(*run_curve_figures(log), name="other")
    ids, others = (set(re.findall(r'id="(p[0-9a-f]{10})"', text)) for text in (first, other))
    assert ids and others and not ids & others, (
        "with equal ids, the clip path of one drawing would cut the other"
    )
    assert first == second and first.startswith("<svg") and len(first) < 100_000


def test_exports_are_listed_with_their_figures(tmp_path):
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
