"""Access control for servers that change things: only their own page, with its token, may send requests.

Browsers let any page send requests to any address. So each request must pass three checks:

- Host names this computer (`gsplat_edu.server.address.names_this_computer`); this prevents DNS rebinding.
- Origin, required unless the method only reads, has the same host and port: the page was served here. A request that
  only reads must come from the server's own page too, if the browser sends Sec-Fetch-Site. Only the page itself may be
  opened from elsewhere, with the token.
- The token, random for each server, is in the URL or in the cookie set when the page was opened with it. The cookie is
  HttpOnly and SameSite=Strict.

The module imports nothing slow.
"""

from __future__ import annotations

import http.cookies
import secrets
import urllib.parse
from collections.abc import Callable, Sequence

from gsplat_edu.server.address import names_this_computer

TOKEN_BYTES = 16
"""Random bytes of a token: 2^128 possibilities cannot be guessed."""

READING = ("GET", "HEAD")
"""Methods that change nothing. Browsers send no Origin with them to the page's own server."""


class Guard:
    """Checks requests to one server.

    Args:
        host: Address that the server listens on.
        port: Its port, which distinguishes its cookie from those of other servers on this computer.

    Attributes:
        token: The token.
    """

    def __init__(self, host: str, port: int) -> None:
        self.token = secrets.token_urlsafe(TOKEN_BYTES)
        self._host = host
        self._name = f"gsplat_edu_{port}"

    @property
    def cookie(self) -> str:
        """The value of Set-Cookie in the answer to a request for the page with the token."""
        return f"{self._name}={self.token}; Path=/; HttpOnly; SameSite=Strict"

    def fault(self, method: str, target: str, headers: Callable[[str], Sequence[str]]) -> str | None:
        """Return why a request is refused, in one line for the user; None if it is accepted.

        Args:
            method: GET, POST or another.
            target: Path and query as in the request.
            headers: Returns all values of a header by its name.
        """
        hosts, origins = headers("Host"), headers("Origin")
        if len(hosts) != 1 or not names_this_computer(hosts[0], self._host):
            return "unknown host name for this server"
        own = {f"{scheme}://{hosts[0]}".lower() for scheme in ("http", "https")}  # https if a proxy adds it
        path = urllib.parse.urlsplit(target).path
        foreign = set(headers("Sec-Fetch-Site")) - {"same-origin", "none"} and path != "/"
        needs_origin = method not in READING
        if (
            foreign
            or len(origins) > 1
            or (needs_origin and not origins)
            or not own.issuperset(map(str.lower, origins))
        ):
            return "requests from other pages are not allowed"
        if not any(
            secrets.compare_digest(given.encode("utf-8", "replace"), self.token.encode())
            for given in self._given(target, headers("Cookie"))
        ):
            return "open the URL that was printed, including its token"
        return None

    def _given(self, target: str, cookies: Sequence[str]) -> list[str]:
        """Return the tokens in a request's URL and cookies."""
        query = urllib.parse.urlsplit(target).query
        return [*urllib.parse.parse_qs(query).get("token", []), *cookie_values(cookies, self._name)]


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
