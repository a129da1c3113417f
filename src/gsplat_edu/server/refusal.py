"""The error of a refused request, with its HTTP status."""

from __future__ import annotations

from http import HTTPStatus

from gsplat_edu.base.errors import ArgumentError


class RefusedError(ArgumentError):
    """A request cannot be carried out.

    Args:
        message: One line: what is wrong, where, and what to do next.
        status: Status of the answer.
    """

    def __init__(self, message: str, status: HTTPStatus = HTTPStatus.BAD_REQUEST) -> None:
        super().__init__(message)
        self.status = status


def not_found(what: str) -> RefusedError:
    """Return the error for a thing that does not exist."""
    return RefusedError(f"{what}: does not exist; it may have been renamed or removed", HTTPStatus.NOT_FOUND)


def conflict(message: str) -> RefusedError:
    """Return the error for a request that the library's state does not allow."""
    return RefusedError(message, HTTPStatus.CONFLICT)


def too_large(message: str) -> RefusedError:
    """Return the error for a request that exceeds a limit."""
    return RefusedError(message, HTTPStatus.REQUEST_ENTITY_TOO_LARGE)
