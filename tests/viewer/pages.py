"""The viewer's pages in a tab: what a person does there and sees there. A redesign of a page changes its class here."""

import base64
from contextlib import contextmanager

import numpy as np

from gsplat_edu.edits.document import parse_edits
from gsplat_edu.scene.camera import Camera
from viewer.handles import until

PIXELS = """async (camera) => {
  const { pixels } = await viewer.setCamera(camera);
  const bytes = new Uint8Array(pixels.buffer);
  let text = "";
  for (let i = 0; i < bytes.length; i += 8192) text += String.fromCharCode(...bytes.subarray(i, i + 8192));
  return btoa(text);
}"""

READING = "GPU stall due to ReadPixels"
"""Message that Chromium's driver sometimes logs if a test reads the page's pixels. A page that watches a training
must not cause it, so `test_live_browser.py` does not ignore it."""

RESTS = "Boolean(window.viewer?.isWhole && !viewer.frameAsked && !viewer.catching && !viewer.timing)"
"""Whether a page draws nothing more by itself."""


@contextmanager
def running(server):
    """Let a server of pages answer from a thread of this process."""
    server.start(server.application())
    try:
        yield server
    finally:
        server.stop()


def described(camera):
    """Return the camera in the form that the page expects."""
    numbers = {name: getattr(camera, name) for name in ("fx", "fy", "cx", "cy", "H", "W")}
    return {"R": camera.R.tolist(), "eye": camera.eye.tolist(), **numbers}


def picture_of(tab, camera):
    """Return the picture that the page in a tab draws from this camera, (H, W, 3) float32."""
    encoded = tab.evaluate(PIXELS, described(camera))
    return np.frombuffer(base64.b64decode(encoded), "<f4").reshape(camera.H, camera.W, 3)


class Visit:
    """An open page. It records the console messages, errors and requests.

    Args:
        tab: The tab.
        site: The beginning of the addresses that the page may ask.
    """

    expected = READING
    """A part of further console messages that are no complaints."""

    def __init__(self, tab, site="file:"):
        self.tab, self.site = tab, site
        self.complaints = []
        self.requests = []
        self._heard = {
            "console": lambda message: self.complaints.append(f"{message.type}: {message.text}"),
            "pageerror": lambda error: self.complaints.append(str(error)),
            "request": lambda request: self.requests.append(request.url),
        }
        for event, note in self._heard.items():
            tab.on(event, note)

    def leave(self):
        """Empty the tab for the next visit."""
        for event, note in self._heard.items():
            self.tab.remove_listener(event, note)
        self.tab.goto("about:blank")

    def check(self):
        """Check that nothing was complained of, and no other address asked."""
        complaints = [text for text in self.complaints if READING not in text and self.expected not in text]
        elsewhere = [url for url in self.requests if not url.startswith((self.site, "blob:", "data:"))]
        assert (complaints, elsewhere) == ([], [])

    def open(self, path):
        self.tab.goto(path.as_uri())
        return self

    def ready(self):
        """Wait until the page shows its whole picture, which a slow computer draws in parts, and rests."""
        self.tab.wait_for_selector("#message", state="hidden")
        until(self.tab, RESTS)
        return self

    def message(self, text):
        """Wait until the page shows this message."""
        self.tab.wait_for_selector(f'#message:has-text("{text}")')

    def evaluate(self, expression, argument=None):
        """Return the value of an expression, or of a function of the argument."""
        return self.tab.evaluate(expression, argument)

    def press(self, *keys):
        """Press keys after each other."""
        for key in keys:
            self.tab.keyboard.press(key)

    def open_controls(self):
        """Open the sheet with numbers and controls, which a visitor's page keeps closed."""
        self.tab.click("#fold")
        return self

    def camera(self):
        """Return the camera of the current view."""
        found = self.evaluate("viewer.camera()")
        names = ("R", "eye", "fx", "fy", "cx", "cy", "H", "W")
        return Camera(**{name: found[name] for name in names})

    def picture(self, camera):
        """Return the page's picture from this camera, (H, W, 3) float32."""
        return picture_of(self.tab, camera)


class Editor(Visit):
    """An open page with the editor. Its buttons are named by what they do, because some have the same text."""

    def ready(self):
        self.tab.wait_for_selector("#edit")
        until(self.tab, "window.editor")
        return super().ready()

    def choose(self, tool):
        """Press the button of a tool."""
        self.tab.click(f"[data-tool={tool}]")

    def do(self, action):
        """Press the button of an action."""
        self.tab.click(f"[data-do={action}]")

    def is_chosen(self, tool):
        return self.tab.get_attribute(f"[data-tool={tool}]", "aria-pressed") == "true"

    def is_on(self, action):
        return self.tab.get_attribute(f"[data-do={action}]", "aria-pressed") == "true"

    def perform(self, *operations):
        """Perform operations as if their buttons had been pressed."""
        self.evaluate("(operations) => operations.forEach((one) => editor.perform(one))", operations)

    def select_all(self):
        self.perform({"op": "select", "how": "replace", "by": "all"})

    def operations(self):
        """Return the operations that were done and not undone."""
        return self.evaluate("editor.history.done")

    def last(self):
        return self.operations()[-1]

    def text(self):
        """Return the file of edits that the page would save."""
        return self.evaluate("editor.text()")

    def edits(self):
        """Return the edits as Python reads them."""
        return parse_edits(self.text().encode(), "edits.json")

    def flags(self):
        """Return the states of the splats."""
        return np.array(self.evaluate("[...editor.history.flags]"), dtype=np.uint8)

    def selected(self):
        """Return the number of selected splats that the page tells."""
        return int(self.tab.inner_text("#edit-count").split()[0].replace(",", ""))

    def place(self, x, y, z=0.0):
        """Return the CSS pixel at which the page shows a point."""
        return self.evaluate(
            """(p) => { const c = viewer.camera(), { u, v } = seenAt(c, p), box = viewer.canvas.getBoundingClientRect();
            return [box.left + (u + 0.5) * box.width / c.W, box.top + (v + 0.5) * box.height / c.H]; }""",
            [x, y, z],
        )
