"""Place a model: its scale and up direction from a distance that the user gives, from GPS, or by convention."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import PurePosixPath

import numpy as np
from jaxtyping import Float64

from gsplat_edu.base.constants import AUTO
from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.data.lens import Lens
from gsplat_edu.data.native_lens import native_intrinsics
from gsplat_edu.data.scale import Scale
from gsplat_edu.io.edit import Similarity
from gsplat_edu.scene.camera import Camera
from gsplat_edu.scene.earth import Earth
from gsplat_edu.sfm.align import upright
from gsplat_edu.sfm.gps import TILT, GpsFit, east_north_up, fit_positions, local_frame
from gsplat_edu.sfm.photos import PhotoFacts
from gsplat_edu.sfm.scale_text import NONE, Mark, marks_of

PARALLEL = 2.0
"""Smallest angle between two rays to a marked point, degrees. At smaller angles, an error of a pixel moves the point
far."""

MISSED = 0.01
"""Largest distance of a mark from the triangulated point, as a fraction of the photo's longer side."""

LEVEL = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
"""East, north and up become +x, +z and -y."""

NEAR = 1.0
"""Warn if the median distance of the cameras from their mean is below this, in units: renderers may clip near
splats."""


@dataclass(frozen=True, eq=False)
class Sight:
    """A photo with a pose, before the model is placed.

    Args:
        photo: The photo.
        lens: Its lens, at the size of the sensor's picture.
        R: (3, 3) world to camera, for the sensor's picture.
        eye: (3,) camera centre.
    """

    photo: PhotoFacts
    lens: Lens
    R: Float64[np.ndarray, "3 3"]
    eye: Float64[np.ndarray, "3"]

    def ray(self, mark: Mark) -> Float64[np.ndarray, "3"]:
        """Return the unit direction of a marked pixel, in the world.

        Raises:
            ArgumentError: the mark lies outside the photo, or the lens has no ray for it.
        """
        W, H = (self.photo.W, self.photo.H)[:: -1 if self.photo.turns % 2 else 1]
        if not (0.0 <= mark.x <= W and 0.0 <= mark.y <= H):
            raise ArgumentError(
                f"--scale: {_spelled(mark)} lies outside of the photo, which is {W}x{H} upright"
            )
        u, v, width, height = mark.x, mark.y, W, H
        for _ in range(self.photo.turns % 4):  # a clockwise quarter turn maps (u, v) to (height - v, u)
            u, v, width, height = v, width - u, height, width
        ray = self.R.T @ _own_ray(self.lens, u - 0.5, v - 0.5)
        if not np.isfinite(ray).all():
            raise ArgumentError(f"--scale: {_spelled(mark)} lies outside of what the lens shows")
        return np.asarray(ray / np.linalg.norm(ray))


def placed(
    cameras: Sequence[Camera],
    points: Float64[np.ndarray, "N 3"],
    sights: Sequence[Sight],
    choice: str,
    say: Callable[[str], None],
) -> tuple[Similarity, Scale | None]:
    """Choose the world of a capture.

    Args:
        cameras: The undistorted, upright cameras.
        points: (N, 3) points.
        sights: The same photos with their lenses.
        choice: "auto": scale and up from GPS if the positions fit; "none"; or two marked points and their distance.
        say: Receives what GPS gave, or why it is not used.

    Returns:
        The transform, and the scale if it is known. The origin is that of `upright` in all cases.

    Raises:
        ArgumentError: a mark cannot be used.
    """
    move = upright(cameras, points)
    if choice == NONE:
        return move, None
    if choice != AUTO:
        factor, measured = _measured(sights, choice)
        found = _rescaled(move, factor)
        _check_near(cameras, found.s, measured.unit, say)
        return found, measured
    # One entry for each place: the faces of a panorama have one centre and one position.
    there = {(sight.photo.place, *np.round(sight.eye, 9)): sight for sight in sights if sight.photo.place}
    places = [sight.photo.place for sight in there.values() if sight.photo.place]
    if len({height for _, _, height in places}) < 2:
        return move, None  # no positions, or no heights
    fit = fit_positions(np.stack([sight.eye for sight in there.values()]), east_north_up(places))
    if fit is None:
        return move, None
    if not fit.good:
        say(
            f"GPS: not used, because the positions of {len(there)} photos differ from their cameras by "
            f"{fit.residual:.3g} m (median) and spread over {fit.spread:.3g} m; the scale is arbitrary"
        )
        return move, None
    return _by_gps(move, fit, places)


def in_given_world(
    sights: Sequence[Sight], choice: str, known: Scale | None
) -> tuple[Similarity, Scale | None]:
    """Keep the world of a model that started from given poses; only marked points change it, by its unit.

    Args:
        sights: As for `placed`.
        choice: As for `placed`; "auto" keeps the known scale.
        known: The scale of the given poses, if it is known.

    Returns:
        As `placed`; the origin and the axes are those of the given poses.

    Raises:
        ArgumentError: a mark cannot be used.
    """
    kept = Similarity(np.eye(3), 1.0, np.zeros(3))
    if choice in (AUTO, NONE):
        return kept, known if choice == AUTO else None
    factor, scale = _measured(sights, choice)
    return _rescaled(kept, factor), scale


def _measured(sights: Sequence[Sight], choice: str) -> tuple[float, Scale]:
    """Return the factor that gives two marked points their distance, and the scale.

    Raises:
        ArgumentError: a mark cannot be used.
    """
    given = marks_of(choice)
    a, b = (_point(letter, marks, sights) for letter, marks in (("A", given.a), ("B", given.b)))
    apart = float(np.linalg.norm(a[0] - b[0]))
    if apart == 0.0:
        raise ArgumentError("--scale: A and B are one point")
    detail = f"{given.length:g} {given.unit} between two points, marks off by {max(a[1], b[1]):.1f} px"
    return given.length / apart, Scale(given.unit, "a given distance", detail)


def _by_gps(
    move: Similarity, fit: GpsFit, places: Sequence[tuple[float, float, float]]
) -> tuple[Similarity, Scale]:
    """Take the scale, and up and the place on earth if up is determined, from a fit of GPS positions."""
    level = bool(fit.tilt <= TILT)
    count, total = int(fit.inside.sum()), len(fit.inside)
    detail = (
        f"{count} of {total} positions agree, median residual {fit.residual:.3g} m over {fit.spread:.3g} m"
    )
    detail += f", scale +-{100 * max(fit.error, 1e-4):.2g} %"
    detail += "; up from GPS, +z is north" if level else "; up from the cameras"
    found, earth = _rescaled(move, fit.move.s), None
    if level:
        origin = -move.R.T @ move.t / move.s  # the point that `upright` moves to the origin
        R = LEVEL @ fit.move.R
        found = Similarity(R, fit.move.s, -fit.move.s * R @ origin)
        axes, middle = local_frame(places)
        zero = fit.move.s * fit.move.R @ origin + fit.move.t  # east, north and up of the new zero
        earth = Earth.of(axes.T @ LEVEL.T, middle + axes.T @ zero)
    return found, Scale("m", "GPS", detail, level, earth)


def _rescaled(move: Similarity, s: float) -> Similarity:
    """Return the similarity with another scale that maps the same point to zero."""
    return Similarity(move.R, s, move.t * (s / move.s))


def _point(
    letter: str, marks: Sequence[Mark], sights: Sequence[Sight]
) -> tuple[Float64[np.ndarray, "3"], float]:
    """Find the point with the least squared distance from the rays of its marks; and how far it is from them, px.

    Raises:
        ArgumentError: a photo has no pose, or the rays do not determine the point or do not meet.
    """
    from_ = [_sight(mark, sights) for mark in marks]
    rays = [sight.ray(mark) for sight, mark in zip(from_, marks, strict=True)]
    widest = max(np.degrees(np.arccos(np.clip(a @ b, -1, 1))) for a in rays for b in rays)
    if widest < PARALLEL:
        raise ArgumentError(
            f"--scale: the rays to point {letter} meet at {widest:.1f} degrees, too few to find it; mark it in photos "
            "from places farther apart"
        )
    across = [np.eye(3) - np.outer(ray, ray) for ray in rays]
    centres = [sight.eye for sight in from_]
    point = np.linalg.solve(
        np.sum(across, axis=0), np.sum([P @ c for P, c in zip(across, centres, strict=True)], axis=0)
    )
    worst = 0.0
    for sight, ray in zip(from_, rays, strict=True):
        to = point - sight.eye
        ahead = float(to @ ray)
        off = sight.lens.fx * float(np.linalg.norm(to - ahead * ray)) / max(ahead, 1e-12)
        worst = max(worst, off)
        if ahead <= 0.0 or off > MISSED * max(sight.photo.W, sight.photo.H):
            what = "behind the camera" if ahead <= 0.0 else f"{off:.0f} px away from its mark"
            raise ArgumentError(
                f"--scale: the rays to point {letter} do not meet: in {sight.photo.name} it is {what}; check that all "
                "marks show the same point, in pixels of the upright photo"
            )
    return np.asarray(point), worst


def _sight(mark: Mark, sights: Sequence[Sight]) -> Sight:
    """Find the photo of a mark, by its name, with or without folders and ending.

    Raises:
        ArgumentError: none has a pose, or several fit.
    """

    def names(photo: PhotoFacts) -> tuple[str, ...]:
        path = PurePosixPath(photo.name)
        return photo.name, path.name, str(path.with_suffix("")), path.stem

    for kind in range(4):
        found = [sight for sight in sights if names(sight.photo)[kind] == mark.photo]
        if len(found) == 1:
            return found[0]
        if found:
            raise ArgumentError(f"--scale: {mark.photo} is the name of {len(found)} photos; give its folder")
    wanted = PurePosixPath(mark.photo).stem  # the capture's copy may have another ending
    found = [sight for sight in sights if PurePosixPath(sight.photo.name).stem == wanted]
    if len(found) != 1:
        raise ArgumentError(f"--scale: {mark.photo}: no photo of this name has a pose")
    return found[0]


def _check_near(cameras: Sequence[Camera], s: float, unit: str, say: Callable[[str], None]) -> None:
    """Warn if distances are so small in these units that renderers may clip what is in front of the cameras."""
    eyes = np.stack([camera.eye for camera in cameras])
    spread = s * float(np.median(np.linalg.norm(eyes - eyes.mean(axis=0), axis=1)))
    if spread < NEAR and unit != "mm":
        smaller = "cm" if unit == "m" else "mm"
        say(
            f"the cameras are {spread:.2g} {unit} from their mean, and renderers clip splats nearer than 0.2 "
            f"units; give the distance in {smaller}, so that a unit is 1 {smaller}"
        )


def _own_ray(lens: Lens, u: float, v: float) -> Float64[np.ndarray, "3"]:
    """Return the ray of a pixel in camera axes, of any length; NaN if there is none."""
    own = native_intrinsics(lens) if lens.wide else None
    if own is not None:
        camera = Camera.posed(np.eye(3), np.zeros(3), own)
        place = np.array([(u - own.cx) / own.fx]), np.array([(v - own.cy) / own.fy])
        return np.asarray(camera.projection.directions(*place, camera.widest)[0])
    x, y = lens.rays(np.array([u]), np.array([v]))[:, 0]
    return np.array([x, y, 1.0])


def _spelled(mark: Mark) -> str:
    return f"{mark.photo}:{mark.x:g},{mark.y:g}"
