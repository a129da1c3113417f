"""Names that a browser may give to entries of the library and to files in them.

Names may have letters of any script, in Unicode's composed form, and characters such as <, which a correct page
escapes. A name is refused if it could lead out of a folder, hide a file, look like a command's option or break a line.
"""

from __future__ import annotations

import unicodedata
from pathlib import Path

from gsplat_edu.base.links import is_inside
from gsplat_edu.base.text import as_file_name, printable
from gsplat_edu.server.refusal import RefusedError

LONGEST = 120
"""Bytes of the name of an entry in UTF-8; file systems have 255, and some names get an ending."""

LONGEST_WISH = 100
"""Bytes of a name that is made after a file; a number may be appended."""

LONGEST_FILE = 200
"""Bytes of the name of a file in UTF-8."""

DEEPEST = 8
"""Largest depth of folders in an entry."""

RESERVED = frozenset('/\\:*?"|')
"""Characters with a meaning to some file system."""


def checked_name(what: str, name: object, longest: int = LONGEST) -> str:
    """Check the name of an entry or a file, and return it in Unicode's composed form.

    Args:
        what: The thing that is named, for messages.
        name: The name.
        longest: Most bytes in UTF-8.

    Raises:
        RefusedError: it is not a name; says why.
    """
    if not isinstance(name, str) or not name.strip():
        raise RefusedError(f"{what}: has no name; give one")
    name = unicodedata.normalize("NFC", name)
    said = printable(name)[:60]
    try:
        size = len(name.encode("utf-8"))
    except UnicodeEncodeError:
        raise RefusedError(f"{what}: the name {said!r} is not Unicode; rename it") from None
    if size > longest:
        raise RefusedError(
            f"{what}: the name {said!r}... has {size} bytes, but may have {longest}; shorten it"
        )
    if printable(name) != name:
        raise RefusedError(f"{what}: the name {said!r} contains control characters; rename it")
    if bad := sorted(RESERVED.intersection(name)):
        raise RefusedError(f"{what}: the name {said!r} contains {' '.join(bad)}; rename it")
    if name[0] in ".-" or name[-1] in ". " or name[0] == " ":
        raise RefusedError(
            f"{what}: the name {said!r} begins with a dot, a dash or a space, or ends with one; rename it"
        )
    return as_file_name(name)


def name_after(wish: str, otherwise: str) -> str:
    """Return a name that is allowed, like that of a file or folder.

    Args:
        wish: The name of the file or folder.
        otherwise: Returned if nothing of it can be kept.
    """
    text = unicodedata.normalize("NFC", printable(as_file_name(wish)))
    text = "".join("_" if letter in RESERVED else letter for letter in text)
    text = text.encode("utf-8", "ignore")[:LONGEST_WISH].decode("utf-8", "ignore")
    return text.lstrip(".- ").rstrip(". ") or otherwise


def checked_path(what: str, path: object) -> Path:
    """Check the path of a file below an entry, with slashes.

    Raises:
        RefusedError: it leads elsewhere, or a part of it is not a name.
    """
    if not isinstance(path, str) or not path:
        raise RefusedError(f"{what}: has no name; give one")
    parts = path.split("/")
    if len(parts) > DEEPEST:
        raise RefusedError(f"{what}: lies in more than {DEEPEST - 1} folders; move it up")
    return Path(*(checked_name(what, part, LONGEST_FILE) for part in parts))


def listed_path(what: str, path: str) -> Path:
    """Return the path of an existing file below an entry; unlike new files, it may have any characters.

    Raises:
        RefusedError: it leads elsewhere.
    """
    parts = path.split("/")
    if any(part.startswith(".") or not part or "\0" in part for part in parts):
        raise RefusedError(f"{what}: the name {printable(path)[:60]!r} is not that of a listed file")
    return Path(*map(as_file_name, parts))


def below(root: Path, path: Path, what: str) -> Path:
    """Return a path below a folder; links inside may not lead out of it.

    Raises:
        RefusedError: it leads out of the folder.
    """
    if not is_inside(root / path, [root]):
        raise RefusedError(f"{what}: leads out of its folder")
    return root / path
