"""LAS and LAZ: the centres of the splats as a point cloud, for programs of surveyors and architects. Written only.

A point has the colour of degree 0 in 16 bits per channel, and the opacity as its intensity: 65,535 is 1. Splats with an
opacity below `LEAST_OPACITY` are left out. Files are LAS 1.4 with points of format 7, of 36 bytes; LAZ is compressed.

    coordinate = step integer + offset

If the scene's place on earth is known, coordinates are places in its system, whose well-known text the file has.
Earth-centred places become east, north and height above the ellipsoid in their zone of UTM, because programs take the
third coordinate for the height. Otherwise coordinates are the scene's own, with the origin added, and are not turned.

Source: ASPRS LAS 1.4 R15.
"""

from __future__ import annotations

import importlib.util
import math
from datetime import date
from pathlib import Path
from typing import NoReturn

import numpy as np
from jaxtyping import Bool, Float64, UInt16
from torch import Tensor

from gsplat_edu.base.constants import C0, SH_OFFSET
from gsplat_edu.base.errors import ArgumentError, SceneFormatError
from gsplat_edu.base.files import written_aside
from gsplat_edu.base.text import install_command
from gsplat_edu.io.scene import Scene
from gsplat_edu.scene.earth import EARTH_CENTRED, Earth, converted, geodetic
from gsplat_edu.scene.gaussians import Gaussians

LEAST_OPACITY = 0.05
"""Fainter splats are no points: they are haze, not surfaces. A training starts at 0.1."""

FULL = 65535.0
"""Full brightness of a channel, and the intensity of an opacity of 1."""

LARGEST = float(2**31 - 1)
"""The largest integer of a coordinate."""

COARSEST = -4
"""Exponent of the usual step: 0.1 mm if the unit is a metre. Only integers that are too large make it coarser."""

DIGITS = 6
"""Smaller scenes have this many digits behind the first."""

SMALLEST_REACH = 1e-3
"""Smaller scenes have the step of this one, so that an offset in double resolves it."""

UTM_NORTH, UTM_SOUTH = 32600, 32700
"""EPSG's numbers of the zones of UTM on WGS 84, less the zone."""

WRITTEN = date(2000, 1, 1)
"""The file's date: constant, so that the same scene gives the same bytes."""


def read(path: Path) -> NoReturn:
    """Refuse the file.

    Raises:
        SceneFormatError: a point cloud is no scene.
    """
    raise SceneFormatError(f"{path}: is a point cloud, not a scene; give it to a training as `points`")


def write(path: Path, scene: Scene) -> None:
    """Write the centres of the splats, in their order.

    Args:
        path: Output file, .las or .laz; parent folders are created.
        scene: The scene.

    Raises:
        ArgumentError: a library is not installed, no splat has `LEAST_OPACITY`, or PROJ does not know the scene's
            system.
        OSError: the file cannot be written. An existing file stays unchanged.
    """
    require_laspy(str(path))
    import laspy

    faint = _faint(scene.gaussians)
    solid = scene.gaussians.map(lambda tensor: tensor[~faint])
    if not len(solid):
        raise ArgumentError(f"{path}: no splat has an opacity of {LEAST_OPACITY}; write a format of scenes")
    places, crs = solid.means.double().numpy(force=True) + scene.origin, None
    if scene.earth is not None:
        places, crs = _places(places, scene.earth)
    header = laspy.LasHeader(point_format=7, version="1.4")
    header.creation_date, header.generating_software = WRITTEN, "gsplat_edu"
    header.offsets = np.round((places.min(axis=0) + places.max(axis=0)) / 2.0)
    header.scales = np.full(3, step_of(float(np.abs(places - header.offsets).max())))
    if crs is not None:
        header.vlrs.append(laspy.vlrs.known.WktCoordinateSystemVlr(_well_known_text(path, crs)))
        header.global_encoding.wkt = True
    cloud = laspy.LasData(header)
    cloud.x, cloud.y, cloud.z = places.T
    colors = solid.sh0[:, 0].double().numpy(force=True) * C0 + SH_OFFSET
    cloud.red, cloud.green, cloud.blue = _whole(colors).T
    cloud.intensity = _whole(solid.opacities.double().numpy(force=True))
    cloud.return_number[:] = cloud.number_of_returns[:] = 1
    with written_aside(path) as aside, aside.open("wb+") as file:
        cloud.write(file, do_compress=path.suffix.lower() == ".laz")


def require_laspy(what: str) -> None:
    """Check that laspy and pyproj are there.

    Args:
        what: What needs them, as the beginning of the message.

    Raises:
        ArgumentError: one is not installed.
    """
    if any(importlib.util.find_spec(name) is None for name in ("laspy", "pyproj")):
        raise ArgumentError(
            f"{what}: needs laspy and pyproj, which are not installed: {install_command('scans')}"
        )


def losses(path: Path, scene: Scene) -> list[str]:
    """List what a file does not have of a scene, and say where its coordinates lie, one sentence each."""
    said = [
        f"{path}: is a point cloud of the splats' centres, colours and opacities; it is no scene any more"
    ]
    if faint := int(_faint(scene.gaussians).sum()):
        some = f"{faint:,} of {len(scene.gaussians):,} splats"
        said.append(f"{path}: {some} have an opacity below {LEAST_OPACITY} and are left out")
    if scene.earth is None:
        said.append(f"{path}: coordinates are the scene's own, because its place on earth is not known")
    return said


def step_of(reach: float) -> float:
    """Return the step of the coordinates, a power of ten.

    Args:
        reach: The largest distance from the offset along an axis.
    """
    reach = max(reach, SMALLEST_REACH)
    finest = min(COARSEST, math.floor(math.log10(reach)) - DIGITS)
    return float(10.0 ** max(finest, math.ceil(math.log10(reach / LARGEST))))


def _faint(gaussians: Gaussians) -> Bool[Tensor, " N"]:
    return gaussians.opacities < LEAST_OPACITY


def _places(positions: Float64[np.ndarray, "N 3"], earth: Earth) -> tuple[Float64[np.ndarray, "N 3"], str]:
    """Return the places of positions, and their system; earth-centred ones in UTM."""
    rows = earth.rows
    places = np.einsum("ij,nj->ni", rows[:, :3], positions) + rows[:, 3]
    if earth.crs != EARTH_CENTRED:
        return places, earth.crs
    latitude, longitude, _ = geodetic(np.median(places, axis=0))
    zone = min(int((longitude + 180.0) // 6.0), 59) + 1
    crs = f"EPSG:{(UTM_NORTH if latitude >= 0.0 else UTM_SOUTH) + zone}"
    return converted(places, EARTH_CENTRED, crs), crs


def _well_known_text(path: Path, crs: str) -> str:
    """Return the description of a system: WKT 1, which the format asks for, or WKT 2 where WKT 1 has no words."""
    import pyproj

    try:
        found = pyproj.CRS.from_user_input(crs)
    except pyproj.exceptions.CRSError:
        raise ArgumentError(
            f"{path}: PROJ does not know the scene's system {crs}; write another format"
        ) from None
    return str(found.to_wkt("WKT1_GDAL") or found.to_wkt())


def _whole(values: Float64[np.ndarray, "*n"]) -> UInt16[np.ndarray, "*n"]:
    """Return values from 0 to 1 in 16 bits."""
    whole: UInt16[np.ndarray, "*n"] = np.round(FULL * np.clip(values, 0.0, 1.0)).astype(np.uint16)
    return whole
