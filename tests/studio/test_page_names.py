"""Tabs that know the library at different times, in Chromium: names come from the server, and changes by the stream."""

import json
from urllib.parse import quote

from gsplat_edu.data.procedural import procedural_capture
from gsplat_edu.data.writers import write_colmap
from studio.pages import BY_DAY, DROP, encoded, go, png, visitor_of
from waiting import until_in


def drop(tab, count, seed=0):
    files = [[f"{seed}_{index}.png", encoded(png(10 * seed + index))] for index in range(count)]
    tab.evaluate(DROP, [files, ".drop"])


def in_folder(folder):
    return sorted(path.name for path in folder.iterdir())


def test_a_stale_tab_makes_a_set_of_its_own(visitor, library):
    """A tab that has not heard of another one's photos takes the next name, and shows what it made."""
    studio, _ = library
    first = visitor()
    stale = visitor_of(first, first.tab.url)
    stale.wait_for_selector("footer p:not(:empty)")
    stale.route("**/api/library", lambda route: route.abort())  # it learns nothing more of the library
    drop(first.tab, 2, seed=1)
    first.reach(f"#/photos/{quote(BY_DAY)}")
    drop(stale, 3, seed=2)
    until_in(stale, stale, "location.hash.startsWith('#/photos/')")
    stale.locator(".thumbs img").nth(2).wait_for()
    name = stale.evaluate("decodeURIComponent(location.hash.slice(9))")
    assert name == f"{BY_DAY} (2)" and "is not in this library" not in stale.inner_text("main")
    root = studio.library.root / "photos"
    assert in_folder(root / BY_DAY) == ["1_0.png", "1_1.png"]
    assert in_folder(root / name) == ["2_0.png", "2_1.png", "2_2.png"]


def test_a_tab_learns_of_the_library_by_the_stream(visitor):
    """What one tab adds, renames and removes, the other shows without a reload, a focus or a job."""
    person = visitor()
    other = visitor_of(person, person.tab.url)
    other.wait_for_selector("footer p:not(:empty)")
    other.evaluate("addEventListener('focus', (event) => event.stopImmediatePropagation(), true)")
    drop(person.tab, 1, seed=3)
    until_in(person.tab, person.tab, "location.hash.startsWith('#/photos/')")
    name = person.tab.evaluate("decodeURIComponent(location.hash.slice(9))")
    other.locator("a.card", has_text=name).wait_for()
    person.tab.locator("summary", has_text="Rename or remove").click()
    person.tab.get_by_label("Name", exact=True).fill("told by the stream")
    person.tab.get_by_role("button", name="Rename").click()
    other.locator("a.card", has_text="told by the stream").wait_for()
    go(other, "photos/told by the stream")
    other.locator(".thumbs img").first.wait_for()
    person.tab.locator("h1", has_text="told by the stream").wait_for()
    person.tab.locator("summary", has_text="Rename or remove").click()
    person.tab.get_by_role("button", name="Move to the trash").click()
    other.get_by_text("is not in this library any more").wait_for()


def test_what_came_from_a_capture_is_renamed_with_it(visitor, library):
    root = library[0].library.root
    write_colmap(root / "captures" / "toad", *procedural_capture(32, 6, splats=50))
    for name in ("toad", "toad-run-2", "other"):
        (root / "runs" / name).mkdir(parents=True)
        config = {"data": {"path": str(root / "captures" / "toad")}, "train": {"iterations": 10}}
        (root / "runs" / name / "config.json").write_text(json.dumps({"format": 1, **config}))
    person = visitor()
    tab = person.tab
    go(tab, "captures/toad")
    tab.locator("summary", has_text="Rename or remove").click()
    too = tab.get_by_role(
        "checkbox", name="rename what came from it, too: training toad, training toad-run-2"
    )
    too.wait_for()
    assert too.is_checked()
    tab.get_by_label("Name", exact=True).fill("frog")
    tab.get_by_role("button", name="Rename").click()
    person.reach("#/captures/frog")
    listed = tab.get_by_role("region", name="runs")
    listed.get_by_role("link").nth(2).wait_for()
    assert sorted(listed.get_by_role("link").all_inner_texts()) == ["frog", "frog-run-2", "other"]
    go(tab, "runs/other")
    tab.get_by_role("link", name="frog", exact=True).wait_for()
