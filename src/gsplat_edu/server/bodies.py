"""Bodies of requests, within a limit, and the rest of a refused one; bodies of answers as JSON."""

from __future__ import annotations

import asyncio
import contextlib
import json
from http import HTTPStatus
from typing import Any

from starlette.requests import ClientDisconnect, Request
from starlette.responses import JSONResponse

from gsplat_edu.base.records import without_nan
from gsplat_edu.base.text import whole_of
from gsplat_edu.server.refusal import RefusedError, too_large

MOST_DRAINED = 64 << 20
"""Largest number of bytes of a refused body that are still received; see `drain`."""

LONGEST_DRAIN = 5.0
"""Longest time for receiving them, s."""

SMALL = 64 << 10
"""Bytes of a body that is received although it is longer than allowed: its answer would be lost otherwise."""


def content_length(request: Request) -> int | None:
    """Return the announced length of a body; None if it has none.

    Raises:
        RefusedError: it is no number.
    """
    text = request.headers.get("content-length")
    if text is None:
        return None if "transfer-encoding" in request.headers else 0
    length = whole_of(text)
    if length is None:
        raise RefusedError("Content-Length: is not a number of bytes")
    return length


async def body_of(request: Request, most: int) -> bytes:
    """Return the body of a request.

    Args:
        request: The request.
        most: Largest number of bytes.

    Raises:
        RefusedError: it has no announced length, is longer, or stalls.
        ClientDisconnect: it is incomplete.
    """
    if "content-length" not in request.headers:
        raise RefusedError("the length is missing", HTTPStatus.LENGTH_REQUIRED)
    length = content_length(request) or 0
    if length > most:
        if length <= SMALL:
            await drain(request, HTTPStatus.BAD_REQUEST)
        raise too_large(f"at most {most:,} bytes")
    pieces, size = [], 0
    async for piece in request.stream():
        size += len(piece)
        if size > most:  # it is chunked, and its announced length does not count
            raise too_large(f"at most {most:,} bytes")
        pieces.append(piece)
    return b"".join(pieces)


async def drain(request: Request, status: HTTPStatus) -> None:
    """Receive the rest of a refused body, because a browser that is still sending would lose the answer.

    A body that is refused for its size or because it stalls, or announced to be larger than `MOST_DRAINED`, is not
    received.

    Args:
        request: The request.
        status: With which it is refused.
    """
    length = whole_of(request.headers.get("content-length", "0"))
    given_up = (
        HTTPStatus.REQUEST_ENTITY_TOO_LARGE,
        HTTPStatus.INSUFFICIENT_STORAGE,
        HTTPStatus.REQUEST_TIMEOUT,
    )
    if status in given_up or length is None or length > MOST_DRAINED:
        return
    size = 0
    # RuntimeError: the body was received already; RefusedError: it stalls
    with contextlib.suppress(ClientDisconnect, RuntimeError, TimeoutError, RefusedError):
        async with asyncio.timeout(LONGEST_DRAIN):
            async for piece in request.stream():
                size += len(piece)
                if size > MOST_DRAINED:
                    return


class Json(JSONResponse):
    """A JSON answer, valid for any text and numbers from a file.

    Text that no encoding accepts is escaped; JSON has no NaN and no infinities, so these become null.
    """

    def render(self, content: Any) -> bytes:  # noqa: ANN401
        """Return the bytes."""
        try:
            return json.dumps(content, allow_nan=False, separators=(",", ":")).encode("ascii")
        except ValueError:
            return json.dumps(without_nan(content), allow_nan=False, separators=(",", ":")).encode("ascii")
