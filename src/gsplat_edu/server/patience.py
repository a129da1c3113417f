"""Time limits for the body of a request, and a pause between parts of an answer."""

from __future__ import annotations

import asyncio
from http import HTTPStatus

from starlette.types import ASGIApp, Message, Receive, Scope, Send

from gsplat_edu.server.refusal import RefusedError

CHUNK = 1 << 20
"""Bytes per write. The time limit of a slow reader holds for each chunk, not for a page of many MB."""

LEAST_GAIN = 4096
"""Number of new bytes of a body that count as progress, so that single bytes do not keep a connection open."""


class Patience:
    """Aborts requests whose body stalls, in any route, and stops writing to closed connections.

    Only time spent waiting for bytes counts, not time spent writing them to a disk.

    Args:
        app: What answers the requests.
        seconds: Longest wait for `LEAST_GAIN` more bytes of a body, or for its end.
    """

    def __init__(self, app: ASGIApp, seconds: float) -> None:
        self.app, self.seconds = app, seconds

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer a request."""
        if scope["type"] != "http":
            await self.app(scope, receive, send)
            return
        left, new, is_whole = self.seconds, 0, False
        loop = asyncio.get_running_loop()

        async def patient() -> Message:
            nonlocal left, new, is_whole
            if is_whole:  # further messages say that the browser is gone
                return await receive()
            began = loop.time()
            try:
                message = await asyncio.wait_for(receive(), left)
            except TimeoutError:
                raise RefusedError(
                    f"body: fewer than {LEAST_GAIN:,} bytes of it came in {self.seconds:g} s; send it again",
                    HTTPStatus.REQUEST_TIMEOUT,
                ) from None
            left -= loop.time() - began
            new += len(message.get("body", b""))
            if new >= LEAST_GAIN:
                left, new = self.seconds, 0
            is_whole = message["type"] != "http.request" or not message.get("more_body", False)
            return message

        async def yielding(message: Message) -> None:
            whole = memoryview(message.get("body", b""))
            for begin in range(0, max(len(whole) - CHUNK, 0), CHUNK):
                await send({**message, "body": whole[begin : begin + CHUNK], "more_body": True})
                await asyncio.sleep(0)
            if len(whole) > CHUNK:
                message = {**message, "body": whole[(len(whole) - 1) // CHUNK * CHUNK :]}
            await send(message)
            if message.get("more_body", False):
                # else many parts are written before the loop can tell that the connection is gone, and asyncio
                # complains about each of them
                await asyncio.sleep(0)

        await self.app(scope, patient, yielding)
