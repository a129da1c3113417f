"""A rolling shutter, and motion blur: the camera moves while its rows are read, and while each is exposed.

At time tau, 0 for the first row and 1 after the last, the camera has the rotation C(w (tau - 1/2)) R and the centre
eye + V (tau - 1/2). C is Cayley's map: with h = w (tau - 1/2) / 2,

    C p = p + f (h x p + h x (h x p)),  f = 2 / (1 + |h|²)

It turns by 2 atan |h|, which is |w (tau - 1/2)| up to the third order, without trigonometric functions.

Each row is exposed for the fraction e of the readout's time, and tau is the middle of its exposure. A point moves by b
px meanwhile (`gsplat_edu.scene.sight`); its ellipse gets b b' / 12, the variance of a uniform motion. A global shutter
is the readout "none": tau is 1/2 for all pixels, and w, V and e refer to any one unit of time.

Source: Cayley 1846 for the map; the readout as in the literature on rolling shutters (Hedborg et al. 2012).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.base.validation import ArrayLike, float64_array, in_range, one_of

READOUTS = ("down", "up", "right", "left")
"""The directions in which an image is read: rows from the top or the bottom, columns from the left or the right."""

AT_ONCE = "none"
"""The readout of a global shutter: all pixels are exposed at the same time."""

MOTION_NUMBERS = 6
"""Numbers of a rolling shutter's motion: turn and shift."""

LARGEST_TURN = 1.0
"""Largest turn during the readout and during an exposure, radians; a faster one is an error of the data."""


@dataclass(frozen=True, eq=False)
class RollingShutter:
    """How a camera moves from the beginning to the end of the readout.

    Args:
        turn: (3,) w: turn about the camera's own axes, radians in the whole readout.
        shift: (3,) V: shift of the centre, world axes, world units in the whole readout.
        readout: One of `READOUTS`, or `AT_ONCE`: then turn and shift are those in a unit of time.
        exposure: Time for which a pixel is exposed, as a fraction of the readout's time (or in that unit), at least 0.
            It may exceed 1. 0 for no motion blur.

    Raises:
        ShapeError: a vector is not of shape (3,).
        ArgumentError: a number is NaN or infinite, the camera turns by more than a radian in the readout or in an
            exposure, the exposure is negative, or the readout is unknown.
    """

    turn: Float64[np.ndarray, "3"]
    shift: Float64[np.ndarray, "3"]
    readout: str = "down"
    exposure: float = 0.0

    def __init__(
        self, turn: ArrayLike, shift: ArrayLike, readout: str = "down", exposure: float = 0.0
    ) -> None:
        one_of("readout", readout, (*READOUTS, AT_ONCE))
        exposure = in_range("exposure", exposure, 0.0)
        values = {
            name: float64_array(name, value, (3,)).copy()
            for name, value in (("turn", turn), ("shift", shift))
        }
        largest = np.abs(values["turn"]).max()  # compared first: the square of a huge number overflows
        if largest > LARGEST_TURN or np.linalg.norm(values["turn"]) > LARGEST_TURN:
            raise ArgumentError(
                "turn: is more than a radian in one readout; give radians per readout, not per second"
            )
        if exposure * np.linalg.norm(values["turn"]) > LARGEST_TURN:
            raise ArgumentError(
                "exposure: the camera turns by more than a radian in one exposure; give a fraction of the readout"
            )
        for name, vector in values.items():
            vector.flags.writeable = False
            object.__setattr__(self, name, vector)
        object.__setattr__(self, "readout", readout)
        object.__setattr__(self, "exposure", exposure)

    @property
    def axis(self) -> int:
        """0 if columns are read one after the other, 1 if rows are."""
        return readout_axis(self.readout)

    def times(self, H: int, W: int) -> Float64[np.ndarray, "H W"]:
        """Return tau - 1/2 of every pixel of an image of this size."""
        return readout_times(self.readout, H, W)

    def rotation(self, time: float) -> Float64[np.ndarray, "3 3"]:
        """Return C(w time) of a tau - 1/2."""
        h = 0.5 * time * self.turn
        cross = np.array([[0.0, -h[2], h[1]], [h[2], 0.0, -h[0]], [-h[1], h[0], 0.0]])
        turned: Float64[np.ndarray, "3 3"] = np.eye(3) + 2.0 / (1.0 + h @ h) * (cross + cross @ cross)
        return turned


def readout_times(readout: str, H: int, W: int) -> Float64[np.ndarray, "H W"]:
    """Return tau - 1/2 of every pixel of an image of this size."""
    axis, size = readout_axis(readout), (W, H)[readout_axis(readout)]
    places = (np.arange(size) - (size - 1) / 2) * readout_pace(readout, H, W)
    return np.broadcast_to(places[None, :] if axis == 0 else places[:, None], (H, W))


def readout_axis(readout: str) -> int:
    """Return 0 if columns are read one after the other, 1 if rows are."""
    return 0 if readout in ("right", "left") else 1


def readout_pace(readout: str, H: int, W: int) -> float:
    """Return the derivative of tau by the column or row, 1/px: negative if the last one is read first, 0 for `AT_ONCE`.

    tau - 1/2 is this times the distance from the image's middle, (W - 1) / 2 or (H - 1) / 2.
    """
    if readout == AT_ONCE:
        return 0.0
    return (-1.0 if readout in ("up", "left") else 1.0) / (H if readout_axis(readout) else W)
