"""Boxes and colours of the procedural city: facades with windows, roofs, streets, pavements and parks.

All patterns come from an integer hash, so that every machine paints the same city.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64, Int64

Rows = Float64[np.ndarray, "N 3"]
Numbers = Float64[np.ndarray, " N"]

PITCH = 6.0
"""Distance between the centre lines of two streets, world units."""

STREET = 0.7
"""Half the width of a street."""

PAVEMENT = 0.3
"""Width of a pavement."""

PARKS = 0.15
"""Fraction of the lots that are parks."""

WALLS = np.array(
    [
        [0.72, 0.33, 0.26],
        [0.80, 0.70, 0.52],
        [0.55, 0.58, 0.62],
        [0.85, 0.82, 0.76],
        [0.42, 0.47, 0.36],
        [0.62, 0.45, 0.34],
        [0.35, 0.45, 0.60],
        [0.78, 0.60, 0.35],
    ]
)
"""Colours of walls."""

ROOFS = np.array([[0.55, 0.25, 0.2], [0.38, 0.38, 0.4], [0.62, 0.6, 0.56], [0.3, 0.36, 0.34]])
"""Colours of roofs."""


@dataclass(frozen=True, eq=False)
class Buildings:
    """The boxes of a city.

    Args:
        places: (B, 2) centres on the ground, x and z.
        halves: (B, 3) half width along x, height, half width along z.
        turns: (B,) turns about the vertical, radians.
        tree: (B,) whether a box is a tree.
        seed: Seed of the patterns.
    """

    places: Float64[np.ndarray, "B 2"]
    halves: Float64[np.ndarray, "B 3"]
    turns: Float64[np.ndarray, " B"]
    tree: Bool[np.ndarray, " B"]
    seed: int

    @classmethod
    def drawn(cls, reach: int, seed: int) -> Buildings:
        """Draw the boxes.

        Args:
            reach: Lots on each side of the centre.
            seed: Seed of the city.
        """
        rng = np.random.default_rng([seed, 0])
        rows: list[tuple[float, ...]] = []
        for i in range(-reach, reach):
            for j in range(-reach, reach):
                corner = np.array([i, j]) * PITCH + STREET + PAVEMENT
                rows += (
                    _park(corner, rng)
                    if _is_park(np.array([float(i)]), np.array([float(j)]), seed)[0]
                    else _lot(corner, rng)
                )
        table = np.array(rows)
        return cls(table[:, :2], table[:, 2:5], table[:, 5], table[:, 6] > 0, seed)

    def box(self, number: int) -> tuple[tuple[float, float], tuple[float, ...], float]:
        """Return place, half widths and height, and turn of a box, as the ray tracer takes them."""
        x, z = self.places[number].tolist()
        return (x, z), tuple(self.halves[number].tolist()), float(self.turns[number])

    def corners(self) -> Float64[np.ndarray, "B 8 3"]:
        """Return the corners of all boxes, world units."""
        signs = np.array([[a, b, c] for a in (-1, 1) for b in (0, -1) for c in (-1, 1)], dtype=np.float64)
        own = signs * self.halves[:, None]
        c, s = np.cos(self.turns)[:, None], np.sin(self.turns)[:, None]
        x = self.places[:, :1] + c * own[..., 0] - s * own[..., 2]
        z = self.places[:, 1:] + s * own[..., 0] + c * own[..., 2]
        return np.stack([x, own[..., 1], z], axis=-1)


def facade_colors(
    hits: Rows,
    normals: Rows,
    owner: Int64[np.ndarray, " N"],
    buildings: Buildings,
    sun: Float64[np.ndarray, "3"],
) -> Rows:
    """Return the colours of places on boxes.

    Args:
        hits: (N, 3) the places.
        normals: (N, 3) unit normals there.
        owner: (N,) numbers of the boxes.
        buildings: The boxes.
        sun: (3,) unit direction towards the sun.
    """
    turn = buildings.turns[owner]
    c, s = np.cos(turn), np.sin(turn)
    away = hits[:, [0, 2]] - buildings.places[owner]
    x, z = c * away[:, 0] + s * away[:, 1], -s * away[:, 0] + c * away[:, 1]
    own_x = np.abs(c * normals[:, 0] + s * normals[:, 2])
    roof = normals[:, 1] < -0.5
    along, high = np.where(own_x > 0.5, z, x), -hits[:, 1]
    number = owner + 1009 * buildings.seed
    walls = _wall(along + 50 * (own_x > 0.5), high, number)
    tops = _roof(x, z, number)
    leaves = np.array([0.2, 0.38, 0.15]) * (0.6 + 0.9 * _speckle(9 * x, 9 * z + 31 * high, 77))[:, None]
    paint = np.where(roof[:, None], tops, walls)
    paint = np.where(buildings.tree[owner][:, None], leaves, paint)
    light = 0.58 + 0.42 * np.clip(normals @ sun, 0, 1)
    shade = 1 - 0.3 * np.exp(-high / 0.25)  # the sky lights the foot of a wall less
    return np.asarray(paint * (light * shade)[:, None])


def ground_colors(hits: Rows, buildings: Buildings) -> Rows:
    """Return the colours of places on the ground.

    Args:
        hits: (N, 3) the places.
        buildings: The boxes, whose lots and seed the ground shares.
    """
    x, z = hits[:, 0], hits[:, 2]
    seed = buildings.seed
    i, j = np.floor(x / PITCH), np.floor(z / PITCH)
    # distance from the nearest street's centre line, along each axis
    to_x, to_z = np.abs(x - PITCH * np.round(x / PITCH)), np.abs(z - PITCH * np.round(z / PITCH))
    street = (to_x < STREET) | (to_z < STREET)
    pavement = ~street & ((to_x < STREET + PAVEMENT) | (to_z < STREET + PAVEMENT))
    park = _is_park(i, j, seed)
    rough = _noise(2.2 * x, 2.2 * z, 3 + seed)[:, None]
    fine = _speckle(7 * x, 7 * z, 5 + seed)[:, None]
    color = np.array([0.45, 0.42, 0.38]) * (0.65 + 0.5 * rough + 0.2 * fine)  # courtyards
    lawn = np.array([0.3, 0.45, 0.2]) * (0.5 + 0.7 * rough + 0.3 * fine)
    path = np.abs((x - PITCH * i) - (z - PITCH * j) + 0.6 * np.sin(z)) < 0.25
    lawn = np.where(path[:, None], np.array([0.7, 0.62, 0.48]) * (0.8 + 0.3 * fine), lawn)
    color = np.where(park[:, None], lawn, color)
    slabs = 0.75 + 0.35 * _speckle(4 * x, 4 * z, 11 + seed)[:, None]
    color = np.where(pavement[:, None], np.array([0.66, 0.64, 0.6]) * slabs, color)
    asphalt = np.array([0.27, 0.27, 0.29]) * (0.7 + 0.45 * rough + 0.25 * fine)
    color = np.where(street[:, None], asphalt, color)
    crossing = (to_x < STREET) & (to_z < STREET)
    dashed = ((to_x < 0.06) & (np.mod(z, 0.9) < 0.5)) | ((to_z < 0.06) & (np.mod(x, 0.9) < 0.5))
    stripes = ((to_x < STREET) & (to_z > 0.8) & (to_z < 1.3) & (np.mod(x, 0.3) < 0.15)) | (
        (to_z < STREET) & (to_x > 0.8) & (to_x < 1.3) & (np.mod(z, 0.3) < 0.15)
    )
    return np.asarray(np.where(((dashed & ~crossing & street) | stripes)[:, None], 0.86, color))


def _wall(along: Numbers, high: Numbers, number: Int64[np.ndarray, " N"]) -> Rows:
    """Paint walls: windows in floors and columns, on plaster or on courses of stone."""
    wide, tall = 0.32 + 0.22 * _hash(number, 1), 0.4 + 0.25 * _hash(number, 2)
    column, floor = np.floor(along / wide), np.floor(high / tall)
    in_column, in_floor = along / wide - column, high / tall - floor
    window = (np.abs(in_column - 0.5) < 0.3) & (in_floor > 0.25) & (in_floor < 0.8)
    ribbon = _hash(number, 3) < 0.25  # offices with windows all along
    window = np.where(ribbon, (in_floor > 0.3) & (in_floor < 0.75), window)
    glass = _hash(column.astype(np.int64) + 4099 * floor.astype(np.int64) + 131 * number, 4)
    panes = np.array([0.18, 0.25, 0.34]) + glass[:, None] * np.array([0.5, 0.45, 0.3])
    plaster = WALLS[np.floor(len(WALLS) * _hash(number, 5)).astype(int)]
    stain = _noise(1.7 * along, 0.9 * high, 13)[:, None]
    stones = _speckle(along / 0.3, high / 0.15, 17)[:, None]
    base = plaster * (0.72 + 0.35 * stain + 0.16 * stones)
    return np.asarray(np.where(window[:, None], panes, base))


def _roof(x: Numbers, z: Numbers, number: Int64[np.ndarray, " N"]) -> Rows:
    """Paint roofs: tiles in rows, patches, and a few dark vents."""
    color = ROOFS[np.floor(len(ROOFS) * _hash(number, 6)).astype(int)]
    patches = _noise(1.9 * x, 1.9 * z, 19)[:, None]
    tiles = _speckle(x / 0.22, z / 0.22, 23)[:, None]
    vents = _speckle(x / 0.35, z / 0.35, 29)[:, None] > 0.92
    return np.asarray(np.where(vents, 0.15, color * (0.65 + 0.45 * patches + 0.3 * tiles)))


def _lot(corner: Float64[np.ndarray, "2"], rng: np.random.Generator) -> list[tuple[float, ...]]:
    """Draw one, two or four buildings on a lot."""
    side = PITCH - 2 * (STREET + PAVEMENT)
    cuts = [(1, 1), (1, 2), (2, 1), (2, 2), (2, 2)][rng.integers(5)]
    turn, rows = rng.uniform(-0.06, 0.06), []
    for a in range(cuts[0]):
        for b in range(cuts[1]):
            room = np.array([side / cuts[0], side / cuts[1]])
            centre = corner + room * (np.array([a, b]) + 0.5)
            halves = 0.5 * room * rng.uniform(0.68, 0.88, 2)
            tall = rng.uniform(3.2, 4.8) if rng.uniform() < 0.12 else rng.uniform(0.8, 2.6)
            rows.append((*centre, halves[0], tall, halves[1], turn, 0.0))
    return rows


def _park(corner: Float64[np.ndarray, "2"], rng: np.random.Generator) -> list[tuple[float, ...]]:
    """Draw the trees of a park."""
    side = PITCH - 2 * (STREET + PAVEMENT)
    return [
        (
            *(corner + rng.uniform(0.3, side - 0.3, 2)),
            wide,
            rng.uniform(0.5, 1.1),
            wide,
            rng.uniform(0, 1.5),
            1.0,
        )
        for wide in rng.uniform(0.15, 0.35, rng.integers(4, 9))
    ]


def _is_park(i: Numbers, j: Numbers, seed: int) -> Bool[np.ndarray, " N"]:
    return np.asarray(_hash(i.astype(np.int64) * 7919 + j.astype(np.int64) * 104_729 + seed, 8) < PARKS)


def _hash(numbers: Int64[np.ndarray, " N"], salt: int) -> Numbers:
    """Return a number from 0 to 1 for each whole number: two rounds of multiply and shift on 32 bits."""
    h = (numbers.astype(np.int64) * 374_761_393 + salt * 668_265_263).astype(np.uint32)
    for factor in (np.uint32(2_246_822_519), np.uint32(3_266_489_917)):
        h = (h ^ (h >> np.uint32(15))) * factor
    return np.asarray((h ^ (h >> np.uint32(13))).astype(np.float64) / 2.0**32)


def _speckle(u: Numbers, v: Numbers, salt: int) -> Numbers:
    """Return a number from 0 to 1 for the unit square that each place lies in."""
    return _hash(np.floor(u).astype(np.int64) * 15_731 + np.floor(v).astype(np.int64) * 789_221, salt)


def _noise(u: Numbers, v: Numbers, salt: int) -> Numbers:
    """Return smooth noise from 0 to 1: the numbers of the surrounding squares, mixed."""
    left, low = np.floor(u), np.floor(v)
    a, b = u - left, v - low
    a, b = a * a * (3 - 2 * a), b * b * (3 - 2 * b)
    one, other = (
        (1 - a) * _speckle(left, low + k, salt) + a * _speckle(left + 1, low + k, salt) for k in (0, 1)
    )
    return np.asarray((1 - b) * one + b * other)
