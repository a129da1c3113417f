"""Checks of the settings' values: each raises an `ArgumentError` that names the setting."""

from __future__ import annotations

from dataclasses import dataclass

from gsplat_edu.base.validation import LARGEST_WHOLE, float64_array, in_range, one_of, whole_number


@dataclass(frozen=True)
class Whole:
    """Accepts whole numbers from `low` to `high`."""

    low: int
    high: int = LARGEST_WHOLE

    def __call__(self, name: str, value: object) -> None:
        """Check a value."""
        whole_number(name, value, self.low, self.high)


@dataclass(frozen=True)
class OneOf:
    """Accepts one of some names."""

    names: tuple[str, ...]

    def __call__(self, name: str, value: object) -> None:
        """Check a value."""
        one_of(name, value, self.names)


def accept_positive(name: str, value: float) -> None:
    """Accept numbers above 0."""
    in_range(name, value, 0.0, open_low=True)


def accept_not_negative(name: str, value: float) -> None:
    """Accept numbers of at least 0."""
    in_range(name, value, 0.0)


def accept_fraction(name: str, value: float) -> None:
    """Accept numbers from 0 to 1."""
    in_range(name, value, 0.0, 1.0)


def accept_share(name: str, value: float) -> None:
    """Accept numbers above 0 up to 1."""
    in_range(name, value, 0.0, 1.0, open_low=True)


def accept_opacity(name: str, value: float) -> None:
    """Accept opacities whose logit is finite."""
    in_range(name, value, 0.0, 1.0 - 1e-6, open_low=True)


def accept_at_least_1(name: str, value: float | None) -> None:
    """Accept None and numbers of at least 1."""
    if value is not None:
        in_range(name, value, 1.0)


def accept_cap(name: str, value: int | None) -> None:
    """Accept None and whole numbers of at least 1."""
    if value is not None:
        whole_number(name, value, 1)


def accept_color(name: str, value: object) -> None:
    """Accept three numbers."""
    float64_array(name, value, (3,))  # type: ignore[arg-type]


def accept_flag(name: str, value: object) -> None:
    """Accept any value: the option is a flag."""
