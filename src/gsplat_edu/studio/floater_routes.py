"""Routes of the editor that propose splats to delete (`gsplat_edu.viewer.proposing`)."""

from __future__ import annotations

from typing import Any

from starlette.requests import Request
from starlette.routing import BaseRoute

from gsplat_edu.studio.commands import scene_of
from gsplat_edu.studio.replies import act, entry_of
from gsplat_edu.studio.scene_routes import current_scene
from gsplat_edu.studio.state import Studio
from gsplat_edu.viewer.proposing import NAME, Proposing


def routes() -> list[BaseRoute]:
    """Return the routes."""
    place = f"/api/{{kind}}/{{name}}/{NAME}"
    return [act(place, "GET", _state), act(place, "POST", _start), act(place, "DELETE", _stop)]


def _proposing(studio: Studio, request: Request) -> Proposing:
    """Return the judgement of the entry's scene as it is now."""
    kind, entry = entry_of(studio, request)
    scene = current_scene(studio.library, entry, kind)
    facts = scene.stat()
    return studio.proposals.of(f"{scene} {facts.st_mtime_ns} {facts.st_size}", scene_of(entry, kind))


def _state(studio: Studio, request: Request, body: Any) -> dict[str, Any]:  # noqa: ANN401
    return _proposing(studio, request).state()


def _start(studio: Studio, request: Request, body: Any) -> dict[str, Any]:  # noqa: ANN401
    proposing = _proposing(studio, request)
    studio.proposals.start(proposing)
    return proposing.state()


def _stop(studio: Studio, request: Request, body: Any) -> dict[str, Any]:  # noqa: ANN401
    proposing = _proposing(studio, request)
    proposing.stop()
    return proposing.state()
