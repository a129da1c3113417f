"""A run in the studio's page: one counter and clock, curves, the photo beside the render, Judge and Share."""

import json
import re

import pytest

from gsplat_edu.data.procedural import procedural_capture
from gsplat_edu.data.writers import write_colmap
from gsplat_edu.edits.document import empty_document
from gsplat_edu.edits.identity import identity_of
from gsplat_edu.runs.source import open_source
from processes import Program
from studio.pages import COMMAND, DROP, encoded, frame_of, go, held_back, png, waiting
from waiting import awaited, resize, until_in


@pytest.fixture(scope="module")
def runs(library, tmp_path_factory):
    """A capture and two runs of it in the library; the second one was trained longer."""
    root = library[0].library.root
    write_colmap(root / "captures" / "egg", *procedural_capture(48, 8, splats=120))
    for name, iterations in (("egg", 20), ("egg-2", 80)):
        words = [
            "train",
            root / "captures" / "egg",
            "--out",
            root / "runs" / name,
            "--iterations",
            iterations,
        ]
        assert Program(COMMAND, [*words, "--test-every", 4], tmp_path_factory.mktemp(name)).ended()[0] == 0
    return root / "runs"


def test_a_scene_that_goes_while_its_frame_opens_is_shown_once_it_is_back(visitor, runs):
    person, refused = visitor(), []
    away = runs.parent / "away"

    def opened(route):
        if not refused and route.request.method == "GET":
            (runs / "egg").rename(away)
            answer = route.fetch()
            refused.append(answer.status)
            away.rename(runs / "egg")
            route.fulfill(response=answer)
        else:
            route.continue_()

    person.tab.route("**/api/runs/egg/page*", opened)
    frame_of(go(person.tab, "runs/egg"))
    assert refused == [404]


@pytest.mark.parametrize(("tab_name", "address"), [("judge", "views"), ("share", "exports")])
def test_what_the_studio_did_not_answer_is_asked_for_again(visitor, library, runs, tab_name, address):
    person = visitor()
    person.tab.route(f"**/api/runs/egg/{address}", lambda route: route.abort(), times=1)
    line = go(person.tab, f"runs/egg/{tab_name}").locator(
        "main .error", has_text="The studio does not answer"
    )
    line.wait_for()
    library[0].stream.library_changed()
    line.wait_for(state="hidden")


def test_the_cover_is_shown_until_the_scene_is_drawn(visitor, runs):
    person = visitor()
    resize(person.tab, 1440, 900)
    held = held_back(person.tab, "**/api/runs/egg/page*", lambda request: request.method == "GET")
    tab = go(person.tab, "runs/egg")
    cover = tab.locator(".scene .cover")
    cover.wait_for()
    until_in(tab, tab, "document.querySelector('.scene .cover').naturalWidth === 512")
    assert "/cover?" in cover.get_attribute("src")
    box, stage = cover.bounding_box(), tab.locator(".scene").bounding_box()
    assert box == stage, "it fills the stage"
    before = person.shift()
    awaited(tab, lambda: held, "the frame asks for the page")
    for route, answer in held:
        route.fulfill(response=answer)
    tab.unroute("**/api/runs/egg/page*")
    frame_of(tab)
    cover.wait_for(state="hidden")
    assert person.shift() - before < 0.01 and tab.locator(".scene").bounding_box() == stage


def test_a_training_without_a_folder_shows_a_photo_of_its_capture(visitor, library, runs):
    studio = library[0]
    with waiting(studio):
        studio.start({"command": "train", "subject": "captures/egg", "to": "later"})
        assert not (runs / "later").exists()
        tab = go(visitor().tab, "runs/later")
        tab.locator(".scene .cover[src*='/captures/egg/thumbs/']").wait_for()
        tab.locator(".head").get_by_role("link", name="egg", exact=True).wait_for()


@pytest.mark.parametrize("size", [(390, 844), (1440, 900)])
def test_nothing_lies_on_the_photo_beside_the_render(visitor, runs, size):
    person = visitor()
    tab = go(person.tab, "runs/egg")
    resize(tab, size[0], size[1])
    frame = frame_of(tab)
    until_in(tab, tab, "document.querySelectorAll('#beside-view option').length > 2")
    tab.get_by_label("View", exact=True).select_option(index=2)
    tab.locator(".over-photo:not([hidden])").wait_for()
    assert not frame.locator("#bar").is_visible(), "the bar lies on the photo"
    tab.get_by_label("View", exact=True).select_option(index=0)
    assert frame.locator("#bar").is_visible()


@pytest.mark.parametrize("size", [(390, 844), (1440, 900)])
def test_a_title_that_is_the_day_of_the_photos_is_seen_whole(visitor, runs, size):
    tab = go(visitor().tab, "runs/egg/share")
    resize(tab, size[0], size[1])
    title = tab.get_by_label("Title and name of the file")
    title.fill("Photos of 30 September 2026")
    assert title.evaluate("(one) => one.scrollWidth <= one.clientWidth")


PHOTOS_SHOWN = """() => {
  const photo = document.querySelector(".over-photo");
  window.photosShown = [];
  new MutationObserver(() => photo.hidden || photosShown.push(photo.src)).observe(photo, { attributes: true });
}"""


def test_a_photo_that_comes_late_is_not_laid_over_another_view(visitor, runs):
    """The list of photos is on its way when the free view is chosen again."""
    tab, held = go(visitor().tab, "runs/egg"), []
    frame_of(tab)
    until_in(tab, tab, "document.querySelectorAll('#beside-view option').length > 2")
    tab.evaluate(PHOTOS_SHOWN)
    tab.route("**/captures/egg/photos", lambda route: route.continue_() if held else held.append(route))
    view = tab.get_by_label("View", exact=True)
    names = view.locator("option").all_inner_texts()
    view.select_option(index=2)
    awaited(tab, lambda: held)
    view.select_option(index=0)
    held[0].continue_()
    view.select_option(index=1)
    tab.locator(".over-photo:not([hidden])").wait_for()
    shown = tab.evaluate("photosShown")
    assert all(names[1].split(" ")[0] in one for one in shown), shown


def test_a_photo_waits_for_the_picture_of_its_view(visitor, runs):
    """Neither the photo nor the render beside it may be of another camera, however slowly the scene is drawn."""
    tab = go(visitor().tab, "runs/egg")
    frame = frame_of(tab)
    until_in(tab, tab, "document.querySelectorAll('#beside-view option').length > 2")
    frame.evaluate(
        "window.held = []; viewer.frame = ((frame) => (now) => held.push(() => frame.call(viewer, now)))(viewer.frame)"
    )
    view, photo = tab.get_by_label("View", exact=True), tab.locator(".over-photo")
    for index in (1, 2):
        view.select_option(index=index)
        until_in(tab, frame, "held.length > 0")
        until_in(tab, tab, "document.querySelector('.over-photo').complete")
        tab.get_by_text("Drawing this view ...").wait_for()
        assert not photo.is_visible() and tab.get_by_label("Photo ↔ render").is_disabled()
        frame.evaluate("viewer.frameAsked = 0; held.splice(0).forEach((draw) => draw())")
        until_in(
            tab,
            frame,
            "viewer.isWhole || (viewer.frameAsked = 0, held.splice(0).forEach((draw) => draw()), false)",
        )
        photo.wait_for()
        name = view.locator("option").nth(index).inner_text().split(" ")[0]
        assert name in photo.get_attribute("src")
        assert not tab.get_by_text("Drawing this view ...").is_visible()


def test_clean_says_what_it_removed_and_carries_the_edits_over(visitor, runs):
    source = open_source(runs / "egg-2")
    identity = identity_of(source.scene)
    mine = json.loads(empty_document(identity)) | {
        "operations": [{"op": "measure", "points": [[0, 0, 0], [1, 0, 0]], "note": "a"}]
    }
    (runs / "egg-2" / "edits.json").write_text(json.dumps(mine))
    person = visitor()
    tab = go(person.tab, "runs/egg-2/share")
    section = tab.get_by_role("region", name="cleaning")
    tab.get_by_label("apply the edits").wait_for()
    section.get_by_role("button", name="Clean", exact=True).click()
    section.get_by_role("link", name="Open the scene egg-2-clean").wait_for()
    listed = section.get_by_role("list", name="what was cleaned")
    for said in ("removed", "PSNR of"):  # what a job prints last may be told after its end
        listed.get_by_text(said).first.wait_for()
    carried = json.loads((runs.parent / "scenes" / "egg-2-clean" / "edits.json").read_text())
    assert carried["operations"] == mine["operations"]
    section.get_by_role("link", name="Open the scene egg-2-clean").click()
    person.reach("#/scenes/egg-2-clean")


def test_visitors_of_an_exported_run_can_check_it(visitor, runs):
    person = visitor()
    tab = go(person.tab, "runs/egg/share")
    box = tab.get_by_label("let visitors check the scene")
    box.check()
    tab.get_by_label("SPZ").first.check()
    assert not box.is_visible()  # only a page shows photos
    tab.get_by_label("HTML page").check()
    tab.get_by_label("Title and name of the file").fill("proof")
    tab.get_by_role("button", name="Export").click()
    tab.locator(".exports li", has_text="proof.html").wait_for()
    assert person.command("export of proof.html").endswith("--verify photos")
    other = tab.context.new_page()
    other.goto((runs / "egg" / "exports" / "proof.html").as_uri())
    other.wait_for_selector("#message", state="hidden")
    assert other.evaluate("viewer.compare.urls.length") == 8, "the capture has no more photos"
    assert other.get_by_role("button", name="what photos saw").is_visible()
    other.close()


def test_one_held_out_score_is_a_point(visitor, runs):
    tab = go(visitor().tab, "runs/egg")
    plot = tab.locator(".curve", has_text="PSNR of held-out views").locator("path")
    plot.wait_for(state="attached")
    box = plot.evaluate("(path) => { const { x, width } = path.getBBox(); return [x, width]; }")
    assert box == [300, 0], "the score lies at the last iteration, and nowhere else"


@pytest.mark.parametrize(("opened", "other"), [("egg", "egg-2"), ("egg-2", "egg")])
def test_the_better_run_is_named_whichever_was_opened(visitor, runs, opened, other):
    tab = go(visitor().tab, f"runs/{opened}/compare/{other}")
    facts = tab.get_by_role("region", name="comparison").locator(".facts:not(:empty)")
    facts.wait_for()
    said = facts.inner_text()
    assert said.startswith("egg-2 is better in 2 of 2 views. Mean PSNR: "), said
    means = {run: float(mean) for run, mean in re.findall(r"(egg\S*) ([\d.]+) dB", said)}
    assert means["egg-2"] > means["egg"]


COUNTERS = re.compile(r"[\d,]+ of 100,000|[Aa]fter [\d,]+ iterations|iteration [\d,]+\b(?!: test PSNR)")
"""Texts that say how far a training is; the line about a score names the iteration of the score."""

CLOCKS = re.compile(r"\bleft\b")


def test_a_training_has_one_counter_and_one_clock(visitor, runs):
    """All texts of the screen and of the page inside, of one moment."""
    person = visitor()
    tab = go(person.tab, "captures/egg")
    resize(tab, 1440, 900)
    tab.locator("summary", has_text="More").click()
    tab.get_by_label("Iterations instead of a quality").fill("100000")
    tab.get_by_role("button", name="Start training").click()
    person.reach("#/runs/egg-run-2")
    # by its title, because the screen before this one has a scene as well
    frame = tab.wait_for_selector("iframe[title='scene of egg-run-2']:not([hidden])").content_frame()
    until_in(
        tab, frame, "Boolean(window.live?.state?.iteration) && document.getElementById('message').hidden"
    )
    tab.locator(".left", has_text=CLOCKS).wait_for()
    tab.locator(".curve .axis .last:not(:empty)").first.wait_for()
    for unfold in (False, True):
        if unfold and not frame.locator("#tools").is_visible():
            frame.locator("#fold").click()
        texts = [tab.inner_text("main"), frame.inner_text("#panel")]
        found = [COUNTERS.findall(text) for text in texts]
        assert len(found[0]) == 1 and found[1] == [], found
        assert [len(CLOCKS.findall(text)) for text in texts] == [1, 0], texts
    tab.get_by_role("button", name="Stop", exact=True).click()
    tab.locator(".job .state", has_text="stopp").wait_for()
    assert "training" not in frame.inner_text("body")
    tab.locator(".job .state", has_text="stopped").wait_for()


def test_normal_use_leaves_no_errors_in_the_console(visitor, runs):
    """From the start of a training to its judgement; a browser logs each answer from 400 on as an error."""
    person = visitor()
    said = []
    person.tab.on(
        "console", lambda message: said.append((message.type, message.text, message.location.get("url")))
    )
    tab = go(person.tab, "captures/egg")
    tab.locator("summary", has_text="More").click()
    tab.get_by_label("Iterations instead of a quality").fill("150")
    tab.get_by_role("button", name="Start training").click()
    tab.get_by_role("link", name="Judge it").wait_for()
    tab.locator(".verdict").wait_for()
    figures = tab.get_by_text("After 150 iterations, renders of the held-out photos reach")
    assert figures.is_hidden()
    tab.get_by_text("Details", exact=True).first.click()
    figures.wait_for()
    frame_of(tab)
    tab.get_by_role("link", name="Judge it").click()
    tab.locator(".views li").first.wait_for()
    tab.locator(".tabs").get_by_role("link", name="Share", exact=True).click()
    tab.get_by_role("button", name="Export", exact=True).wait_for()
    tab.get_by_role("link", name="Edit", exact=True).click()
    frame_of(tab)
    assert [one for one in said if one[0] == "error"] == []


def test_the_report_is_linked(visitor, runs):
    tab = go(visitor().tab, "runs/egg/judge")
    with tab.context.expect_page() as opened:
        tab.get_by_role("link", name="Open the report").click()
    opened.value.locator("body", has_text="held-out photos").wait_for()


@pytest.mark.parametrize("size", [(390, 844), (1440, 900)])
def test_nothing_pushes_the_pictures_down(visitor, runs, size):
    tab = go(visitor().tab, "runs/egg")
    resize(tab, size[0], size[1])
    frame_of(tab)
    if size[0] > 960:  # two columns
        live, figures = (
            tab.locator(place).bounding_box()["y"] for place in (".scene", ".right-side > :first-child")
        )
        assert figures == live, f"the column beside the scene begins {figures - live:.0f} px below it"
        verdict = tab.locator(".right-side > :first-child").inner_text()
        assert verdict.startswith(("Good", "Fair", "Poor"))
    tab.get_by_role("link", name="Edit", exact=True).click()
    editor = tab.locator(".scene.tall")  # until it is there, the screen still shows the scene of *Watch*
    editor.wait_for()
    top = editor.bounding_box()["y"] + tab.evaluate("scrollY")
    assert "null" not in tab.inner_text("main")
    assert top < 190, f"the editor begins {top:.0f} px down"


def test_the_text_of_an_upload_stays_in_its_card(visitor):
    tab = visitor().tab
    tab.route("**/files/**", lambda route: None)  # the upload waits
    tab.locator(".drop").wait_for(state="attached")
    photos = [[f"a-rather-long-folder-name/IMG_{i:04}.png", encoded(png(i, (300, 200)))] for i in range(112)]
    tab.evaluate(DROP, [photos, ".drop"])
    card = tab.locator(".batches .job")
    card.wait_for()
    for width, height in ((320, 700), (390, 844), (1440, 900)):
        resize(tab, width, height)
        inside = card.bounding_box()
        for part in card.locator(".progress > *").all():
            box = part.bounding_box()
            hidden = part.evaluate("(element) => element.scrollWidth - element.clientWidth")
            over = max(hidden, box["x"] + box["width"] - inside["x"] - inside["width"])
            assert over <= 0 and box["x"] >= inside["x"], f"{part.inner_text()!r} is {over:.0f} px too wide"
        assert tab.evaluate("document.documentElement.scrollWidth") <= width
    tab.get_by_role("button", name="Stop", exact=True).click()
    tab.unroute("**/files/**")
