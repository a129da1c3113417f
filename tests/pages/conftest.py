"""The page of all components, put together from the style sheets that the package ships."""

from pathlib import Path

import pytest

from gsplat_edu.base.icons import icons, icons_of
from gsplat_edu.base.styles import components, sheet

LONG = (
    "Bürgerhaus, Nordseite mit Treppenturm und Kelterhaus (vor der Renovierung), aufgenommen an drei Abenden"
)
"""A name as people give them."""

WORD = "IMG_20261128_" + 12 * "Donaudampfschifffahrtsgesellschaft" + ".jpeg"
"""A name without a place to break."""


@pytest.fixture(scope="session")
def gallery(tmp_path_factory):
    """Address of the page."""
    text = Path(__file__).with_name("components.html").read_text("utf-8")
    frame = '<li><button aria-label="photo {0}"{1}><img alt="" width="96" height="72"></button></li>'
    frames = "".join(frame.format(i, ' aria-current="true"' if i == 2 else "") for i in range(30))
    shown = '<li><svg class="icon" aria-hidden="true"><use href="#icon-{0}"/></svg>{0}</li>'
    listed = "".join(shown.format(name) for name in icons())
    for name, value in {
        "list": listed,
        "icons": icons_of(text, listed),
        "style": sheet(*components()),
        "frames": frames,
        "long": LONG,
        "word": WORD,
    }.items():
        text = text.replace("{{" + name + "}}", value)
    path = tmp_path_factory.mktemp("pages") / "components.html"
    path.write_text(text, "utf-8")
    return path.as_uri()
