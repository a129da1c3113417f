"""Content-Security-Policy of the HTML files that this package writes: what a browser may run and load in them.

Nothing is loaded from a network, and no form or base address leads to one. Scripts and style sheets stand in the file
and run only if their SHA-256 is in the policy. The hashes are those of texts that the program itself wrote, not of
whatever the finished file holds: a script that reaches the file through a name or a caption is not among them. Inline
event handlers (`onclick="..."`) never run; attach listeners from a script.

Source: W3C, "Content Security Policy Level 3", sections 2.3.1 (hashes) and 6.7.3.3 ('unsafe-hashes').
"""

from __future__ import annotations

import base64
import hashlib
import html
from collections.abc import Iterable
from html.parser import HTMLParser


def content_policy(
    scripts: Iterable[str] = (), styles: Iterable[str] = (), markup: str = "", workers: bool = False
) -> str:
    """Return a policy that allows these scripts and styles, images inside the file, and nothing else.

    Args:
        scripts: Text of each `<script>` element, to the byte.
        styles: Text of each `<style>` element, to the byte.
        markup: HTML or SVG by the program itself, a figure for example, whose `<style>` elements and `style`
            attributes are allowed too.
        workers: Whether workers may be started from blobs of the page's own.
    """
    found = _Styles(markup)
    rules = {
        "default-src": ["'none'"],
        "script-src": _allowed(scripts),
        "style-src": _allowed([*styles, *found.elements], found.attributes),
        "img-src": ["data:", "blob:"],
        "connect-src": ["'none'"],
        "worker-src": ["blob:" if workers else "'none'"],
        "base-uri": ["'none'"],
        "form-action": ["'none'"],
    }
    return "; ".join(f"{name} {' '.join(sources)}" for name, sources in rules.items())


def policy_element(policy: str) -> str:
    """Return the `<meta>` element that states a policy; it has to precede every script and style."""
    return f'<meta http-equiv="Content-Security-Policy" content="{html.escape(policy)}">'


def _allowed(elements: Iterable[str], attributes: Iterable[str] = ()) -> list[str]:
    elements, attributes = _hashes(elements), _hashes(attributes)
    # without the keyword, hashes allow elements only
    return [*elements, *(["'unsafe-hashes'", *attributes] if attributes else [])] or ["'none'"]


def _hashes(texts: Iterable[str]) -> list[str]:
    digests = (hashlib.sha256(text.encode()).digest() for text in dict.fromkeys(texts))
    return [f"'sha256-{base64.b64encode(digest).decode()}'" for digest in digests]


class _Styles(HTMLParser):
    """The texts of `<style>` elements and of `style` attributes."""

    def __init__(self, markup: str) -> None:
        super().__init__()
        self.elements: list[str] = []
        self.attributes: list[str] = []
        self._inside = False
        self.feed(markup)
        self.close()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.attributes += [value for name, value in attrs if name == "style" and value]
        self._inside = tag == "style"
        if self._inside:
            self.elements.append("")

    def handle_endtag(self, tag: str) -> None:
        self._inside = False

    def handle_data(self, data: str) -> None:
        if self._inside:
            self.elements[-1] += data
