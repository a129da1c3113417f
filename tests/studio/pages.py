"""A studio with real jobs whose page is open in a real browser."""

import contextlib
import socket
import threading
import time

from gsplat_edu.studio.app import application
from gsplat_edu.studio.server import _config, _Server
from gsplat_edu.studio.state import Studio

TOKEN = "a-token"

DROP = """([files, place]) => {
  const transfer = new DataTransfer();
  for (const [name, text] of files) {
    const bytes = Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
    transfer.items.add(new File([bytes], name));
  }
  for (const type of ["dragenter", "dragover", "drop"]) {
    const options = { dataTransfer: transfer, bubbles: true, cancelable: true };
    document.querySelector(place).dispatchEvent(new DragEvent(type, options));
  }
}"""
"""Drops files on an element of the page: a list of [name, base64], and a selector."""


@contextlib.contextmanager
def served(folder, worker):
    """Serve a library from a thread of this process; yields the studio and the URL with its token.

    Args:
        folder: The library's folder.
        worker: Does what needs torch.
    """
    studio = Studio(folder)
    studio.worker.close()
    studio.worker = worker
    with socket.create_server(("127.0.0.1", 0)) as sock:
        port = sock.getsockname()[1]
        ready = threading.Event()
        app = application(studio, TOKEN, cookie=f"studio_{port}")
        server = _Server(_config(app), ready.set, studio.stream.close)
        thread = threading.Thread(target=server.run, kwargs={"sockets": [sock]})
        thread.start()
        assert ready.wait(10)
        try:
            yield studio, f"http://127.0.0.1:{port}/?token={TOKEN}"
        finally:
            server.should_exit = True
            thread.join(20)
            studio.close()


class Visitor:
    """A person at the page, in one tab. Errors of scripts and violations of the page's policy are collected."""

    def __init__(self, context, url):
        self.tab = context.new_page()
        self.faults = []
        self.tab.on("pageerror", lambda error: self.faults.append(str(error)))
        self.tab.on("console", self._said)
        self.tab.on("dialog", lambda dialog: self.faults.append(dialog.message))
        self.tab.goto(url)
        self.tab.wait_for_selector("footer p:not(:empty)")

    def _said(self, message):
        if "Content Security Policy" in message.text:
            self.faults.append(message.text)

    def place(self):
        """The part of the address that names the screen."""
        return self.tab.evaluate("location.hash")

    def reach(self, place, patience=60):
        """Wait until the page is somewhere."""
        end = time.monotonic() + patience
        while self.place() != place:
            assert time.monotonic() < end, (self.place(), self.tab.inner_text("main"))
            self.tab.wait_for_timeout(30)

    def command(self, job):
        """The printed command of a job's card, by the job's title."""
        return self.tab.get_by_role("article", name=job).get_by_role("textbox", name="command").inner_text()
