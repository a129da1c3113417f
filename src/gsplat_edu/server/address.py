"""Addresses of servers on this computer: names, sockets, URLs, and who can reach them."""

from __future__ import annotations

import errno
import ipaddress
import os
import re
import socket
from typing import Any

from gsplat_edu.base.constants import LOOPBACK
from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.base.validation import whole_number

PORT = 8080
"""Default port of a page."""

LOCAL_NAME = r"(?:127(?:\.\d{1,3}){3}|localhost|\[::1\])(?::\d+)?"
"""Names by which a browser on this computer addresses it, as a regular expression; a tunnel may change the port."""

HIGHEST_PORT = 65_535
"""Largest number of a port."""

PRIVATE_SUFFIXES = (".local", ".localdomain", ".lan", ".home", ".home.arpa", ".internal")
"""Suffixes of names that only a local network can assign; no external page can have such a name."""


def checked_address(
    host: str, port: int, names: tuple[str, str]
) -> tuple[socket.AddressFamily, tuple[Any, ...]]:
    """Convert host and port to the address of a socket.

    Args:
        host: Name or address.
        port: Port; 0 picks a free one.
        names: The user's names for host and port, for messages.

    Returns:
        The address family and the address.

    Raises:
        ArgumentError: the host cannot be resolved, or the port is out of range.
    """
    port = whole_number(names[1], port, 0, HIGHEST_PORT)
    try:
        found = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)
    except (OSError, UnicodeError):  # names without letters, or too long, fail in their encoding
        raise ArgumentError(
            f"{names[0]}: {host!r} is not an address; give {LOOPBACK} or an address of this computer"
        ) from None
    family, _, _, _, address = found[0]
    return family, address


def bound_socket(host: str, port: int, names: tuple[str, str]) -> socket.socket:
    """Return a socket that is bound to an address, for servers that take one.

    Args:
        host: Name or address.
        port: Port; 0 picks a free one.
        names: The user's names for host and port, for messages.

    Raises:
        ArgumentError: the address does not belong to this computer, or the port is in use or out of range.
    """
    family, address = checked_address(host, port, names)
    bound = socket.socket(family, socket.SOCK_STREAM)
    try:
        if os.name == "posix":  # a port whose last connections are closing counts as free
            bound.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        bound.bind(address)
        bound.listen()
    except OSError as error:
        bound.close()
        raise refused_address(host, port, names, error) from None
    return bound


def free_port(host: str, port: int, names: tuple[str, str]) -> int:
    """Check that a port is available, for servers that do not report it themselves.

    Args:
        host: Name or address.
        port: Port; 0 picks a free one.
        names: The user's names for host and port, for messages.

    Returns:
        The port, or a free one if `port` is 0.

    Raises:
        ArgumentError: the address does not belong to this computer, or the port is in use or out of range.
    """
    with bound_socket(host, port, names) as probe:
        return int(probe.getsockname()[1])


def names_this_computer(header: str, bound: str) -> bool:
    """Return whether a Host header names this computer in a way that no external page could arrange.

    The owner of a name in the public DNS can let it resolve to any address; a page under that name would then share the
    origin of this server. Addresses and names outside the public DNS are safe.

    Args:
        header: Value of the header: a name or address, with an optional port.
        bound: Address that the server is bound to. If it is a loopback address, names of other computers are rejected.
    """
    if re.fullmatch(LOCAL_NAME, header, re.IGNORECASE):
        return True
    found = re.fullmatch(r"(\[[0-9a-f:.]+\]|[a-z0-9_.-]+)(?::\d{1,5})?", header.lower())
    if found is None or is_loopback(bound):
        return False
    name = found[1].removesuffix(".")
    try:
        ipaddress.ip_address(name.strip("[]"))
    except ValueError:
        known = {bound.lower(), socket.gethostname().lower()}
        return "." not in name or name in known or name.endswith(PRIVATE_SUFFIXES)
    return True


def is_loopback(host: str) -> bool:
    """Return whether an address can be reached only from this computer."""
    return re.fullmatch(rf"{LOCAL_NAME}|::1", host, re.I) is not None


def url_of(host: str, port: int) -> str:
    """Return the URL of a page served on this computer."""
    if host in ("0.0.0.0", "::"):  # all addresses of this computer
        host = LOOPBACK if host == "0.0.0.0" else "::1"
    return f"http://[{host}]:{port}/" if ":" in host else f"http://{host}:{port}/"


def warning_for(host: str, what: str, token: bool = False) -> str | None:
    """Return a warning if other computers can reach a server; None if only this one can.

    Args:
        host: Address that the server listens on.
        what: What other computers can do with the server, as a verb phrase.
        token: Whether the server requires the token in its URL.
    """
    if is_loopback(host):
        return None
    if token:
        who = "anyone who can reach this computer and has the URL"
        return f"warning: listening on {host}: {who} {what}; the connection is not encrypted"
    return f"warning: listening on {host}: anyone who can reach this computer {what}; there is no password"


def refused_address(host: str, port: int, names: tuple[str, str], error: OSError) -> ArgumentError:
    """Return the error for an address that cannot be listened on."""
    if error.errno == errno.EADDRINUSE:
        return ArgumentError(
            f"{names[1]}: {port} is in use on {host}; choose another port, or 0 for any free one"
        )
    if error.errno == errno.EACCES:
        return ArgumentError(f"{names[1]}: {port} is not permitted ({error.strerror}); choose one above 1023")
    return ArgumentError(
        f"{names[0]}: cannot listen on {host} ({error.strerror}); give {LOOPBACK} or omit the option"
    )
