"""What the server refuses, with the status that HTTP has for it."""

from __future__ import annotations

from http import HTTPStatus

from gsplat_edu.errors import ArgumentError


class Refused(ArgumentError):
    """A request cannot be carried out.

    Args:
        message: One line: what is wrong, where, and what to do next.
        status: Status of the answer.
    """

    def __init__(self, message: str, status: HTTPStatus = HTTPStatus.BAD_REQUEST) -> None:
        super().__init__(message)
        self.status = status


def missing(what: str) -> Refused:
    """Return the refusal of something that does not exist."""
    return Refused(f"{what}: does not exist; it may have been renamed or removed", HTTPStatus.NOT_FOUND)


def conflict(message: str) -> Refused:
    """Return the refusal of something that the state of the library does not allow."""
    return Refused(message, HTTPStatus.CONFLICT)


def too_large(message: str) -> Refused:
    """Return the refusal of something beyond a limit."""
    return Refused(message, HTTPStatus.REQUEST_ENTITY_TOO_LARGE)
