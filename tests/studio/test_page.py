"""The studio's page in Chromium, used like a person does, from a capture or photos to a downloaded scene."""

import io
import re
import zipfile
from urllib.parse import quote, unquote

import pytest
from PIL import Image

from gsplat_edu.data.procedural import procedural_capture
from gsplat_edu.data.writers import write_colmap
from lab.captures.textured_box import box_orbit, photograph_box
from studio.pages import BY_DAY, DROP, encoded, go, png, repeated, train_and_download, visitor_of
from waiting import resize, until_in

HOSTILE = "<img src=x onerror=hacked=1>"


def check_that_screens_load_without_shifts(person, address):
    """The screens of a run, opened by their addresses, load without layout shifts."""
    tab = person.tab
    before = tab.viewport_size
    resize(tab, 1440, 900)
    for screen in ("judge", "judge?view=0", "share"):
        tab.goto("about:blank")
        tab.goto(f"{address}#/runs/box/{screen}")
        tab.locator(".tab h2").first.wait_for()
        tab.wait_for_load_state("networkidle")
        assert person.shift() < 0.02, screen  # a fifth of the bound of the Core Web Vitals
    resize(tab, before["width"], before["height"])


def check_that_run_and_capture_lead_to_each_other(person):
    person.tab.locator(".head").get_by_role("link", name="box", exact=True).click()
    person.reach("#/captures/box")
    runs = person.tab.get_by_role("region", name="runs")
    runs.get_by_role("link", name="box", exact=True).click()
    person.reach("#/runs/box")


def test_from_a_dropped_capture_to_a_downloaded_scene(visitor, library, tmp_path):
    """A reload and a second tab show the same screen, and the printed commands give the same bytes."""
    write_colmap(tmp_path / "box", *procedural_capture(24, 14))
    zipped = io.BytesIO()
    with zipfile.ZipFile(zipped, "w") as archive:
        for path in sorted((tmp_path / "box").rglob("*")):
            archive.write(path, path.relative_to(tmp_path))
    person = visitor()
    tab = person.tab
    assert "token" not in tab.url
    address = tab.url.split("#")[0]
    assert person.shift() < 0.1  # the library is empty
    assert "Drop photos" in tab.inner_text(".first")
    tab.evaluate(DROP, [[["box.zip", encoded(zipped.getvalue())]], ".drop"])
    person.reach("#/captures/box")  # the file names show that it has poses
    tab.locator(".thumbs img").nth(13).wait_for()
    tab.locator(".forecast", has_text="of memory").nth(2).wait_for()

    tab.locator("summary", has_text="More").click()
    tab.get_by_label("Iterations instead of a quality").fill("60")
    tab.get_by_label("Purpose").select_option("for a mesh: learn surfaces")
    tab.get_by_label("Depth to learn from").select_option("the points that photos share")
    tab.get_by_role("button", name="Start training").click()
    person.reach("#/runs/box")
    train = person.command("training of box")
    assert "--surface" in train and "--depth points" in train
    tab.get_by_role("link", name="Share it").wait_for()
    tab.locator(".figures-list dd", has_text="60 of 60").wait_for()
    tab.get_by_role("img", name=re.compile("^Loss: .*from")).wait_for()

    tab.keyboard.press("2")  # judge the result
    person.reach("#/runs/box/judge")
    tab.locator(".views li").first.locator("img").nth(2).wait_for()
    tab.locator(".views a").first.click()
    slider = tab.get_by_role("slider")
    slider.focus()
    tab.keyboard.press("ArrowRight")
    assert slider.get_attribute("aria-valuetext") == "photo 51 %, render 49 %"

    check_that_run_and_capture_lead_to_each_other(person)
    check_that_screens_load_without_shifts(person, address)

    tab.keyboard.press("4")  # share the scene
    person.reach("#/runs/box/share")
    tab.get_by_role("radio", name=re.compile("^SPZ")).check()
    tab.get_by_role("button", name="Export", exact=True).click()
    tab.locator(".exports .facts", has_text="your scene").wait_for()
    with tab.expect_download() as download:
        tab.get_by_role("link", name="Download").click()
    convert = person.command("export of box.spz")
    root = library[0].library.root
    assert repeated([train, convert], root, tmp_path / "again") == download.value.path().read_bytes()

    shown = tab.locator(".exports li").inner_text()
    tab.reload()
    tab.locator(".exports .facts", has_text="your scene").wait_for()
    second = visitor_of(person, tab.url)
    second.locator(".exports .facts", has_text="your scene").wait_for()
    assert tab.locator(".exports li").inner_text() == second.locator(".exports li").inner_text() == shown


def test_a_waiting_job_says_what_it_waits_for(visitor, library):
    studio, _ = library
    for name in ("captures/waiting", "runs/waiting"):
        (studio.library.root / name).mkdir()
    (studio.library.root / "runs" / "waiting" / "config.json").write_text('{"format": 1}')
    tab = visitor().tab
    jobs, studio.queue.at_once = [], 0
    requests = (
        {"command": "train", "subject": "captures/waiting", "to": "waiting", "resume": True},
        {"command": "convert", "subject": "runs/waiting", "format": "spz"},
        {"command": "doctor", "subject": "captures/waiting"},
    )
    try:
        jobs = [studio.start(request).id for request in requests]
        go(tab, "jobs")
        card = tab.get_by_role("article", name="export of waiting.spz")
        line = card.locator(".waits")
        line.get_by_text("Waits until “training of waiting” has ended: it uses runs/waiting too.").wait_for()
        assert not tab.get_by_role("article", name="doctor of waiting").locator(".waits").is_visible()
        studio.queue.cancel(jobs[0])
        line.wait_for(state="hidden")
    finally:
        for job in jobs:
            studio.queue.remove(job)
        studio.queue.at_once = 1


def test_hostile_names_are_text_and_refused_files_say_why(visitor):
    person = visitor()
    tab = person.tab
    files = [[f"{HOSTILE}.png", encoded(png(1))], [f"{HOSTILE}.txt", encoded(b"no photo")]]
    tab.evaluate(DROP, [files, ".drop"])
    error = tab.locator(".errors li")
    error.wait_for()
    assert error.inner_text().startswith(f"{HOSTILE}.txt: ")
    assert "neither a photo nor a video" in error.inner_text()
    card = tab.locator("a.card", has_text="1 photo")
    card.click()
    person.reach(f"#/photos/{quote(BY_DAY)}")
    tab.locator(".thumbs .name", has_text=HOSTILE).wait_for()
    tab.locator("summary", has_text="Rename or remove").click()
    tab.get_by_label("Name", exact=True).fill(HOSTILE)
    tab.get_by_role("button", name="Rename").click()
    tab.locator("h1", has_text=HOSTILE).wait_for()
    assert tab.title().startswith(HOSTILE)
    tab.reload()
    tab.locator("h1", has_text=HOSTILE).wait_for()
    tab.locator("summary", has_text="Rename or remove").click()
    tab.get_by_role("button", name="Move to the trash").click()
    person.reach("#/")
    tab.get_by_role("button", name="Undo", exact=True).click()
    tab.locator("h1", has_text=HOSTILE).wait_for()
    tab.locator("summary", has_text="Rename or remove").click()
    tab.get_by_role("button", name="Move to the trash").click()
    person.reach("#/")
    tab.get_by_role("link", name="Trash").click()
    tab.locator("main li", has_text=HOSTILE).wait_for()
    assert tab.evaluate("typeof hacked") == "undefined"
    assert tab.locator("img[src=x]").count() == 0


def test_from_dropped_photos_to_a_downloaded_scene(visitor, library, tmp_path):
    pytest.importorskip("pycolmap")
    files = []
    for index, camera in enumerate(box_orbit(14)):
        data = io.BytesIO()
        Image.fromarray(photograph_box(camera)).save(data, format="PNG")
        files.append([f"box_{index:02d}.png", encoded(data.getvalue())])
    person = visitor()
    tab = person.tab
    tab.evaluate(DROP, [files, ".drop"])
    tab.get_by_role("button", name="Place the photos").wait_for()
    tab.locator("summary", has_text="More").click()
    tab.get_by_label("the same poses to the bit every time").check()
    tab.get_by_role("button", name="Place the photos").click()
    place = person.place().removeprefix("#/photos/")
    sfm = person.command(f"cameras of {unquote(place)}")
    onward = tab.get_by_role("link", name=re.compile("^See where the photos were taken"))
    onward.wait_for(timeout=240_000)
    found = re.compile(r"14 of 14 photos placed")
    tab.locator(".next", has_text=found).wait_for()
    onward.click()
    until_in(tab, tab, "location.hash.startsWith('#/captures/')")
    name = unquote(re.fullmatch("#/captures/(.+)", person.place())[1])
    tab.locator("main h1", has_text=name).wait_for()
    tab.locator(".head .facts", has_text=found).wait_for()
    data, commands = train_and_download(person, name, 200)
    root = library[0].library.root
    assert repeated([sfm, *commands], root, tmp_path / "again") == data
    assert repeated(commands, root, tmp_path / "trained_again") == data
