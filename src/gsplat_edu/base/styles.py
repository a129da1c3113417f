"""The look of every page: tokens (colours, sizes, motion) and the components that are made from them.

`base/web/tokens.css` names every colour and size once, for a light and a dark page and for a dark glass over a scene.
`base/web/components.css` has one section for each component, which begins with a line `/* == NAME */`. A page served
with files links both; a page that is one file takes the sections that it uses.
"""

from __future__ import annotations

import functools
import re
from importlib.resources import files

SECTION = re.compile(r"^/\* == ([\w-]+) \*/\n", re.MULTILINE)
"""The line before a component."""


DARK = re.compile(r"^:root, \.glass \{(.*?)\}", re.MULTILINE | re.DOTALL)

LIGHT = re.compile(r"prefers-color-scheme: light\) \{\s*:root \{(.*?)\}", re.DOTALL)
"""The colours of the two themes."""


def tokens() -> str:
    """Return the style sheet that defines the tokens, custom properties of CSS."""
    return _text("tokens.css")


def tokens_by_theme() -> str:
    """Return the tokens for a page whose readers may choose a theme: `data-theme` of its body is dark or light."""
    text = tokens()
    (dark,), (light,) = DARK.findall(text), LIGHT.findall(text)
    chosen = [
        f'body[data-theme="{theme}"] {{ color-scheme: {theme};{values}}}\n'
        for theme, values in (("dark", dark), ("light", light))
    ]
    return text + "".join(chosen)


@functools.cache
def components() -> dict[str, str]:
    """Return the style sheet of each component by its name, in the order in which they follow one another."""
    _, *parts = SECTION.split(_text("components.css"))
    return dict(zip(parts[::2], parts[1::2], strict=True))


def sheet(*names: str) -> str:
    """Return the tokens and some components as the text of a `<style>` element.

    Args:
        names: Names of components.

    Raises:
        KeyError: there is no such component.
    """
    known = components()
    chosen = {name: known[name] for name in names}
    return tokens() + "".join(
        chosen[name] for name in known if name in chosen
    )  # later ones may add to earlier ones


def _text(name: str) -> str:
    return (files("gsplat_edu.base") / "web" / name).read_text("utf-8")
