"""Access control of the server: it answers only its own page, with the URL's token, under a name of this computer.

A browser lets any page send requests to any address. So every request has to pass these checks first:

- Host names this computer (`gsplat_edu.viewer.serve.names_this_computer`); this prevents DNS rebinding.
- Origin, if there is one, is the server itself, and Sec-Fetch-Site does not say that another site asks.
- The token, random for each start, is in the cookie that the page got when it was opened with the token in its URL,
  or in the header `Authorization: Bearer TOKEN`.
- A request that changes something has an Origin, or the header; forms of other pages have neither.

No answer has CORS headers, so no other page can read it.
"""

from __future__ import annotations

import secrets
import urllib.parse
from http import HTTPStatus

from starlette.datastructures import Headers, MutableHeaders
from starlette.responses import PlainTextResponse
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from gsplat_edu.viewer.guard import READING, cookie_values
from gsplat_edu.viewer.serve import names_this_computer

POLICY = "; ".join(
    (
        "default-src 'none'",
        "script-src 'self'",
        "style-src 'self'",
        "img-src 'self' data: blob:",
        "media-src 'self' blob:",
        "connect-src 'self'",
        "worker-src 'self' blob:",
        "frame-src 'self'",
        "base-uri 'none'",
        "form-action 'none'",
        "frame-ancestors 'none'",
    )
)
"""Content-Security-Policy: no inline scripts or styles, nothing from elsewhere."""

HEADERS = {
    "Content-Security-Policy": POLICY,
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cross-Origin-Opener-Policy": "same-origin",
}
"""Headers of every answer."""


class Guard:
    """Checks requests, and adds the security headers to answers.

    Args:
        app: Application that answers the requests that pass.
        token: The token.
        host: Address that the server listens on.
        cookie: Name of the cookie; different for servers on other ports, which share their cookies.
    """

    def __init__(self, app: ASGIApp, token: str, host: str, cookie: str) -> None:
        self.app, self.token, self.host, self.cookie = app, token, host, cookie

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer a request, or refuse it."""
        if scope["type"] == "lifespan":
            await self.app(scope, receive, send)
            return
        headers = Headers(scope=scope)
        opened = self._is_opened(scope)

        async def guarded(message: Message) -> None:
            if message["type"] == "http.response.start":
                answer = MutableHeaders(scope=message)
                for name, value in HEADERS.items():
                    answer.setdefault(name, value)
                answer.setdefault("Cache-Control", "no-store")
                if opened:
                    answer["Set-Cookie"] = f"{self.cookie}={self.token}; Path=/; HttpOnly; SameSite=Strict"
            await send(message)

        if scope["type"] != "http" or (fault := self._fault(scope, headers, opened)) is not None:
            if scope["type"] == "http":
                opened = False
                refusal = PlainTextResponse(
                    f"403 Forbidden: {fault}\n", HTTPStatus.FORBIDDEN, headers={"Connection": "close"}
                )
                await refusal(scope, receive, guarded)
            return
        await self.app(scope, receive, guarded)

    def _fault(self, scope: Scope, headers: Headers, opened: bool) -> str | None:
        hosts, origins = headers.getlist("host"), headers.getlist("origin")
        if len(hosts) != 1 or not names_this_computer(hosts[0], self.host):
            return "unknown host name for this server"
        own = {f"{scheme}://{hosts[0]}".lower() for scheme in ("http", "https")}  # https if a proxy adds it
        if len(origins) > 1 or not own.issuperset(map(str.lower, origins)):
            return "requests from other pages are not allowed"
        if headers.get("sec-fetch-site", "none") not in ("same-origin", "none") and not opened:
            return "requests from other pages are not allowed"
        bearer = headers.get("authorization", "")
        if self._is_token(bearer.removeprefix("Bearer ")) and bearer.startswith("Bearer "):
            return None
        if not opened and not any(map(self._is_token, cookie_values(headers.getlist("cookie"), self.cookie))):
            return "open the URL that gsplat-edu studio printed, including its token"
        if scope["method"] not in READING and not origins:
            return "requests that change something need an Origin, or the token in Authorization"
        return None

    def _is_opened(self, scope: Scope) -> bool:
        """Return whether the request opens the page by its URL with the token."""
        if scope["type"] != "http" or scope["path"] != "/" or scope["method"] not in READING:
            return False
        query = urllib.parse.parse_qs(scope["query_string"].decode("latin-1"))
        return any(map(self._is_token, query.get("token", [])))

    def _is_token(self, given: str) -> bool:
        return secrets.compare_digest(given.encode("utf-8", "surrogatepass"), self.token.encode())
