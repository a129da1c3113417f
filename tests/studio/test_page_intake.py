"""In Chromium, a person drops and chooses videos and folders."""

import json
import re

import cv2
import pytest

from data.pose_programs import CAMERAS, write_opensfm
from lab.captures.textured_box import box_orbit, photograph_box
from studio.pages import DROP, encoded, png


def video_of(path, frames):
    """Write RGB pictures as mp4."""
    height, width = frames[0].shape[:2]
    video = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"mp4v"), 25, (width, height))
    for frame in frames:
        video.write(frame[..., ::-1])
    video.release()
    return path


def drop_paths(tab, place, *paths):
    """Drop files or folders of the disk like a file manager; the browser makes their entries."""
    box = tab.locator(place).bounding_box()
    at = {"x": box["x"] + box["width"] / 2, "y": box["y"] + box["height"] / 2}
    session = tab.context.new_cdp_session(tab)
    data = {"items": [], "files": [str(path) for path in paths], "dragOperationsMask": 1}
    for kind in ("dragEnter", "dragOver", "drop"):
        session.send("Input.dispatchDragEvent", {"type": kind, "data": data, **at})


@pytest.fixture
def folder(tmp_path):
    """A folder with photos in folders, and with files that operating systems add."""
    for number, path in enumerate(("left/a.png", "left/b.png", "right/deep/c.png")):
        place = tmp_path / "walk round" / path
        place.parent.mkdir(parents=True, exist_ok=True)
        place.write_bytes(png(number))
    (tmp_path / "walk round" / ".DS_Store").write_bytes(b"x")
    return tmp_path / "walk round"


def test_a_dropped_folder_becomes_an_entry_with_its_folders(visitor, library, folder):
    person = visitor()
    drop_paths(person.tab, "header", folder)
    person.reach("#/photos/walk%20round")
    person.tab.locator(".thumbs img").nth(2).wait_for()
    stored = library[0].library.root / "photos" / "walk round"
    taken = {str(path.relative_to(stored)): path.read_bytes() for path in stored.rglob("*") if path.is_file()}
    assert taken == {
        name: (folder / name).read_bytes() for name in ("left/a.png", "left/b.png", "right/deep/c.png")
    }


def test_a_chosen_folder_becomes_the_same_entry(visitor, library, folder):
    person = visitor()
    again = folder.rename(folder.with_name("chosen"))
    person.tab.locator("input[type=file][webkitdirectory]").set_input_files(again)
    person.reach("#/photos/chosen")
    stored = library[0].library.root / "photos" / "chosen"
    assert sorted(path.name for path in stored.rglob("*.png")) == ["a.png", "b.png", "c.png"]


def test_a_dropped_video_becomes_an_entry_of_its_name(visitor, library, tmp_path):
    path = video_of(tmp_path / "a walk.mp4", [photograph_box(camera) for camera in box_orbit(3, 0.2)])
    person = visitor()
    drop_paths(person.tab, "header", path)
    person.reach("#/photos/a%20walk")
    person.tab.locator(".facts", has_text="1 video").wait_for()
    assert (library[0].library.root / "photos" / "a walk" / "a walk.mp4").read_bytes() == path.read_bytes()
    person.tab.locator("summary", has_text="More").click()
    assert person.tab.get_by_label("Frames of the video").is_visible()


class SearchUnread:
    """Answers a tab's questions for the library as if no search for poses had been read yet, until `ended` is true.

    The route stays: removing it would answer a question that it has already sent on.
    """

    def __init__(self, tab):
        self.ended = False
        tab.route("**/api/library", self._answer)

    def _answer(self, route):
        if self.ended:
            route.fallback()
            return
        answer = route.fetch()
        known = json.loads(
            answer.text(), object_hook=lambda entry: entry | dict.fromkeys({"search"} & entry.keys())
        )
        route.fulfill(response=answer, json=known)


def test_a_dropped_video_becomes_a_capture(visitor, library, tmp_path):
    pytest.importorskip("pycolmap")
    frames = [photograph_box(camera) for camera in box_orbit(90, 4.5)]
    path = video_of(tmp_path / "orbit.mp4", frames)
    person = visitor()
    tab = person.tab
    tab.evaluate(DROP, [[["orbit.mp4", encoded(path.read_bytes())]], ".drop"])
    person.reach("#/photos/orbit")
    tab.locator("summary", has_text="More").click()
    tab.get_by_label("Frames of the video").fill("30")
    unread = SearchUnread(tab)
    tab.get_by_role("button", name="Place the photos").click()
    onward = tab.get_by_role("link", name=re.compile("^See where the photos were taken"))
    onward.wait_for(timeout=240_000)
    first = onward.element_handle()
    unread.ended = True
    library[0].stream.library_changed()
    tab.get_by_text("30 of 30 photos placed").first.wait_for()
    assert first.evaluate("link => link.isConnected"), "a press while the words come would be lost"
    onward.click()
    person.reach("#/captures/orbit")
    tab.locator(".facts", has_text="30 of 30 photos placed").wait_for()
    tab.locator(".thumbs img").nth(20).wait_for()  # most of the 30 frames get a pose


def test_a_dropped_folder_with_poses_of_another_program_becomes_a_capture(visitor, library, tmp_path):
    write_opensfm(tmp_path / "yard")
    (tmp_path / "yard" / "images" / CAMERAS[0][0]).unlink()
    person = visitor()
    drop_paths(person.tab, "header", tmp_path / "yard")
    person.reach("#/captures/yard")
    person.tab.get_by_text("Poses of OpenSfM: 5 of 5 photos").wait_for()
    assert (library[0].library.root / "captures" / "yard" / "reconstruction.json").is_file()
