"""The icons of every page, each once: `base/web/icons.svg` has a symbol for each, with the id icon-NAME.

A page shows one by `<svg class="icon" aria-hidden="true"><use href="#icon-NAME"/></svg>`, and the component `icon` of
the style sheets draws it. A page served with files names the file in `href`; a page that is one file contains the
symbols that it names.
"""

from __future__ import annotations

import functools
import re
from importlib.resources import files

SYMBOL = re.compile(r'^<symbol id="icon-([\w-]+)".*</symbol>$', re.MULTILINE)

NAMED = re.compile(r"#icon-([\w-]+)")
"""Where a page names an icon."""


@functools.cache
def icons() -> dict[str, str]:
    """Return the `<symbol>` element of each icon by its name."""
    text = (files("gsplat_edu.base") / "web" / "icons.svg").read_text("utf-8")
    return {found[1]: found[0] for found in SYMBOL.finditer(text)}


def icons_of(*texts: str) -> str:
    """Return an element that is not shown, with the icons that a page needs.

    Args:
        texts: The page's markup and scripts.

    Raises:
        KeyError: they name an icon that does not exist.
    """
    names = sorted({name for text in texts for name in NAMED.findall(text)})
    return f"<svg hidden>{''.join(icons()[name] for name in names)}</svg>"
