"""Where on earth a scene is: an affine map from its coordinates to a coordinate reference system in metres.

    place = A (coordinates + origin) + b

Earth-centred coordinates (EPSG:4978) are those of GPS: x towards 0 N 0 E, y towards 0 N 90 E, z towards the north pole.
With a projected system, such as EPSG:32633, the places are easting, northing and height. `converted` takes places from
one system to another by PROJ (the package pyproj, which only projected systems need).

Source: NIMA TR8350.2 for the ellipsoid; Bowring 1985 for latitude and height from earth-centred coordinates.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float64

from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.base.text import install_command
from gsplat_edu.base.validation import ArrayLike, float64_array
from gsplat_edu.scene.frame import FARTHEST_ORIGIN

SEMI_MAJOR, FLATTENING = 6_378_137.0, 1.0 / 298.257223563
"""The ellipsoid of GPS, m (WGS 84). On a sphere, distances would be wrong by up to 0.5 %."""

SQUARED_ECCENTRICITY = FLATTENING * (2.0 - FLATTENING)

EARTH_CENTRED = "EPSG:4978"
"""The system of earth-centred coordinates of WGS 84."""

NEAR_SURFACE = 50_000.0
"""Positions this close to the ellipsoid, m, are taken to be earth-centred coordinates."""

STEP = 10.0
"""Metres over which the derivatives of a conversion between systems are taken."""

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

    def on_globe(self, position: ArrayLike) -> Earth:
        """Return the map to earth-centred coordinates that agrees with this one at a position, and in its derivatives.

        A projected system follows the ellipsoid, which the map cannot: d metres away, it errs by d² / (2 SEMI_MAJOR) in
        height, which is 8 cm at 1 km.

        Args:
            position: (3,) coordinates with the origin added.

        Raises:
            ArgumentError: as for `converted`.
        """
        if self.crs == EARTH_CENTRED:
            return self
        A, b = self.rows[:, :3], self.rows[:, 3]
        place = A @ float64_array("position", position, (3,)) + b
        around = STEP * np.concatenate([np.zeros((1, 3)), np.eye(3), -np.eye(3)])
        found = converted(place + around, self.crs, EARTH_CENTRED)
        derivative = (found[1:4] - found[4:]).T / (2.0 * STEP)
        return Earth.of(derivative @ A, found[0] + derivative @ (b - place))

    def positions_of(self, places: ArrayLike, crs: str) -> Float64[np.ndarray, "n 3"]:
        """Return the coordinates of places, with the origin added: the inverse of this map.

        Args:
            places: (n, 3), as for `converted`.
            crs: The code of their system.

        Raises:
            ArgumentError: as for `converted`, or the map has no inverse.
        """
        A, b = self.rows[:, :3], self.rows[:, 3]
        try:
            back = np.linalg.inv(A)
        except np.linalg.LinAlgError:
            raise ArgumentError("matrix: is singular; give another place on earth") from None
        found: Float64[np.ndarray, "n 3"] = (converted(places, crs, self.crs) - b) @ back.T
        return found

    def place_of(self, position: ArrayLike) -> str:
        """Return in words where a position is.

        Args:
            position: (3,) coordinates with the origin added.
        """
        rows = self.rows
        place = rows[:, :3] @ float64_array("position", position, (3,)) + rows[:, 3]
        if self.crs != EARTH_CENTRED:
            x, y, z = place.tolist()
            said = f"{x:.2f} east, {y:.2f} north, {z:.2f} up in {self.crs}"
            try:
                latitude, longitude, _ = geodetic(converted(place[None], self.crs, EARTH_CENTRED)[0])
            except ArgumentError:
                return said
            return f"{said}: {latitude:.6f}, {longitude:.6f} degrees"
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


def converted(places: ArrayLike, source: str, target: str) -> Float64[np.ndarray, "n 3"]:
    """Convert places from one system to another by PROJ.

    Heights of a system without any are taken as heights above its ellipsoid.

    Args:
        places: (n, 3) in the order east, north, up; x, y, z of earth-centred systems.
        source: The system's code.
        target: The code of the other system.

    Returns:
        (n, 3) places in the other system; infinity or NaN for those outside of a system.

    Raises:
        ArgumentError: pyproj is not installed, does not know a system or a grid between the two, or all places are
            outside.
    """
    try:
        import pyproj
    except ImportError:
        raise ArgumentError(
            f"{source}: needs pyproj, which is not installed: {install_command('scans')}"
        ) from None
    try:
        first, second = (pyproj.CRS.from_user_input(code).to_3d() for code in (source, target))
        transformer = pyproj.Transformer.from_crs(first, second, always_xy=True, allow_ballpark=False)
        found = np.stack(transformer.transform(*np.asarray(places, dtype=np.float64).T), axis=1)
    except pyproj.exceptions.CRSError:
        raise ArgumentError(f"{source}: PROJ does not know it, or not {target}; give another code") from None
    except pyproj.exceptions.ProjError:
        found = np.full((1, 3), np.nan)
    if not np.isfinite(found).all(axis=1).any():
        raise ArgumentError(
            f"{source}: PROJ cannot convert its places to {target}: they lie outside, or heights need a grid that is"
            " not installed; give a system without heights"
        )
    return found


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
