"""A studio that runs jobs, with its page open in a browser."""

import base64
import contextlib
import io
import re
import shlex
from pathlib import Path
from urllib.parse import unquote

import numpy as np
from PIL import Image

from gsplat_edu.server.serving import Server
from gsplat_edu.studio.app import application
from gsplat_edu.studio.state import Studio
from processes import Program
from waiting import awaited, until_in

COMMAND = "import sys; from gsplat_edu.cli.main import main; sys.exit(main(sys.argv[1:]))"
"""The command line as a program."""

SHIFTS = """
window.shifted = 0;
new PerformanceObserver((list) => {
  for (const { value, hadRecentInput } of list.getEntries()) if (!hadRecentInput) shifted += value;
}).observe({ type: "layout-shift", buffered: true });
"""
"""Script that adds up the layout shifts of a page without a preceding input."""

OUTPUTS = {"sfm": 2, "convert": 2, "train": 3}
"""Index of the word of a printed command that names its output."""

DROP = """([files, place]) => {
  const transfer = new DataTransfer();
  for (const [name, text] of files) {
    const bytes = Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
    transfer.items.add(new File([bytes], name, { lastModified: Date.UTC(2026, 4, 14, 12) }));
  }
  for (const type of ["dragenter", "dragover", "drop"]) {
    const options = { dataTransfer: transfer, bubbles: true, cancelable: true };
    document.querySelector(place).dispatchEvent(new DragEvent(type, options));
  }
}"""
"""Script that drops files, a list of [name, base64] of one day, on the element of a selector."""

BY_DAY = "Photos of 14 May 2026"
"""Name of an entry of photos that `DROP` has dropped without a folder."""


@contextlib.contextmanager
def served(folder, worker, limits=None):
    """Serve a library from a thread of this process; yields the studio and the URL with its token.

    Args:
        folder: The library's folder.
        worker: Does what needs torch.
        limits: How much may be taken in.
    """
    studio = Studio(folder, limits=limits)
    studio.worker.close()
    studio.worker = studio.painter.worker = worker
    with Server(token=True) as server:
        app = application(studio, server.token, cookie=server.cookie)
        server.start(app, studio.stream.close)
        try:
            yield studio, server.url
        finally:
            server.stop()
            studio.close()


class Visitor:
    """Uses the page in a tab like a person, and collects script errors and violations of the page's policy."""

    def __init__(self, context, url):
        self.tab = context.new_page()
        self.faults = []
        self.tab.on("pageerror", lambda error: self.faults.append(str(error)))
        self.tab.on("console", self._said)
        self.tab.on("dialog", lambda dialog: self.faults.append(dialog.message))
        self.tab.add_init_script(SHIFTS)
        self.tab.goto(url)
        self.tab.wait_for_selector("footer p:not(:empty)")

    def _said(self, message):
        if "Content Security Policy" in message.text:
            self.faults.append(message.text)

    def place(self):
        """The part of the address that names the screen."""
        return self.tab.evaluate("location.hash")

    def reach(self, place):
        """Wait until the page shows a screen; its address may have escaped characters."""
        awaited(self.tab, lambda: unquote(self.place()) == unquote(place), place)

    def shift(self):
        """Cumulative layout shift since the page was loaded."""
        return self.tab.evaluate("shifted")

    def command(self, job):
        """Return the printed command of a job's card, by the job's title."""
        card = self.tab.get_by_role("article", name=job)
        card.locator("details").evaluate("(one) => (one.open = true)")
        return card.get_by_role("textbox", name="command").inner_text()


def go(tab, place):
    """Open a screen of the page in a tab; return the tab."""
    tab.goto(f"{tab.url.split('#')[0]}#/{place}")
    return tab


def frame_of(tab):
    """Return the frame with the scene of a screen, once it has started."""
    frame = tab.wait_for_selector(".scene iframe:not([hidden])").content_frame()
    until_in(tab, frame, "Boolean(window.viewer) && document.getElementById('message').hidden")
    return frame


def capture_frame(tab, capture):
    """Scroll to the cameras of a capture's screen; return the frame with them, once it has started."""
    section = tab.get_by_role("region", name="cameras")
    section.scroll_into_view_if_needed()
    frame = section.locator("iframe:not([hidden])").element_handle().content_frame()
    frame.wait_for_url(re.compile(f"/captures/{capture}/page"), wait_until="commit")
    until_in(tab, frame, "Boolean(window.viewer?.isWhole) && document.getElementById('message').hidden")
    return frame


def examined(tab):
    """Ask the doctor on a screen; return the section with its findings."""
    part = tab.get_by_role("region", name="doctor")
    # "Examine again" would show older findings meanwhile
    part.get_by_role("button", name="Examine", exact=True).click()
    part.get_by_role("button", name="Examine again").wait_for()
    part.locator(".findings li").first.wait_for()
    return part


def mask_dialog(tab, photo):
    """Press *Mask this* of a photo in the gallery; return the dialog and the box of the photo in it."""
    gallery = tab.get_by_role("region", name="photos")
    gallery.get_by_role("button", name=re.compile(f"[Mm]ask.*: .*{photo}")).click()
    dialog = tab.locator("dialog.mask[open]")
    dialog.wait_for()
    until_in(tab, tab, "document.activeElement === document.querySelector('dialog.mask svg')")
    until_in(tab, tab, "document.querySelector('.painted img').complete")
    return dialog, dialog.locator("svg").bounding_box()


def held_back(tab, address, of=lambda request: True):
    """Hold the answers to a tab's requests back; returns the list of (route, answer) that they join.

    Args:
        tab: The tab.
        address: Pattern of the addresses.
        of: Whether the answer to a request is held back.
    """
    held = []

    def hold(route):
        if of(route.request):
            held.append((route, route.fetch()))
        else:
            route.continue_()

    tab.route(address, hold)
    return held


@contextlib.contextmanager
def waiting(studio):
    """Let the jobs that are started inside wait, so that none has ended before it is looked at; then forget them."""
    before = {job.id for job in studio.queue.jobs()}
    studio.queue.at_once = 0
    try:
        yield
    finally:
        for job in studio.queue.jobs():
            if job.id not in before:
                studio.queue.remove(job.id)
        studio.queue.at_once = 1


def encoded(data):
    return base64.b64encode(data).decode()


def png(seed, size=(24, 18)):
    data = io.BytesIO()
    pixels = np.random.default_rng(seed).integers(0, 255, (size[1], size[0], 3), dtype=np.uint8)
    Image.fromarray(pixels).save(data, format="PNG")
    return data.getvalue()


def train_and_download(person, name, iterations):
    """Click from a capture's screen to a downloaded .spz; return its bytes and the commands that were shown."""
    tab = person.tab
    tab.locator("summary", has_text="More").click()
    tab.get_by_label("Iterations instead of a quality").fill(str(iterations))
    tab.get_by_role("button", name="Start training").click()
    person.reach(f"#/runs/{name}")
    commands = [person.command(f"training of {name}")]
    tab.get_by_role("link", name="Share it").click()
    person.reach(f"#/runs/{name}/share")
    tab.get_by_role("radio", name=re.compile("^SPZ")).check()
    tab.get_by_role("button", name="Export", exact=True).click()
    tab.locator(".exports .facts", has_text="your scene").wait_for()
    with tab.expect_download() as download:
        tab.get_by_role("link", name="Download").click()
    assert download.value.suggested_filename == f"{name}.spz"
    commands.append(person.command(f"export of {name}.spz"))
    return download.value.path().read_bytes(), commands


def repeated(commands, library, folder):
    """Run printed commands with outputs below a folder instead of the library; return the bytes of the .spz."""
    (folder / "runs").mkdir(parents=True)
    made = []
    for command in commands:
        program, *words = shlex.split(command)
        assert program == "gsplat-edu"
        made.append(Path(words[OUTPUTS[words[0]]]))
        words = [
            str(folder / Path(word).relative_to(library))
            if any(map(Path(word).is_relative_to, made))
            else word
            for word in words
        ]
        assert Program(COMMAND, words, folder).ended()[0] == 0
    return next(folder.rglob("*.spz")).read_bytes()


def visitor_of(person, url):
    """Open another tab with the same cookies and storage."""
    tab = person.tab.context.new_page()
    tab.goto(url)
    return tab
