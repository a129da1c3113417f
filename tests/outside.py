"""Forbids the tests' process to contact other computers, so every test checks that commands do not."""

import ipaddress
import sys

EVENTS = ("socket.connect", "socket.sendto")
"""Python's audit events with an address."""


class OutsideError(AssertionError):
    """A test contacted another computer."""


def is_here(address: object) -> bool:
    """Return whether a socket's address is on this computer: a path, or a loopback address."""
    if not isinstance(address, tuple):
        return True
    host = address[0]
    if isinstance(host, bytes):
        host = host.decode("ascii", "replace")
    if host in ("", "localhost"):
        return True
    try:
        found = ipaddress.ip_address(host.partition("%")[0])
    except ValueError:
        return False
    return found.is_loopback or found.is_unspecified  # the target 0.0.0.0 is this computer


def forbid() -> None:
    """Raise an error at every connection to another computer from now on; this cannot be undone."""

    def heard(event: str, arguments: tuple[object, ...]) -> None:
        if event in EVENTS and not is_here(arguments[1]):
            raise OutsideError(f"{event} to {arguments[1]}: a test contacts another computer")

    sys.addaudithook(heard)
