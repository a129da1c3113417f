"""Poses in the Open Photogrammetry Format (OPF) of Pix4D.

calibrated_cameras.json has poses and lenses, camera_list.json beside it the photos. Omega, phi and kappa, degrees, make
the camera-to-world rotation Rx(omega) Ry(phi) Rz(kappa) of cameras that look along -z, with +y up. The principal
point is measured from the photo's corner, px; the coefficients are OpenCV's. scene_reference_frame.json, if there is
one, names a coordinate reference system, and how the scene's coordinates come from it.

Source: the OPF specification 1.0, "Calibrated camera format", "Camera list" and "Scene reference frame"; Pix4D's
support, article 202559089, on the parameters of cameras.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from urllib.parse import unquote

import numpy as np

from gsplat_edu.base.errors import DatasetError
from gsplat_edu.base.records import Number, Text
from gsplat_edu.base.text import printable, shortened
from gsplat_edu.data.capture import entries, is_file
from gsplat_edu.data.lens import Lens
from gsplat_edu.data.readers.bundler import OPENGL
from gsplat_edu.data.readers.pose_file import (
    AGAIN,
    Foreign,
    PoseProgram,
    Poses,
    Shot,
    Triple,
    head_of,
    json_of,
    no_lens,
    sized,
)
from gsplat_edu.data.readers.realitycapture import turn
from gsplat_edu.photos.decoding import image_size
from gsplat_edu.scene.earth import Earth, code_of

CALIBRATED, LIST = b"application/opf-calibrated-cameras+json", b"application/opf-camera-list+json"

REFERENCE = b"application/opf-scene-reference-frame+json"


class Internals(Foreign, frozen=True):
    """A lens; those of other types than "perspective" have other fields, too."""

    type: str
    principal_point_px: tuple[Number, Number]
    focal_length_px: Number | None = None
    radial_distortion: Triple = (0.0, 0.0, 0.0)
    tangential_distortion: tuple[Number, Number] = (0.0, 0.0)


class Sensor(Foreign, frozen=True):
    """A sensor."""

    id: int
    internals: Internals


class CalibratedCamera(Foreign, frozen=True):
    """A pose."""

    id: int
    sensor_id: int
    position: Triple
    orientation_deg: Triple


class Calibrated(Foreign, frozen=True):
    """The file with poses."""

    sensors: list[Sensor]
    cameras: list[CalibratedCamera]


class Listed(Foreign, frozen=True):
    """A photo."""

    id: int
    uri: Text


class CameraList(Foreign, frozen=True):
    """The file with photos."""

    cameras: list[Listed]


class Crs(Foreign, frozen=True):
    """A coordinate reference system: its code or its well-known text."""

    definition: str


class BaseToCanonical(Foreign, frozen=True):
    """From the reference system to the scene: x and y swapped if need be, times the scale, plus the shift."""

    shift: Triple
    scale: Triple = (1.0, 1.0, 1.0)
    swap_xy: bool = False


class ReferenceFrame(Foreign, frozen=True):
    """The file with the reference system."""

    crs: Crs
    base_to_canonical: BaseToCanonical


def holds(path: Path, head: bytes) -> bool:
    """Return whether a file has calibrated cameras."""
    return path.suffix.lower() == ".json" and CALIBRATED in head


def read(path: Path) -> Poses:
    """Read the calibrated cameras, and the list of photos beside them.

    Raises:
        DatasetError: one of the files is damaged or missing, or no camera is calibrated.
    """
    contents: Calibrated = json_of(path, Calibrated)
    if not contents.cameras:
        raise DatasetError(f"{path}: has no calibrated camera; {AGAIN} after the calibration")
    uris = _uris(path)
    lenses = {each.id: _lens(each.internals) for each in contents.sensors}
    shots = []
    for camera in contents.cameras:
        uri = uris.get(camera.id)
        if uri is None:
            raise DatasetError(
                f"{path}: camera {camera.id} is not in the camera list; give both files of one export"
            )
        omega, phi, kappa = np.radians(camera.orientation_deg).tolist()
        R = OPENGL @ (turn(0, omega) @ turn(1, phi) @ turn(2, kappa)).T
        lens = lenses.get(camera.sensor_id) or no_lens("its sensor is not in the file")
        shots.append(Shot(uri, R, np.array(camera.position), lens))
    return Poses(path, shots, earth=_earth(path))


def _beside(path: Path, kind: bytes) -> Path | None:
    """Return the JSON file of a kind in the folder of a file; None if there is none."""
    files = [each for each in entries(path.parent) if each.suffix.lower() == ".json" and is_file(each)]
    return next((each for each in files if kind in head_of(each)), None)


def _earth(path: Path) -> Earth | None:
    """Return where on earth the scene is; None if no file beside the poses says it by a code."""
    found = _beside(path, REFERENCE)
    if found is None:
        return None
    frame: ReferenceFrame = json_of(found, ReferenceFrame)
    move, crs = frame.base_to_canonical, code_of(frame.crs.definition)
    if crs is None:
        return None
    if not all(move.scale):
        raise DatasetError(f"{found}: its scale is 0; {AGAIN}")
    swap = np.eye(3)[[1, 0, 2]] if move.swap_xy else np.eye(3)
    back = swap @ np.diag(1.0 / np.array(move.scale))
    return Earth.of(back, -back @ np.array(move.shift), crs)


def _uris(path: Path) -> dict[int, str]:
    """Return the names of photos by the numbers of their cameras."""
    found = _beside(path, LIST)
    if found is None:
        raise DatasetError(f"{path}: lacks its list of photos; put camera_list.json beside it")
    listed: CameraList = json_of(found, CameraList)
    return {each.id: unquote(each.uri.split("#")[0]) for each in listed.cameras}


def _lens(internals: Internals) -> Callable[[Path], Lens]:
    if internals.type != "perspective" or internals.focal_length_px is None:
        return no_lens(
            f"the lens {shortened(printable(internals.type))!r} has no model here; export undistorted photos"
        )
    f, (cx, cy) = internals.focal_length_px, internals.principal_point_px
    values = dict(zip(("k1", "k2", "k3"), internals.radial_distortion, strict=True))
    values |= dict(zip(("p1", "p2"), internals.tangential_distortion, strict=True))

    def lens(photo: Path) -> Lens:
        W, H = image_size(photo)
        return sized({**values, "fx": f, "fy": f, "cx": cx - W / 2, "cy": cy - H / 2}, (W, H))(photo)

    return lens


OPF = PoseProgram("Pix4D", holds, read)
