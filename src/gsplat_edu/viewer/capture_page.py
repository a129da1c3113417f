"""The page that shows a capture in 3D: points, the outlines of its cameras, and their photos.

The page asks its server for photos (`thumbs/PHOTO?side=N`, a JPEG), and tells it which photos to leave out
(`left-out`, a POST of {"photos": [name], "back": bool}) and where its region of interest is (`region`, a POST of
{"region": box}, or of {"region": null} for none). The addresses are relative to the page, so that it works on
the server of `gsplat-edu view` and in the studio.
"""

from __future__ import annotations

import base64
import gzip
import html as html_text
import json
import re

from gsplat_edu.base.content_policy import content_policy, policy_element
from gsplat_edu.base.icons import icons_of
from gsplat_edu.base.styles import sheet
from gsplat_edu.viewer.capture_data import CaptureFacts
from gsplat_edu.viewer.modules import script, web

ENTRIES = ("capture.js",)
"""See `gsplat_edu.viewer.page_parts.Kind`."""

STYLES = ("style.css", "capture.css")

SHADERS = ("capture_lines.vert", "capture_lines.frag", "capture_points.vert", "capture_points.frag")


def policy() -> str:
    """Return the Content-Security-Policy of the page."""
    return content_policy([script(ENTRIES)], [_style()], own_server=True)


def html(capture: CaptureFacts, findings: str = "") -> bytes:
    """Return the page's bytes.

    Args:
        capture: What it shows.
        findings: Relative URL at which its server tells what the doctor found; empty if the page does not ask.
    """
    facts = capture.facts | ({"findings": findings} if findings else {})
    texts = {
        "title": html_text.escape(str(facts["title"])),
        "policy": policy_element(policy()),
        "style": _style(),
        "icons": icons_of(web("capture.html"), script(ENTRIES)),
        # "<" is escaped so that no text in the JSON can close its element
        "facts": json.dumps(facts, allow_nan=False, separators=(",", ":")).replace("<", "\\u003c"),
        "shaders": "\n".join(
            f'<script type="text/plain" id="{name}">#version 300 es\nprecision highp float;\n{web(f"{name}.glsl")}'
            "</script>"
            for name in SHADERS
        ),
        "points": _packed("points", capture.points),
        "matches": _packed("matches", capture.matches),
        "script": f"<script>{script(ENTRIES)}</script>",
    }
    # One pass over the template only: placeholders inside inserted text stay unchanged.
    page = re.sub(r"\{\{(\w+)\}\}", lambda found: texts[found[1]], web("capture.html"))
    return page.encode("utf-8", errors="replace")


def _packed(name: str, data: bytes) -> str:
    """Return an element with compressed bytes; nothing if there are none."""
    if not data:
        return ""
    packed = base64.b64encode(gzip.compress(data, 6, mtime=0)).decode("ascii")
    return f'<script type="application/octet-stream;base64" class="{name}">{packed}</script>'


def _style() -> str:
    return sheet("icon") + "".join(web(name) for name in STYLES)
