"""The site builds without a warning, opens from disk, and has no broken link.

Every page is built, but outside of soaks only the modules of the public API are documented: all modules take four
times as long.
"""

import math
import re
import subprocess
import sys
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit

import pytest

from build_site import built_from
from chapters import SOURCES
from gsplat_edu.tab.serving import PAGE, POLICY, page_files
from tiers import SOAK
from waiting import until, until_in

ROOT = Path(__file__).parents[2]
NOT_PROSE = ("pre", "code", "dt", "math", "script", "style", "title")
"""Tags whose text is not prose, such as programs, signatures and equations."""

MODULES = sorted((ROOT / "src" / "gsplat_edu").rglob("*.py"))


class Page(HTMLParser):
    """The links of a page, the files it loads, and its anchors."""

    def __init__(self, text):
        super().__init__()
        self.links, self.loaded, self.anchors, self.tags = [], [], set(), set()
        self.prose, self.within = [], []
        self.feed(text)

    def handle_starttag(self, tag, attributes):
        found = dict(attributes)
        self.tags.add(tag)
        self.within += [tag] if tag in NOT_PROSE else []
        self.anchors |= {found[name] for name in ("id", "name") if found.get(name)}
        self.links += [found["href"]] if tag == "a" and found.get("href") else []
        self.loaded += [found["href"]] if tag == "link" and found.get("rel") == "stylesheet" else []
        self.loaded += [found["src"]] if tag in ("img", "script") and found.get("src") else []

    def handle_endtag(self, tag):
        if self.within and self.within[-1] == tag:
            self.within.pop()

    def handle_data(self, text):
        self.prose += [] if self.within else [text]


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    out = tmp_path_factory.mktemp("built") / "site"
    command = [sys.executable, str(ROOT / "course" / "build_site.py"), "--out", str(out)]
    command += [] if SOAK else ["--public"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "WARNING" not in done.stdout + done.stderr
    return {path: Page(path.read_text()) for path in sorted(out.rglob("*.html"))}, out


def broken(pages, out):
    """Find links within the site to missing pages or missing anchors."""
    found = []
    for path, page in pages.items():
        for link in [*page.links, *page.loaded]:
            url = urlsplit(link)
            if url.scheme or url.netloc:
                continue
            target = (path.parent / unquote(url.path)).resolve() if url.path else path
            lost = url.fragment and target in pages and url.fragment not in pages[target].anchors
            if not target.is_file() or not target.is_relative_to(out) or lost:
                found.append(f"{path.relative_to(out)}: {link}")
    return found


@pytest.mark.slow
def test_no_link_is_broken_and_nothing_is_loaded_from_elsewhere(site):
    pages, out = site
    assert broken(pages, out) == []
    assert not [
        link for page in pages.values() for link in page.loaded if "://" in link or link.startswith("//")
    ]


def chapters_of(out):
    """Return the pages of the chapters."""
    return [out / "notebooks" / f"{source.stem}.html" for source in SOURCES]


@pytest.mark.slow
def test_every_chapter_document_and_module_has_a_page(site):
    pages, out = site
    names = {str(path.relative_to(out).with_suffix("")) for path in pages}
    assert {f"notebooks/{path.stem}" for path in (ROOT / "notebooks").glob("*.ipynb")} <= names
    assert {
        "README",
        "ARCHITECTURE",
        "docs/DECISIONS",
        "docs/TOUR",
        "reference/gsplat_edu.scene.camera",
    } <= names
    assert {f"docs/howto/{path.stem}" for path in (ROOT / "docs" / "howto").glob("*.md")} <= names
    assert len([name for name in names if name.startswith("reference/gsplat_edu")]) == len(MODULES)
    course = [pages[path] for path in chapters_of(out)]
    assert all("img" in page.tags for page in course), "the page has figures"
    assert sum("math" in page.tags for page in course) > 5, "the page has equations"


@pytest.mark.slow
def test_the_site_has_the_page_that_trains_in_a_tab(site):
    """With its policy in the page, since the site has no server of ours, and all files that the server has."""
    _, out = site
    assert "train/index.html" in (out / "index.html").read_text()
    files = page_files().keys() - {PAGE}
    assert all((out / "train" / address.removeprefix("/")).is_file() for address in files)
    assert f'content="{POLICY}"' in (out / "train" / "index.html").read_text()


@pytest.mark.slow
def test_the_landing_page_shows_pictures_and_three_ways_in(site):
    pages, out = site
    text = (out / "index.html").read_text()
    assert re.findall(r"<h2>(.*?)</h2>", text)[:3] == ["Learn", "Use", "Build on"]
    assert len([picture for picture in pages[out / "index.html"].loaded if "_static" in picture]) > 3
    captions = re.findall(r'class="caption-text">(.*?)<', text.split("sidebar-tree")[1])
    assert captions[:3] == ["Learn", "Use", "Build on"]
    # modules and records are folded behind their indices
    shown = re.findall(r'class="toctree-l1[^"]*"><a class="reference internal" href="(.*?)"', text)
    assert not [link for link in shown if "gsplat_edu." in link or re.search(r"decisions/\d", link)]
    assert "docs/decisions/index.html" in shown and "reference/index.html" in shown


def live_scene(tab):
    """Return the frame of the scene in an open landing page, once it has drawn all splats."""
    tab.wait_for_selector(".live #scene iframe")
    scene = tab.locator("#scene iframe").element_handle().content_frame()
    until_in(tab, scene, "Boolean(window.viewer?.isWhole)")
    return scene


def overflowing(tab):
    """List the pictures of an open page that are cropped or wider than the window."""
    return tab.evaluate(
        """() => [...document.querySelectorAll("article img")].filter(picture => {
            const { left, right } = picture.getBoundingClientRect();
            const shape = picture.clientWidth / picture.clientHeight;
            const whole = getComputedStyle(picture).objectFit === "contain"
                || Math.abs(shape - picture.naturalWidth / picture.naturalHeight) < 0.02;
            return !picture.naturalWidth || left < 0 || right > innerWidth || !(whole || picture.closest("#scene"));
        }).map(picture => picture.src)"""
    )


@pytest.mark.slow
@pytest.mark.parametrize(("width", "height"), [(1440, 900), (390, 844)])
def test_the_landing_page_shows_a_live_scene_that_keys_turn(site, browser, width, height):
    _, out = site
    assert (out / "_static" / "scene.html").stat().st_size < 700_000
    tab, said = browser.new_page(viewport={"width": width, "height": height}), []
    tab.on("console", lambda message: said.append(message.text))
    tab.on("pageerror", lambda error: said.append(str(error)))
    tab.goto((out / "index.html").as_uri())
    stage = tab.locator("#scene").bounding_box()
    assert stage["y"] + stage["height"] < height, "the scene is in the first screen"
    scene = live_scene(tab)
    pixels = """async () => {
        const small = { W: 64, H: 27, fx: 74, fy: 74, cx: 32, cy: 13.5 };
        return [...(await viewer.setCamera({ ...viewer.view.camera, ...small })).pixels];
    }"""
    drawn = scene.evaluate(pixels)
    background = scene.evaluate("viewer.facts.settings.background")
    differs = [abs(drawn[i] - background[0]) > 0.05 for i in range(0, len(drawn), 3)]
    assert 0.3 < sum(differs) / len(differs) < 0.95, "houses before a sky"
    eye, pivot = (scene.evaluate(f"viewer.view.{name}") for name in ("camera.eye", "focus"))
    tab.locator("#scene").click()
    for key in ("ArrowRight", "ArrowDown"):
        tab.keyboard.press(key)
    until(lambda: math.dist(scene.evaluate("viewer.view.camera.eye"), eye) > 1e-3)
    moved = scene.evaluate("viewer.view.camera.eye")
    assert math.dist(moved, pivot) == pytest.approx(math.dist(eye, pivot)), "keys orbit"
    assert scene.evaluate(pixels) != drawn
    assert overflowing(tab) == []
    assert tab.evaluate("document.documentElement.scrollWidth") <= width
    assert [text for text in said if "GPU stall due to ReadPixels" not in text] == []
    tab.close()


@pytest.mark.slow
def test_the_wheel_scrolls_the_landing_page_until_the_scene_is_clicked(site, browser):
    _, out = site
    tab = browser.new_page(viewport={"width": 1200, "height": 600})
    tab.goto((out / "index.html").as_uri())
    scene = live_scene(tab)
    before = scene.evaluate("viewer.view.distance")
    tab.locator("#scene").hover()
    tab.mouse.wheel(0, 100)
    until(lambda: tab.evaluate("scrollY > 0"))
    assert scene.evaluate("viewer.view.distance") == before
    tab.locator("#scene").click()
    tab.mouse.wheel(0, 100)
    until(lambda: scene.evaluate("viewer.view.distance") > before)
    tab.close()


@pytest.mark.slow
def test_the_landing_page_without_scripts_shows_the_still_picture(site, browser):
    _, out = site
    context = browser.new_context(java_script_enabled=False)
    tab = context.new_page()
    tab.goto((out / "index.html").as_uri())
    assert tab.locator("#scene img").is_visible() and tab.locator("#scene iframe").count() == 0
    assert not tab.locator(".scripted").is_visible(), "no word about keys"
    context.close()


@pytest.mark.slow
def test_the_reference_begins_with_the_public_api_and_links_every_name(site):
    _, out = site
    text = (out / "reference" / "index.html").read_text()
    public, _, rest = text.partition(">Packages<")
    rows = re.findall(
        r"<tr class=\"row-(?:odd|even)\"><td>(.*?)</td>\s*<td>(.*?)</td>", public, flags=re.DOTALL
    )
    assert len(rows) > 30
    assert [row for row in rows if "href=" not in row[0] or len(row[1]) < 10] == []
    assert "gsplat_edu.render.html" in rest and "gsplat_edu.render.cpu.render.html" not in rest


@pytest.mark.slow
def test_set_up_cells_are_folded_and_others_are_not(site):
    _, out = site
    for path in chapters_of(out):
        text = path.read_text()
        assert re.search(
            r'<span class="n">\w+</span> <span class="o">=</span> <span class="o">\.\.\.</span>', text
        ), path.name
        folded = re.findall(r'<details class="[^"]*hide above-input">', text)
        assert 1 <= len(folded) < text.count("cell_input"), path.name


@pytest.mark.slow
@pytest.mark.parametrize("width", [1440, 390])
def test_no_line_of_code_is_cut_off(site, width, browser):
    """Code and printed output fit into their box or wrap."""
    _, out = site
    page = browser.new_page(viewport={"width": width, "height": 900})
    for name in ("notebooks/10_the_naive_kernel.html", "README.html", "docs/PYTHON.html", "docs/CLI.html"):
        page.goto((out / name).as_uri())
        cut = page.evaluate(
            """() => [...document.querySelectorAll("article pre")]
                .filter(pre => pre.offsetParent)
                .filter(pre => pre.scrollWidth > pre.clientWidth + 1).map(pre => pre.innerText.slice(0, 80))"""
        )
        assert cut == [], name
        assert page.evaluate("document.documentElement.scrollWidth") <= width, name
    page.close()


@pytest.mark.slow
@pytest.mark.parametrize("width", [1440, 390])
def test_pictures_of_chapters_are_whole_and_large_enough_to_read(site, width, browser):
    """A picture that is wider than a phone keeps up to 640 px of its width, and its cell scrolls."""
    _, out = site
    page = browser.new_page(viewport={"width": width, "height": 900})
    for path in chapters_of(out):
        page.goto(path.as_uri())
        pictures = page.evaluate(
            """() => [...document.querySelectorAll(".cell_output img")].map(picture => {
                const cell = picture.closest(".cell_output"), scrolls = getComputedStyle(cell).overflowX === "auto";
                return [picture.clientWidth, picture.naturalWidth, cell.clientWidth, scrolls];
            })"""
        )
        assert pictures, path.name
        for shown, natural, room, scrolls in pictures:
            assert shown >= min(natural, 640) - 1, f"{path.name}: {natural} px are shown as {shown} px"
            assert shown <= room + 1 or scrolls, f"{path.name}: {shown} px do not fit into {room} px"
        assert page.evaluate("document.documentElement.scrollWidth") <= width, path.name
    page.close()


@pytest.mark.slow
def test_broken_links_are_found(site, tmp_path):
    texts = {"a": '<a href="b.html#here"><a href="gone.html#x">', "b": '<p id="there"><img src="c.png">'}
    for name, text in texts.items():
        (tmp_path / f"{name}.html").write_text(text)
    pages = {tmp_path / f"{name}.html": Page(text) for name, text in texts.items()}
    assert broken(pages, tmp_path) == ["a.html: b.html#here", "a.html: gone.html#x", "b.html: c.png"]


@pytest.mark.slow
def test_no_equation_and_no_docstring_is_garbled(site):
    pages, _ = site
    for path, page in pages.items():
        prose = "".join(page.prose)
        assert "$" not in prose and not re.search(r"\\[a-zA-Z]", prose), path
        assert "Return type" not in prose, "signatures have types"


@pytest.mark.slow
def test_every_chapter_says_which_commit_it_was_built_from(site):
    _, out = site
    commit = built_from()
    for source in SOURCES:
        text = re.sub(r"<[^>]+>", "", (out / "notebooks" / f"{source.stem}.html").read_text())
        assert f"This page was built from notebooks/source/{source.name} at commit {commit}." in text


def test_the_commit_of_a_working_tree_and_of_an_archive(tmp_path, monkeypatch):
    assert built_from(tmp_path) == "unknown"

    def git(*words):
        who = ["-c", "user.name=a", "-c", "user.email=a@b", "-c", "commit.gpgsign=false"]
        done = subprocess.run(
            ["git", "-C", tmp_path, *who, *words], capture_output=True, text=True, check=True
        )
        return done.stdout.strip()

    git("init", "-q")
    (tmp_path / "chapter").write_text("one")
    git("add", "chapter")
    git("commit", "-q", "-m", "one")
    commit = git("rev-parse", "HEAD")[:12]
    built_from.cache_clear()
    assert built_from(tmp_path) == commit
    (tmp_path / "archive").mkdir()
    assert built_from(tmp_path / "archive") == "unknown", "of no commit of the repository around it"
    (tmp_path / "chapter").write_text("two")
    built_from.cache_clear()
    assert built_from(tmp_path) == f"{commit}-dirty"
    built_from.cache_clear()
    monkeypatch.setenv("PATH", "")
    assert built_from(tmp_path) == "unknown", "without git"


def test_a_folder_that_is_not_a_site_is_not_overwritten(tmp_path):
    (tmp_path / "thesis.txt").write_text("years")
    command = [sys.executable, str(ROOT / "course" / "build_site.py"), "--out", str(tmp_path)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 2 and done.stderr.count("\n") == 1
    assert (tmp_path / "thesis.txt").read_text() == "years"
