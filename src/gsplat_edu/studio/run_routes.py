"""Routes of runs and captures: curves, held-out views, comparisons, findings and forecasts."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from msgspec.structs import asdict
from starlette.requests import Request
from starlette.responses import Response
from starlette.routing import BaseRoute

from gsplat_edu.base.constants import AUTO
from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.base.records import Number, record_of
from gsplat_edu.base.text import legible
from gsplat_edu.jobs.events import Diagnosed, Found, Started
from gsplat_edu.jobs.following import events_after
from gsplat_edu.jobs.record import Job
from gsplat_edu.runs.folder import RunFolder
from gsplat_edu.server.refusal import RefusedError
from gsplat_edu.studio.contents import photo_names
from gsplat_edu.studio.listing import summaries
from gsplat_edu.studio.origins import makers, origins, renamed_capture
from gsplat_edu.studio.photo_masks import masked
from gsplat_edu.studio.pictures import left_out
from gsplat_edu.studio.proposals import proposals, train_again
from gsplat_edu.studio.replies import act, entry_of, file_answer
from gsplat_edu.studio.runs import compared, curves, held_out_views, view_picture
from gsplat_edu.studio.state import Studio

REPORT_POLICY = (
    "sandbox; default-src 'none'; style-src 'unsafe-inline'; img-src data:; frame-ancestors 'self'"
)
"""Content-Security-Policy of a run's report, which contains its style and pictures: no scripts, and no origin."""


def routes() -> list[BaseRoute]:
    """Return the routes."""
    return [
        act("/api/runs/{name}/curves", "GET", _curves),
        act(
            "/api/runs/{name}/views",
            "GET",
            lambda studio, request, body: {"views": held_out_views(_run(studio, request))},
        ),
        act("/api/runs/{name}/views/{index}/{what}.png", "GET", _picture),
        act("/api/runs/{name}/views/{index}/{what}.jpg", "GET", _preview),
        act("/api/runs/{name}/report", "GET", _report),
        act("/api/compare", "GET", _compare),
        act("/api/{kind}/{name}/findings", "GET", _findings),
        act("/api/captures/{name}/forecast", "GET", _forecast),
    ]


def _run(studio: Studio, request: Request) -> RunFolder:
    return _run_named(studio, request.path_params["name"])


def _run_named(studio: Studio, name: str) -> RunFolder:
    """Return a run; a link in it may not lead out of the library."""
    entry = studio.library.entry("runs", name)
    studio.library.check_tree(entry)
    return RunFolder(entry)


def _curves(studio: Studio, request: Request, body: Any) -> dict[str, Any]:  # noqa: ANN401
    return curves(_run(studio, request), request.query_params.get("after", ""))


def _picture(studio: Studio, request: Request, body: Any) -> Response:  # noqa: ANN401
    return file_answer(request, _view_file(studio, request, small=False), "image/png")


def _preview(studio: Studio, request: Request, body: Any) -> Response:  # noqa: ANN401
    return file_answer(request, _view_file(studio, request, small=True), "image/jpeg")


def _view_file(studio: Studio, request: Request, small: bool) -> Path:
    params, cache = request.path_params, studio.library.hidden("cache") / "views"
    return view_picture(studio.decoder, cache, _run(studio, request), params["index"], params["what"], small)


def _report(studio: Studio, request: Request, body: Any) -> Response:  # noqa: ANN401
    answer = file_answer(request, _run(studio, request).report, "text/html; charset=utf-8")
    answer.headers["Content-Security-Policy"] = REPORT_POLICY
    return answer


def _compare(studio: Studio, request: Request, body: Any) -> dict[str, Any]:  # noqa: ANN401
    a, b = (_run_named(studio, request.query_params.get(name, "")) for name in "ab")
    return compared(a, b)


def _forecast(studio: Studio, request: Request, body: Any) -> dict[str, Any]:  # noqa: ANN401
    entry = studio.library.entry("captures", request.path_params["name"])
    text = request.query_params.get("resolution")
    try:
        resolution = text if text in (None, AUTO) else record_of("resolution", float(text), Number)
    except (ArgumentError, ValueError):
        raise RefusedError(f"resolution: is {str(text)[:20]!r}, but has to be a number or auto") from None
    return {"qualities": studio.prober.ask("forecast", capture=str(entry), resolution=resolution)}


def _findings(studio: Studio, request: Request, body: Any) -> dict[str, Any]:  # noqa: ANN401
    kind, entry = entry_of(studio, request)
    if kind not in ("captures", "runs"):
        raise RefusedError(f"{kind}: the doctor examines captures and runs")
    subject = studio.library.name(entry)
    jobs = [
        job for job in studio.queue.jobs() if job.work.command == "doctor" and job.work.inputs == (subject,)
    ]
    if not jobs:
        certain = studio.prober.ask("certain", capture=str(entry))["findings"] if kind == "captures" else []
        events = record_of("findings", certain, tuple[Found, ...])
        return {
            "job": None,
            "state": None,
            "findings": _with_photos(studio, kind, entry, entry if kind == "captures" else None, events),
            "facts": [],
            "fine": [],
            "advice": [],
            "stale": False,
            "again": None,
        }
    return _diagnosis(studio, jobs[-1], kind, entry)


def _with_photos(
    studio: Studio, kind: str, entry: Path, capture: Path | None, findings: Sequence[Found]
) -> list[dict[str, Any]]:
    """Return findings with the affected photos, and with what the page offers to do."""
    places = {} if capture is None else _photo_places(capture)
    if capture is not None and any(name not in places for finding in findings for name in finding.images):
        places = _source_places(studio, capture) | places
    out, drawn = set[str](), set[str]()
    if capture is not None:
        prefix = f"captures/{legible(capture.name)}/"
        out, drawn = ({f"{prefix}{name}" for name in those(capture)} for those in (left_out, masked))
    shown = []
    for finding in findings:
        photos = [places.get(name) for name in finding.images]
        facts = {
            "photos": photos,
            "left_out": [photo in out for photo in photos],
            "masked": [photo in drawn for photo in photos],
            "proposals": proposals(studio, kind, entry, finding),
        }
        shown.append({**asdict(finding), **facts})
    return shown


def _diagnosis(studio: Studio, job: Job, kind: str, entry: Path) -> dict[str, Any]:
    """Return the findings of a doctor job, with the affected photos."""
    path = studio.queue.files(job.id).events
    events = [event for _, _, event in events_after(path)]
    starts = [index for index, event in enumerate(events) if isinstance(event, Started)]
    events = events[starts[-1] :] if starts else events
    capture = entry if kind == "captures" else _capture_of(studio, entry)
    found = [event for event in events if isinstance(event, Found)]
    findings = _with_photos(studio, kind, entry, capture, found)
    rest = next((event for event in events if isinstance(event, Diagnosed)), Diagnosed((), (), ()))
    changing = entry / "metrics.json" if kind == "runs" else entry
    # a change while the doctor looked may have come after what it read
    began = job.started if job.ended is not None else None
    stale = began is not None and changing.exists() and changing.stat().st_mtime > began
    return {
        "job": job.id,
        "state": job.state.value,
        "line": job.line,
        "findings": findings,
        **asdict(rest),
        "facts": [(name, _with_names(text, entry, capture)) for name, text in rest.facts],
        "stale": stale,
        "again": train_again(studio, entry) if kind == "runs" else None,
    }


def _with_names(text: str, *entries: Path | None) -> str:
    """Return a text with the names of entries in place of their paths."""
    places = {
        str(path): legible(entry.name) for entry in entries if entry for path in (entry, entry.resolve())
    }
    for path in sorted(places, key=len, reverse=True):
        text = text.replace(path, places[path])
    return text


def _capture_of(studio: Studio, run: Path) -> Path | None:
    """Return the capture of a run; None if it is not in the library."""
    try:
        named = str(RunFolder(run).read_config()["data"]["path"])
    except (KeyError, TypeError):
        return None
    capture = Path(renamed_capture(studio.library, run, named, studio.former) or named)
    parent = studio.library.root / "captures"
    return capture if capture.parent == parent and capture.is_dir() else None


def _source_places(studio: Studio, capture: Path) -> dict[str, str]:
    """Return the photos of the search that made a capture as `_photo_places` does: those without a pose too."""
    made_by = makers(studio.queue.jobs())
    sources = origins(studio.library, summaries(studio.library), made_by, studio.former)
    source = sources.get(studio.library.name(capture))
    return {} if source is None else _photo_places(studio.library.named(source)[1])


def _photo_places(entry: Path) -> dict[str, str]:
    """Return the photos of an entry as "captures/NAME/thumbs" names them, by their names."""
    found: dict[str, str] = {}
    place = f"{entry.parent.name}/{legible(entry.name)}"
    for name in photo_names(entry):
        parts = name.split("/")
        for start in range(len(parts)):
            found.setdefault("/".join(parts[start:]), f"{place}/{legible(name)}")
    return found
