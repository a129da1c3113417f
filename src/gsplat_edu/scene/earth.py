"""Where on earth a scene is: an affine map from its coordinates to a coordinate reference system in metres.

    place = A (coordinates + origin) + b

Earth-centred coordinates (EPSG:4978) are those of GPS: x towards 0 N 0 E, y towards 0 N 90 E, z towards the north pole.
With a projected system, such as EPSG:32633, the places are easting, northing and height.

Source: NIMA TR8350.2 for the ellipsoid; Bowring 1985 for latitude and height from earth-centred coordinates.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float64

from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.base.validation import ArrayLike, float64_array
from gsplat_edu.scene.frame import FARTHEST_ORIGIN

SEMI_MAJOR, FLATTENING = 6_378_137.0, 1.0 / 298.257223563
"""The ellipsoid of GPS, m (WGS 84). On a sphere, distances would be wrong by up to 0.5 %."""

SQUARED_ECCENTRICITY = FLATTENING * (2.0 - FLATTENING)

EARTH_CENTRED = "EPSG:4978"
"""The system of earth-centred coordinates of WGS 84."""

NEAR_SURFACE = 50_000.0
"""Positions this close to the ellipsoid, m, are taken to be earth-centred coordinates."""

CODE = re.compile(r"[A-Za-z]+:[0-9]+(\+[0-9]+)?")
"""A system by its authority and number, if need be with that of its heights."""

LAST_CODE = re.compile(r"(?:AUTHORITY|ID)\[\"(EPSG)\",\s*\"?([0-9]+)\"?\]\s*\]\s*$")
"""The code of a whole system at the end of its well-known text."""


@dataclass(frozen=True)
class Earth:
    """A map from a scene's coordinates to a coordinate reference system.

    Args:
        crs: The system, such as "EPSG:4978".
        matrix: The rows of (A | b), 12 numbers.

    Raises:
        ArgumentError: the system is no code, or a number is not finite or too large.
    """

    crs: str
    matrix: tuple[float, ...]

    def __post_init__(self) -> None:
        if not CODE.fullmatch(self.crs):
            raise ArgumentError(
                f"crs: is {self.crs[:40]!r}, but must be a code such as EPSG:32633; give its code"
            )
        numbers = float64_array("matrix", self.matrix, (12,))
        if not np.abs(numbers).max() <= FARTHEST_ORIGIN:
            raise ArgumentError("matrix: is not finite or too large; give another place on earth")

    @classmethod
    def of(cls, A: ArrayLike, b: ArrayLike, crs: str = EARTH_CENTRED) -> Earth:
        """Return the map x to A x + b.

        Args:
            A: (3, 3).
            b: (3,) m.
            crs: The system.
        """
        rows = np.column_stack([float64_array("A", A, (3, 3)), float64_array("b", b, (3,))])
        return cls(crs, tuple(rows.ravel().tolist()))

    @classmethod
    def at_place(
        cls, latitude: float, longitude: float, height: float, axes: ArrayLike | None = None
    ) -> Earth:
        """Return the map of coordinates in metres whose zero is at a place.

        Args:
            latitude: Degrees.
            longitude: Degrees.
            height: Height above the ellipsoid, m.
            axes: (3, 3) from the coordinates to metres east, north and up; None if they are these.
        """
        turn = local_axes(latitude, longitude).T
        turn = turn if axes is None else turn @ float64_array("axes", axes, (3, 3))
        return cls.of(turn, earth_centred([(latitude, longitude, height)])[0])

    @classmethod
    def parsed(cls, text: object) -> Earth | None:
        """Return the map that `str` wrote; None for None.

        Raises:
            ArgumentError: it is malformed.
        """
        if text is None:
            return None
        crs, *words = str(text).split()[:14] or [""]
        try:
            return cls(crs, tuple(map(float, words)))
        except ValueError:
            raise ArgumentError("place on earth: has to be a code and 12 numbers; remove it") from None

    def __str__(self) -> str:
        """Return the system and the numbers, separated by spaces, as files store them."""
        return " ".join([self.crs, *map(repr, self.matrix)])

    @property
    def rows(self) -> Float64[np.ndarray, "3 4"]:
        """(3, 4) the matrix (A | b)."""
        return np.array(self.matrix).reshape(3, 4)

    def after(self, inverse: ArrayLike) -> Earth:
        """Return the map of coordinates that are first taken back by the inverse of a move.

        Args:
            inverse: (4, 4) from the new coordinates to those of this map.
        """
        rows = self.rows @ float64_array("inverse", inverse, (4, 4))
        return replace(self, matrix=tuple(rows.ravel().tolist()))

    def place_of(self, position: ArrayLike) -> str:
        """Return in words where a position is.

        Args:
            position: (3,) coordinates with the origin added.
        """
        rows = self.rows
        place = rows[:, :3] @ float64_array("position", position, (3,)) + rows[:, 3]
        if self.crs != EARTH_CENTRED:
            x, y, z = place.tolist()
            return f"{x:.2f} east, {y:.2f} north, {z:.2f} up in {self.crs}"
        latitude, longitude, height = geodetic(place)
        return f"{latitude:.6f}, {longitude:.6f} degrees, {height:.1f} m above the ellipsoid (WGS 84)"


def code_of(described: str) -> str | None:
    """Return the code of a system that is given by its code or its well-known text; None if it has none.

    Args:
        described: The system.
    """
    text = described.strip()
    if CODE.fullmatch(text):
        return text
    found = LAST_CODE.search(text)
    return f"{found[1]}:{found[2]}" if found else None


def earth_centred(places: ArrayLike) -> Float64[np.ndarray, "n 3"]:
    """Convert places to earth-centred coordinates, m.

    Args:
        places: (n, 3) latitude and longitude in degrees, and height above the ellipsoid in m.
    """
    latitude, longitude, height = np.array(places, dtype=np.float64).T
    phi, lam = np.radians(latitude), np.radians(longitude)
    across = SEMI_MAJOR / np.sqrt(1.0 - SQUARED_ECCENTRICITY * np.sin(phi) ** 2)
    flat = (across + height) * np.cos(phi)
    up = (across * (1.0 - SQUARED_ECCENTRICITY) + height) * np.sin(phi)
    return np.stack([flat * np.cos(lam), flat * np.sin(lam), up], axis=1)


def geodetic(place: ArrayLike) -> tuple[float, float, float]:
    """Return latitude and longitude, degrees, and height above the ellipsoid, m, of earth-centred coordinates.

    Bowring's formula for latitude is exact to 1e-9 degrees near the surface.

    Args:
        place: (3,) m.
    """
    x, y, z = float64_array("place", place, (3,)).tolist()
    flat, b = float(np.hypot(x, y)), SEMI_MAJOR * (1.0 - FLATTENING)
    reduced = np.arctan2(z * SEMI_MAJOR, flat * b)
    second = (SEMI_MAJOR**2 - b**2) / b**2
    up = z + second * b * np.sin(reduced) ** 3
    phi = float(np.arctan2(up, flat - SQUARED_ECCENTRICITY * SEMI_MAJOR * np.cos(reduced) ** 3))
    across = SEMI_MAJOR * np.sqrt(1.0 - SQUARED_ECCENTRICITY * np.sin(phi) ** 2)
    height = flat * np.cos(phi) + z * np.sin(phi) - across
    return float(np.degrees(phi)), float(np.degrees(np.arctan2(y, x))), float(height)


def local_axes(latitude: float, longitude: float) -> Float64[np.ndarray, "3 3"]:
    """Return the rotation from earth-centred axes to east, north and up at a place.

    Args:
        latitude: Degrees.
        longitude: Degrees.
    """
    a, b = np.radians(latitude), np.radians(longitude)
    return np.array(
        [
            [-np.sin(b), np.cos(b), 0.0],
            [-np.sin(a) * np.cos(b), -np.sin(a) * np.sin(b), np.cos(a)],
            [np.cos(a) * np.cos(b), np.cos(a) * np.sin(b), np.sin(a)],
        ]
    )
