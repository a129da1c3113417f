"""The scripts of a page share one scope, in which a second function of a name silently replaces the first."""

import re
from collections import Counter

import pytest

from gsplat_edu.viewer import capture_page, page_parts

KINDS = {
    "plain": page_parts.PLAIN,
    "levels": page_parts.LEVELS,
    "live": page_parts.LIVE,
    "pictured": page_parts.PICTURED,
    "editor": page_parts.EDITOR,
}

DEFINED = re.compile(
    r"^(?:async )?(?:function\*?|class|const|let|var) (\w+|\[[^\]]*\]|\{[^}]*\})", re.MULTILINE
)


PAGES = {
    name: (*page_parts.SCRIPTS, *kind.scripts, page_parts.LAST_SCRIPT) for name, kind in KINDS.items()
} | {"capture": capture_page.SCRIPTS}


@pytest.mark.parametrize("name", PAGES)
def test_no_two_definitions_have_one_name(name):
    scripts = PAGES[name]
    defined = Counter(
        word
        for script in scripts
        for found in DEFINED.findall(page_parts.web(script))
        for word in re.findall(r"\w+", found)
    )
    assert defined["View"] == 1 and defined["CaptureView" if name == "capture" else "Viewer"] == 1
    assert [word for word, count in defined.items() if count > 1] == []
