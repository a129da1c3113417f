"""What the page says of findings and of stopped jobs: in its own words, with a button for what it can do."""

import contextlib
import re

import pytest

from accessibility import grave_faults
from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.data.dataset import load_dataset
from gsplat_edu.data.left_out import LEFT_OUT, read_left_out
from gsplat_edu.data.procedural import procedural_capture
from gsplat_edu.data.writers import write_colmap
from gsplat_edu.jobs.record import ACTIVE, JobFolder, Rendered
from gsplat_edu.scene.views import View
from processes import Program
from studio.pages import COMMAND, examined, go, waiting
from studio.test_page_watch import runs
from waiting import awaited, until_in

__all__ = ["runs"]

COMMANDS = re.compile(r"gsplat-edu|--[a-z]|/live/|\.json")
"""What only a command line can use: commands, options and files of its own."""


@pytest.fixture
def jumping(library, request):
    """The name of a capture whose every third photo is darker by a stop; each test has its own."""
    name = re.sub(r"[^a-z0-9]+", "-", f"jumps-{request.node.name}").rstrip("-")
    views, points, colors = procedural_capture(96, 16, splats=400)
    darker = [
        View(view.camera, view.read().image // (2 if i % 3 == 0 else 1), name=view.name)
        for i, view in enumerate(views)
    ]
    write_colmap(library[0].library.root / "captures" / name, darker, points, colors)
    return name


@pytest.fixture(scope="module")
def swapped(library, tmp_path_factory):
    """A capture whose photo view_005 was taken from elsewhere, and a run of it."""
    root = library[0].library.root
    views, points, colors = procedural_capture(96, 16, splats=400)
    views = [*views[:5], View(views[5].camera, views[12].read().image, name=views[5].name), *views[6:]]
    write_colmap(root / "captures" / "swapped", views, points, colors)
    words = ["train", root / "captures" / "swapped", "--out", root / "runs" / "swapped", "--iterations", 200]
    assert Program(COMMAND, words, tmp_path_factory.mktemp("swapped")).ended()[0] == 0


def test_exposure_jumps_are_corrected_by_a_button(visitor, library, jumping):
    person = visitor()
    tab = go(person.tab, f"captures/{jumping}")
    part = examined(tab)
    said = part.locator(".found").inner_text()
    assert "exposure correction" in said and not COMMANDS.search(said), said
    with waiting(library[0]):
        part.get_by_role("button", name="Train with exposure correction").first.click()
        tab.wait_for_url(re.compile(f"#/runs/{jumping}"))
        job = library[0].queue.jobs()[-1]
    assert job.work.options == {"appearance": "exposure"} and job.work.inputs == (f"captures/{jumping}",)


def test_a_training_that_a_finding_began_is_undone(visitor, library, jumping):
    tab = go(visitor().tab, f"captures/{jumping}")
    examined(tab).get_by_role("button", name="Train with exposure correction").first.click()
    tab.wait_for_url(re.compile(f"#/runs/{jumping}"))
    job = library[0].queue.jobs()[-1]
    begun = tab.locator(".begun")
    assert "began this training" in begun.inner_text()
    assert grave_faults(tab) == []
    tab.reload()
    begun.get_by_role("button", name="Undo").click()
    tab.wait_for_url(re.compile(f"#/captures/{jumping}$"))
    assert all(other.id != job.id for other in library[0].queue.jobs())
    assert not (library[0].library.root / job.work.outputs[0]).exists()


@pytest.mark.parametrize("by", ["mouse", "keyboard"])
def test_a_press_counts_although_the_page_changes_meanwhile(visitor, library, jumping, by):
    """The findings are shown anew while the button is pressed."""
    tab, other = (go(visitor().tab, f"captures/{jumping}") for _ in range(2))
    begin = examined(tab).get_by_role("button", name="Train with exposure correction").first
    begin.hover()
    begin.focus()
    held = begin.element_handle()
    tab.mouse.down() if by == "mouse" else tab.keyboard.down(" ")
    other.get_by_role("button", name="Leave out").first.click()
    tab.get_by_role("region", name="doctor").get_by_text(
        "This has changed since the doctor looked"
    ).wait_for()
    assert held.evaluate("(button) => button.isConnected")
    with waiting(library[0]):
        tab.mouse.up() if by == "mouse" else tab.keyboard.up(" ")
        tab.wait_for_url(re.compile(f"#/runs/{jumping}"))


def press_undo(tabs):
    """Press *Undo* in some tabs before the studio hears of the first press: what is undone offers it no longer."""
    asked = []

    def hold(route):
        asked.append(route)

    for tab in tabs:
        tab.route("**/undo", hold, times=1)
        tab.get_by_role("button", name="Undo").click()
    awaited(tabs[0], lambda: len(asked) == len(tabs))
    for route in asked:
        route.continue_()


def test_every_tab_offers_the_undo_until_the_result_is_kept_or_undone(visitor, library, jumping):
    root = library[0].library.root
    person, other = visitor(), visitor()
    tabs = [person.tab, other.tab]
    for undone in (False, True):
        tab = go(person.tab, f"captures/{jumping}")
        tab.get_by_role("button", name="Start training").wait_for()
        if undone:
            tab.get_by_role("button", name="Train with exposure correction").first.wait_for()
        else:
            examined(tab)
        tab.get_by_role("button", name="Train with exposure correction").first.click()
        tab.wait_for_url(re.compile(f"#/runs/{jumping}"))
        job = library[0].queue.jobs()[-1]
        # a tab that knows nothing of the button
        go(other.tab, job.work.outputs[0])
        for one in tabs:
            one.locator(".begun", has_text="“Train with exposure correction” began this training").wait_for()
        assert grave_faults(other.tab) == []
        if not undone:
            other.tab.get_by_role("button", name="Keep it").click()
            for one in tabs:
                one.locator(".begun").wait_for(state="hidden")
                one.reload()
                one.locator("nav.tabs").wait_for()
                assert one.locator(".begun").is_hidden()
            with contextlib.suppress(ArgumentError):  # it has ended
                library[0].queue.cancel(job.id)
            # one that still stops would be in the way of the next, which does the same
            awaited(tab, lambda name=job.id: library[0].queue.get(name).state not in ACTIVE)
            continue
        with contextlib.suppress(ArgumentError):  # it has ended
            library[0].queue.cancel(job.id)
        for one in tabs:
            one.get_by_role("button", name="Undo: remove it and go back").wait_for()
        press_undo(tabs)
        for one in tabs:
            one.wait_for_url(re.compile(f"#/captures/{jumping}$"))
        assert all(found.id != job.id for found in library[0].queue.jobs())
        assert not (root / job.work.outputs[0]).exists()
        assert sum(found["name"] == job.work.outputs[0][5:] for found in library[0].library.trash()) <= 1
    assert not any(found.begun_by for found in library[0].queue.jobs() if jumping in found.work.inputs[0])


def test_a_training_is_undone_once_and_only_if_a_proposal_began_it(page, studio):
    root = studio.library.root
    write_colmap(root / "captures" / "six", *procedural_capture(32, 6, splats=50))
    request = {"command": "train", "subject": "captures/six", "to": "six"}
    for begun, line in (
        ({"by": "x"}, "at: is missing"),
        ({"by": "a\nb", "at": "captures/six"}, "by: has to be a line"),
        ({"by": "x", "at": "jobs/six"}, "has to be a capture or a run"),
        ({"by": "x", "at": "captures/none"}, "captures/none"),
    ):
        answer = page.post("/api/jobs", json=request | {"begun": begun})
        assert answer.status_code in (400, 404) and line in answer.json()["error"], answer.text
    begun = {"by": "Train with a sky", "at": "captures/six"}

    def start(**more):
        answer = page.post("/api/jobs", json=request | more)
        assert answer.status_code == 200, answer.text
        return answer.json()

    def undo(job):
        return page.post(f"/api/jobs/{job['id']}/undo", json={"created": job["created"]})

    first = start(begun=begun)
    assert (first["begun_by"], first["begun_at"]) == ("Train with a sky", "captures/six")
    assert (
        JobFolder(studio.queue.folder / first["id"]).read(lambda work, purpose: Rendered(work, ())).begun_by
    )
    page.post(f"/api/jobs/{first['id']}/cancel")
    studio.rename("captures", "six", "seven")
    assert page.get(f"/api/jobs/{first['id']}").json()["begun_at"] == "captures/seven"
    request["subject"] = begun["at"] = "captures/seven"
    (root / "runs" / "six").mkdir(parents=True)  # as if it had begun
    assert [undo(first).json() for _ in range(2)] == [{"undone": True}] * 2
    assert [one["name"] for one in studio.library.trash()] == ["six"] and studio.queue.jobs() == []
    second = start(begun=begun)
    assert second["id"] != first["id"] and undo(first).json() == {"undone": True}
    # another start of the server may give an id again; a job of the same id is another one
    assert undo(second | {"created": first["created"]}).json() == {"undone": True}
    assert page.get(f"/api/jobs/{second['id']}").status_code == 200
    kept = page.post(f"/api/jobs/{second['id']}/keep").json()
    assert (kept["begun_by"], kept["begun_at"]) == ("", "")
    answer = undo(second)
    assert answer.status_code == 409 and "its result was kept" in answer.json()["error"]
    assert page.post(f"/api/jobs/{second['id']}/undo", json={}).status_code == 400


def test_a_photo_of_a_finding_is_left_out_and_taken_back(visitor, library, jumping):
    person = visitor()
    tab = go(person.tab, f"captures/{jumping}")
    capture = library[0].library.root / "captures" / jumping
    part = examined(tab)
    figure = part.locator(
        ".figures figure", has=tab.get_by_role("button", name=re.compile("^Leave out"))
    ).first
    photo = figure.locator("figcaption").inner_text().split(":")[0]
    gallery = tab.get_by_role("region", name="photos")
    figure.get_by_role("button", name=re.compile("^Leave out")).click()
    item = gallery.locator(".thumbs li.left-out")
    item.wait_for()
    assert photo in item.inner_text() and "1 left out" in gallery.locator("p.quiet").first.inner_text()
    assert len(load_dataset(capture).files) == 15
    part.get_by_text("This has changed since the doctor looked").wait_for()
    item.get_by_role("button", name=re.compile("^Use again")).click()
    item.wait_for(state="detached")
    assert len(load_dataset(capture).files) == 16 and not (capture / LEFT_OUT).exists()
    tab.reload()
    gallery.locator(".thumbs li").first.wait_for()
    assert not gallery.locator(".left-out").count()


def test_findings_that_are_shown_anew_keep_the_focus_and_what_was_unfolded(visitor, library, jumping):
    tab = go(visitor().tab, f"captures/{jumping}")
    part = examined(tab)
    part.locator("summary", has_text="Facts").click()
    leave = part.get_by_role("button", name=re.compile("^Leave out")).nth(1)
    photo = leave.get_attribute("aria-label").removeprefix("Leave out ")
    leave.focus()
    tab.keyboard.press("Enter")
    part.get_by_text("This has changed since the doctor looked").wait_for()
    until_in(tab, tab, f"document.activeElement.getAttribute('aria-label') === 'Use again {photo}'")
    assert part.locator("details table").is_visible()


def test_a_run_is_trained_again_without_a_photo_of_a_wrong_pose(visitor, library, swapped):
    person = visitor()
    capture = library[0].library.root / "captures" / "swapped"
    tab = go(person.tab, "runs/swapped/judge")
    part = examined(tab)
    part.locator("summary", has_text="Facts").click()
    facts = part.locator("details table").inner_text()
    assert "swapped: 200 iterations" in facts and str(library[0].library.root) not in facts
    again = part.get_by_role("button", name="Train again without what is left out")
    assert not again.is_visible()
    part.get_by_role("button", name="Leave out view_005.png").first.click()
    with waiting(library[0]):
        again.click()
        tab.wait_for_url(re.compile("#/runs/swapped-run"))
        job = library[0].queue.jobs()[-1]
    assert job.work.inputs == ("captures/swapped",) and read_left_out(capture) == ("images/view_005.png",)


def test_a_list_that_leaves_nothing_or_names_no_photo_is_refused(page, studio):
    capture = studio.library.root / "captures" / "jumps"
    views, points, colors = procedural_capture(32, 16, splats=50)
    write_colmap(capture, views, points, colors)
    names = [photo["name"] for photo in page.get("/api/captures/jumps/photos").json()["photos"]]
    for photos, status, line in (
        (names, 400, "none of its 16 photos would be left"),
        (["../../etc/passwd"], 404, "passwd"),
        ([3], 400, "has to be a list of photos"),
    ):
        answer = page.post("/api/captures/jumps/left-out", json={"photos": photos, "back": False})
        assert answer.status_code == status and line in answer.json()["error"], answer.text
    assert not (capture / LEFT_OUT).exists()
    assert page.post("/api/captures/jumps/left-out", json={"photos": names[:2], "back": False}).json() == {
        "left_out": names[:2]
    }
    (capture / LEFT_OUT).write_bytes(b"\xff")
    assert "not text in UTF-8" in page.get("/api/captures/jumps/photos").json()["error"]


def test_a_short_run_is_trained_longer_by_a_button(visitor, library, runs):
    person = visitor()
    part = examined(go(person.tab, "runs/egg/judge"))
    said = part.locator(".found").inner_text()
    assert "short training" in said and not COMMANDS.search(said), said
    with waiting(library[0]):
        part.get_by_role("button", name="Train longer").first.click()
        person.tab.wait_for_url(re.compile("#/runs/egg-run"))
        job = library[0].queue.jobs()[-1]
    assert job.work.inputs == ("captures/egg",) and job.work.options["iterations"] > 20


def test_pause_and_stop_name_no_files_and_no_options(visitor, runs):
    person = visitor()
    tab = go(person.tab, "captures/egg")
    tab.locator("summary", has_text="More").click()
    tab.get_by_label("Iterations instead of a quality").fill("100000")
    tab.get_by_role("button", name="Start training").click()
    card = tab.locator(".job")
    card.locator("[aria-current=step]", has_text="training").wait_for()
    card.locator(".left", has_text=re.compile(r"\bleft\b")).wait_for()
    card.get_by_role("button", name="Pause", exact=True).click()
    card.get_by_text("Paused. Resume continues it.").wait_for()
    card.get_by_role("button", name="Resume", exact=True).click()
    card.get_by_role("button", name="Pause", exact=True).wait_for()
    seen = [card.locator("p:visible").all_inner_texts()]
    card.get_by_role("button", name="Stop", exact=True).click()
    card.locator(".state", has_text="stopped").wait_for()
    seen.append([text for text in card.locator("p:visible").all_inner_texts() if "command" not in text])
    assert any(re.match("Stopped after [0-9,]+ iterations. It can be continued", text) for text in seen[1]), (
        seen
    )
    assert not any(COMMANDS.search(text) for texts in seen for text in texts), seen
