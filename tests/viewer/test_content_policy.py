"""The content policy of pages and reports in a browser: our code works, injected code does not run."""

import re

import numpy as np
import pytest

from gsplat_edu.base.content_policy import content_policy
from gsplat_edu.evaluate.report import Picture, Report, write_report
from gsplat_edu.io.scene import Scene
from gsplat_edu.viewer import page
from viewer.handles import until
from waiting import FRAMES, awaited

INJECTED = (
    "<script>window.ran = 'script'</script>"
    '<img src="data:," onerror="window.ran = \'handler\'">'
    '<a id="link" href="javascript:window.ran=1">link</a>'
    "<style>body { color: rgb(1, 2, 3) }</style>"
    '<iframe srcdoc="<script>parent.ran = 1</script>"></iframe>'
)


def written_page(path, random_gaussians, three_views):
    page.write(path, Scene(random_gaussians(30)), three_views)


def written_report(path, *_):
    photo = np.full((24, 32, 3), 90, np.uint8)
    log = [{"iteration": i, "loss": 1 / i, "num_gaussians": 10 * i} for i in range(1, 40)]
    pictures = [Picture.of("a", photo, photo // 2)]
    write_report(path, Report("run", {"test": {"num_images": 1, "psnr": 20.0}}, log, pictures=pictures))


@pytest.mark.parametrize("write", [written_page, written_report])
def test_our_own_code_works_without_complaints(visit, tmp_path, write, random_gaussians, three_views):
    write(tmp_path / "a.html", random_gaussians, three_views)
    seen = visit().open(tmp_path / "a.html")
    if write is written_page:
        seen.ready()
        return  # tests/viewer/test_page_drawing.py compares the pictures, which need the worker
    figure = seen.tab.locator("svg").first
    assert figure.is_visible()
    strokes = figure.locator("path").evaluate_all(
        "paths => paths.map((path) => getComputedStyle(path).stroke)"
    )
    assert len({stroke for stroke in strokes if stroke != "none"}) >= 2, "the style sheet colours the curves"


def refuses(tab, logged, least):
    """Wait until the browser has logged that the policy refuses something, at least so often."""
    awaited(tab, lambda: sum("Content Security Policy" in text for text in logged) >= least)


@pytest.mark.parametrize("write", [written_page, written_report])
def test_injected_code_does_not_run(browser, tmp_path, write, random_gaussians, three_views):
    path = tmp_path / "a.html"
    write(path, random_gaussians, three_views)
    document = path.read_text("utf-8")
    (body,) = re.findall("<body.*?>", document)
    path.write_text(document.replace(body, body + INJECTED), "utf-8")
    tab = browser.new_page()
    refusals = []
    tab.on("console", lambda message: refusals.append(message.text))
    tab.goto(path.as_uri())
    tab.evaluate("document.getElementById('link').click()")
    refuses(tab, refusals, 4)
    tab.evaluate(FRAMES)
    assert tab.evaluate("window.ran") is None
    assert tab.evaluate("getComputedStyle(document.body).color") != "rgb(1, 2, 3)"
    # without the policy, the injected code runs
    start = document.index('<meta http-equiv="Content-Security-Policy"')
    unguarded = document[:start] + document[document.index(">", start) + 1 :]
    path.write_text(unguarded.replace(body, body + INJECTED), "utf-8")
    tab.goto(path.as_uri())
    until(tab, "window.ran !== undefined")
    tab.close()


def test_nothing_leaves_the_page(visit, tmp_path):
    """Not even the page's own scripts may send a request."""
    script = (
        "fetch('http://127.0.0.1:9/').catch(() => { document.title = 'refused' });"
        "new Image().src = 'http://127.0.0.1:9/a.png';"
    )
    path = tmp_path / "a.html"
    policy = content_policy([script]).replace('"', "&quot;")
    path.write_text(
        f'<meta http-equiv="Content-Security-Policy" content="{policy}"><title>a</title><script>{script}</script>'
    )
    seen = visit()
    seen.open(path)
    until(seen.tab, "document.title === 'refused'")
    refuses(seen.tab, seen.complaints, 2)
    seen.complaints.clear()
    seen.requests.clear()  # Chromium lists refused requests as well


def test_a_policy_allows_only_the_given_scripts_and_styles():
    rules = dict(rule.split(" ", 1) for rule in content_policy().split("; "))
    assert {rules[name] for name in ("default-src", "script-src", "style-src", "worker-src")} == {"'none'"}
    assert rules["img-src"] == "data: blob:" and rules["connect-src"] == "'none'"
    # the published SHA-256 of "a"
    known = "'sha256-ypeBEsobvcr6wjGzmiPcTaeG7/gUfE5yuYB3ha/uSLs='"
    rules = dict(rule.split(" ", 1) for rule in content_policy(["a"], ["a"], workers=True).split("; "))
    assert rules["script-src"] == rules["style-src"] == known and rules["worker-src"] == "blob:"
    markup = '<svg><style>a</style><path style="a"/><path style="b &amp; c"/></svg>'
    styles = dict(rule.split(" ", 1) for rule in content_policy(markup=markup).split("; "))["style-src"]
    first, keyword, second, third = styles.split(" ")
    assert (first, keyword, second) == (known, "'unsafe-hashes'", known) and third.startswith("'sha256-")
