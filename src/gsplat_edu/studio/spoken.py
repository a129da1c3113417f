"""Sentences for people from the lines of errors, which name paths, options, fields of requests and jobs."""

from __future__ import annotations

import re

from gsplat_edu.base.text import Told

MISMATCH = "The page and the studio do not fit together. Reload the page."
"""What a person can do about a request that no page of this version sends."""

OWN_FIELDS = frozenset(
    (
        *("after", "at", "body", "by", "command", "Content-Length", "do", "format", "inputs", "options"),
        *("outputs", "resolution", "side", "to"),
    )
)
"""Fields of requests that the page fills in by itself."""

NOUNS = {
    "edits.json": "What was edited",
    "file": "The file",
    "jobs": "The list of jobs",
    "name": "The entry",
    "path": "The place",
    "picture": "The picture",
    "zip": "The zip file",
}
"""Things that a line may begin with, in words."""

ITSELF = "It"
"""What a job is called beside its card."""

_PROGRAM = re.compile(r"gsplat-edu \S+: ")
_SUBJECT = re.compile(r"((?:job )?\S[^:;]{0,300}): +(?=\S)")
_PATH = re.compile(
    r"'?(?<![\w.:/])/(?:[^/:;,']+/)*([^/\s:;,'][^/:;,']*?)'?"
    r"(?= (?:is|has|does|holds|overlaps|leads|exists|cannot)\b|[:;,.)]|$)"
)
_COMMAND = re.compile(r"--[a-z]|gsplat-edu |\.jsonl?\b|docs/")
_ALTERNATIVE = re.compile(r",? or (?:set|give|use|by|with) --[\w-]+")
_VERB = re.compile(
    r"(?:is|are|was|has|have|had|does|do|exists?|holds?|takes?|cannot|can|may|unpacks|leads?|needs?|ends?)\b"
)


def spoken(line: str) -> str:
    """Return an error's line as sentences for the first level of a page: no path, option, field or number of a job.

    Args:
        line: "WHERE: what is wrong; what to do", the line of an error; `Told` has its words for a page with it.
    """
    if isinstance(line, Told):
        return line.plain
    text = _PROGRAM.sub("", line.strip())
    if text.partition(":")[0].partition(".")[0] in OWN_FIELDS:
        return MISMATCH
    text = _PATH.sub(lambda found: f"“{found[1]}”", _ALTERNATIVE.sub("", text))
    subject = _SUBJECT.match(text)
    if subject is not None:
        what = text[subject.end() :]
        noun = _noun(subject[1])
        of_field = noun == ITSELF or noun in NOUNS.values()
        text = f"{noun} {what}" if _VERB.match(what) else what if of_field else f"{noun}: {what}"
    parts = [part.strip() for part in text.split(";") if part.strip()]
    said = [part for part in parts if not _COMMAND.search(part)] or ["This cannot be done"]
    return " ".join(f"{part[0].upper()}{part[1:].removesuffix('.')}." for part in said)


def _noun(subject: str) -> str:
    """Return what a line is about: the last part of a place, or a word for a field."""
    if subject in NOUNS:
        return NOUNS[subject]
    if subject.startswith(("job ", "jobs/")):
        return ITSELF
    if subject[0] == "“":
        return subject
    return f"“{subject.rpartition('/')[2]}”"
