"""Access control of every server: it answers only requests that name this computer and, with a token, its own page.

A browser lets any page send requests to any address. So every request has to pass these checks first:

- Host names this computer (`gsplat_edu.server.address.names_this_computer`); this prevents DNS rebinding.

A server that changes something has a token, random for each start. Then a request also has to pass these:

- Origin, if there is one, is the server itself, and Sec-Fetch-Site does not say that another site asks.
- The token is in the cookie that the page got when it was opened with the token in its URL, or in the header
  `Authorization: Bearer TOKEN`. The cookie is HttpOnly and SameSite=Strict.
- A request that changes something has an Origin, or the header; forms of other pages have neither.

No answer has CORS headers, so no other page can read it.
"""

from __future__ import annotations

import html
import http.cookies
import secrets
import urllib.parse
from collections.abc import Sequence
from http import HTTPStatus

from starlette.datastructures import Headers, MutableHeaders
from starlette.responses import HTMLResponse, PlainTextResponse, Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from gsplat_edu.server.address import names_this_computer

READING = ("GET", "HEAD")
"""Methods that change nothing. Browsers send no Origin with them to the page's own server."""

HEADERS = {
    "Cache-Control": "no-store",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",  # the URL is a secret
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cross-Origin-Opener-Policy": "same-origin",
}
"""Headers of every answer that does not have its own."""


LOCKED = "open the URL that was printed, including its token"
"""Why a request without the token is refused."""

LOCKED_PAGE = """<!DOCTYPE html>
<html lang="en">
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta name="color-scheme" content="light dark">
<title>403 Forbidden</title>
<h1>This address needs its key</h1>
<p>The key is new whenever the program starts. Look in the terminal where it runs for the last line that begins with
<strong>http://{host}/?token=</strong> and open that whole address. If no program runs there any more, start it again by
the same command; it prints the address.</p>
</html>
"""
"""What a person sees who opens the page without the token. It says nothing that is not known to everybody."""


class Guard:
    """Checks requests, and adds the security headers to answers.

    Args:
        app: Application that answers the requests that pass.
        host: Address that the server listens on.
        policy: Content-Security-Policy of the answers; empty sends none.
        token: The token; empty checks only Host.
        cookie: Name of the cookie; different for servers on other ports, which share their cookies.
    """

    def __init__(self, app: ASGIApp, host: str, policy: str, token: str = "", cookie: str = "") -> None:
        self.app, self.host, self.token, self.cookie = app, host, token, cookie
        self.headers = HEADERS | ({"Content-Security-Policy": policy} if policy else {})

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer a request, or refuse it."""
        if scope["type"] == "lifespan":
            await self.app(scope, receive, send)
            return
        if scope["type"] != "http":
            return
        opened = self._is_opened(scope)
        fault = self._fault(scope, Headers(scope=scope), opened)

        async def guarded(message: Message) -> None:
            if message["type"] == "http.response.start":
                answer = MutableHeaders(scope=message)
                for name, value in self.headers.items():
                    answer.setdefault(name, value)
                if opened and fault is None:
                    answer["Set-Cookie"] = f"{self.cookie}={self.token}; Path=/; HttpOnly; SameSite=Strict"
            await send(message)

        if fault is None:
            await self.app(scope, receive, guarded)
        else:
            await _refusal(fault, Headers(scope=scope))(scope, receive, guarded)

    def _fault(self, scope: Scope, headers: Headers, opened: bool) -> str | None:
        """Return why a request is refused, in one line for the user; None if it is accepted."""
        hosts, origins = headers.getlist("host"), headers.getlist("origin")
        if len(hosts) != 1 or not names_this_computer(hosts[0], self.host):
            return "unknown host name for this server"
        if not self.token:
            return None
        own = {f"{scheme}://{hosts[0]}".lower() for scheme in ("http", "https")}  # https if a proxy adds it
        foreign = set(headers.getlist("sec-fetch-site")) - {"same-origin", "none"}
        if len(origins) > 1 or not own.issuperset(map(str.lower, origins)) or (foreign and not opened):
            return "requests from other pages are not allowed"
        bearer = headers.get("authorization", "")
        if self._is_token(bearer.removeprefix("Bearer ")) and bearer.startswith("Bearer "):
            return None
        if not opened and not any(map(self._is_token, cookie_values(headers.getlist("cookie"), self.cookie))):
            return LOCKED
        if scope["method"] not in READING and not origins:
            return "requests that change something need an Origin, or the token in Authorization"
        return None

    def _is_opened(self, scope: Scope) -> bool:
        """Return whether the request opens the page by its URL with the token."""
        if not self.token or scope["path"] != "/" or scope["method"] not in READING:
            return False
        query = urllib.parse.parse_qs(scope["query_string"].decode("latin-1"))
        return any(map(self._is_token, query.get("token", [])))

    def _is_token(self, given: str) -> bool:
        return secrets.compare_digest(given.encode("utf-8", "surrogatepass"), self.token.encode())


def _refusal(fault: str, headers: Headers) -> Response:
    """Return the answer to a refused request: a page where a person opens one without the token, else one line."""
    close = {"Connection": "close"}
    if fault == LOCKED and headers.get("accept", "").startswith("text/html"):
        page = LOCKED_PAGE.format(host=html.escape(headers["host"]))
        return HTMLResponse(page, HTTPStatus.FORBIDDEN, headers=close)
    return PlainTextResponse(f"403 Forbidden: {fault}\n", HTTPStatus.FORBIDDEN, headers=close)


def cookie_values(headers: Sequence[str], name: str) -> list[str]:
    """Return the values of a cookie in the headers of a request; headers that cannot be parsed have none."""
    values = []
    for header in headers:
        try:
            found = http.cookies.SimpleCookie(header)
        except http.cookies.CookieError:
            continue
        if name in found:
            values.append(found[name].value)
    return values
