"""The parts of a page before its splats: scripts, style, shaders and workers of each kind of page, and their policy."""

from __future__ import annotations

import base64
import html as html_text
import json
import re
from collections.abc import Collection
from dataclasses import dataclass
from typing import Any

from gsplat_edu.base import constants
from gsplat_edu.base.content_policy import content_policy, policy_element
from gsplat_edu.base.icons import icons_of
from gsplat_edu.base.styles import sheet
from gsplat_edu.viewer.modules import script, web

SHADERS = ("splat.vert", "splat.frag", "screen.vert", "screen.frag", "mesh.vert", "mesh.frag")

SHADER_CONSTANTS = (
    "DILATION",
    "ALPHA_MIN",
    "ALPHA_MAX",
    "Z_NEAR",
    "COLOR_LIMIT",
    "DET_FLOOR",
    "SH_OFFSET",
    "C0",
    "C1",
    "C2",
    "C3",
)
"""Names in `gsplat_edu.base.constants` that the shaders use."""

FINITE = 3e38
"""Larger values count as infinite in a shader; float32 ends at 3.4e38."""


@dataclass(frozen=True)
class Kind:
    """The extra parts of one kind of page.

    Args:
        fact: Entry of the page's facts that only this kind has; empty for the plain page.
        entries: Its modules that others do not import, in the order in which they run; see `gsplat_edu.viewer.modules`.
        styles: Its style sheets, after the common one.
        workers: Its workers, in addition to the one that sorts.
        own_server: Whether it may load from its own server, and save there.
        define: Macro whose parts its shaders have; empty for none.
        shaders: Its shaders, in addition to those of every page.
    """

    fact: str = ""
    entries: tuple[str, ...] = ("main.js",)
    styles: tuple[str, ...] = ()
    workers: tuple[str, ...] = ()
    own_server: bool = False
    define: str = ""
    shaders: tuple[str, ...] = ()


PLAIN = Kind()
LEVELS = Kind("lod", ("levels_main.js",), workers=("lod_worker",), own_server=True)
LIVE = Kind("live", ("live_pictures.js", "live.js", "main.js"), ("live.css",), own_server=True)
PICTURED = Kind("pictures", ("live_pictures.js", "main.js"), own_server=True)
EDITOR = Kind(
    "edit",
    ("edit_start.js", "main.js"),
    ("edit.css",),
    own_server=True,
    define="EDITING",
    shaders=("edit_dots.vert", "edit_dots.frag", "edit_edge.vert", "edit_edge.frag"),
)


def policy(kind: Kind = PLAIN) -> str:
    """Return the Content-Security-Policy of every page of a kind: its scripts, its style, and its workers."""
    return content_policy([script(kind.entries)], [_style(kind)], workers=True, own_server=kind.own_server)


def filled(template: str, title: str, facts: dict[str, Any], poster: bytes = b"") -> str:
    """Fill in the part of a page before the splats.

    Args:
        template: Text with placeholders, {{name}}.
        title: Heading of the page.
        facts: The page's metadata, which also decides its kind.
        poster: A JPEG that is shown until the first picture is drawn; empty for none.
    """
    kind = next((kind for kind in (LEVELS, LIVE, EDITOR, PICTURED) if kind.fact in facts), PLAIN)
    workers = ("sort_worker", *kind.workers)
    defined = {kind.define, "SEEN" if "seen" in facts else ""}
    texts = {
        "title": html_text.escape(title),
        "policy": policy_element(policy(kind)),
        "style": _style(kind),
        "body": "glass" if kind is EDITOR else "visitor glass",
        "poster": _poster(poster),
        "icons": icons_of(template, script(kind.entries)),
        # "<" is escaped so that no text in the JSON can close its element
        "facts": json.dumps(facts, allow_nan=False, separators=(",", ":")).replace("<", "\\u003c"),
        "shaders": "\n".join(
            _text_element(name, _shader(name, defined)) for name in (*SHADERS, *kind.shaders)
        ),
        "worker": "\n".join(
            _text_element(name.replace("_", "-"), script((f"{name}.js",))) for name in workers
        ),
        "script": f"<script>{script(kind.entries)}</script>",
    }
    # One pass over the template only: placeholders inside inserted text stay unchanged.
    return re.sub(r"\{\{(\w+)\}\}", lambda found: texts[found[1]], template)


def _style(kind: Kind) -> str:
    return sheet("icon") + "".join(web(name) for name in ("style.css", "visitor.css", *kind.styles))


def _text_element(name: str, text: str) -> str:
    return f'<script type="text/plain" id="{name}">{text}</script>'


def _poster(jpeg: bytes) -> str:
    if not jpeg:
        return ""
    data = base64.b64encode(jpeg).decode()
    return f'<img id="poster" alt="the first view of the scene" src="data:image/jpeg;base64,{data}">'


def _shader(name: str, defined: Collection[str]) -> str:
    """Return one of our shaders, preceded by the renderer's constants, without the parts of macros not defined."""
    lines = ["#version 300 es", "precision highp float;", f"const float FINITE = {FINITE!r};"]
    for constant in SHADER_CONSTANTS:
        value = getattr(constants, constant)
        if isinstance(value, tuple):
            array = f"float[{len(value)}]"
            lines.append(f"const {array} {constant} = {array}({', '.join(map(repr, value))});")
        else:
            lines.append(f"const float {constant} = {value!r};")

    def part(found: re.Match[str]) -> str:
        return found[2] if found[1] in defined else ""

    text = re.sub(r"#ifdef (\w+)\n(.*?)#endif\n", part, web(f"{name}.glsl"), flags=re.DOTALL)
    return "\n".join([*lines, text])
