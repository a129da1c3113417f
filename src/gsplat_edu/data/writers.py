"""Write captures in every supported layout, so that tests and examples need no downloads."""

from __future__ import annotations

import json
import math
import struct
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.base.validation import ArrayLike, float64_array
from gsplat_edu.data.blender import TRAIN_FILE
from gsplat_edu.data.capture import Cloud
from gsplat_edu.data.colmap import SPHERE
from gsplat_edu.data.colmap_files import MODELS
from gsplat_edu.data.lens_formulas import FISHEYE as FISHEYE_NAMES, PERSPECTIVE as PERSPECTIVE_NAMES
from gsplat_edu.data.native_lens import ARIA, POLYNOMIAL, RATIONAL
from gsplat_edu.data.points import write_points_ply
from gsplat_edu.data.shutter_keys import keys_of_shutter
from gsplat_edu.data.tracks import UNMEASURED, VisiblePoints, tracks_of, visible_points
from gsplat_edu.scene.camera import Camera
from gsplat_edu.scene.photo import Photo
from gsplat_edu.scene.projection import COEFFICIENTS
from gsplat_edu.scene.views import View

Intrinsic = tuple[str, int, int, tuple[float, ...]]
"""COLMAP's model, width, height and parameters."""

Names = tuple[tuple[str, dict[str, str]], ...]
"""Models of COLMAP, and our names of those coefficients that have another name."""

OF_KIND: dict[tuple[str, bool], Names] = {
    ("perspective", False): (("PINHOLE", {}), ("OPENCV", RATIONAL), ("FULL_OPENCV", RATIONAL)),
    ("fisheye", False): (("OPENCV_FISHEYE", {}), ("THIN_PRISM_FISHEYE", POLYNOMIAL)),
    ("fisheye", True): (("RAD_TAN_THIN_PRISM_FISHEYE", ARIA),),
}
"""The models by kind of projection and `Distortion.radial_first`, the simplest first."""


def write_colmap(
    folder: Path, views: Sequence[View], points: ArrayLike, colors: ArrayLike, *, binary: bool = True
) -> None:
    """Write images/NAME, masks/NAME.png for views with a mask, and a model in sparse/0 with tracks.

    Args:
        folder: The capture; created if missing.
        views: Views with different names that end in .png; a name may contain folders.
        points: (N, 3) world units.
        colors: (N, 3) 0 to 1, rounded to 8 bits.
        binary: Write the model as .bin instead of .txt.

    Raises:
        ShapeError: points or colours are not (N, 3).
    """
    for view in views:
        photo = view.read()
        _save_photo(folder / "images" / view.name, photo)
        _save_mask(folder / "masks" / f"{view.name}.png", photo)
    write_model(folder, [(view.name, view.camera) for view in views], points, colors, binary=binary)


def write_model(
    folder: Path,
    cameras: Sequence[tuple[str, Camera]],
    points: ArrayLike,
    colors: ArrayLike,
    *,
    binary: bool = True,
) -> None:
    """Write a COLMAP model in sparse/0, without photos.

    Tracks list the photos that see a point (`gsplat_edu.data.tracks`); programs that supervise depth read them.

    Args:
        folder: The capture; created if missing.
        cameras: Name and camera of each photo in images/.
        points: (N, 3) world units.
        colors: (N, 3) 0 to 1, rounded to 8 bits.
        binary: Write .bin instead of .txt.

    Raises:
        ShapeError: points or colours are not (N, 3).
    """
    cloud = _cloud(points, colors)
    model = folder / "sparse" / "0"
    model.mkdir(parents=True, exist_ok=True)
    lenses: dict[Intrinsic, int] = {}
    for _, camera in cameras:
        lenses.setdefault(_intrinsics(camera), len(lenses) + 1)
    poses = [
        (i, _quaternion(camera), -camera.R @ camera.eye, lenses[_intrinsics(camera)], name)
        for i, (name, camera) in enumerate(cameras, 1)
    ]
    rgb = np.round(255.0 * np.clip(cloud.colors, 0.0, 1.0)).astype(int)
    seen = [visible_points(camera, cloud.points) for _, camera in cameras]
    if binary:
        _write_bin(model, lenses, poses, seen, (cloud.points, rgb))
    else:
        _write_txt(model, lenses, poses, seen, (cloud.points, rgb))


def write_transforms(
    folder: Path,
    views: Sequence[View],
    points: ArrayLike | None = None,
    colors: ArrayLike | None = None,
    *,
    extra: dict[str, Any] | None = None,
) -> None:
    """Write images/NAME, masks/NAME.png for views with a mask, points.ply and transforms.json.

    Args:
        folder: The capture; created if missing.
        views: Views with different names that end in .png. A rolling shutter is written, too.
        points: (N, 3) world units, the initial cloud; None for none.
        colors: (N, 3) 0 to 1, rounded to 8 bits; required with points.
        extra: Additional keys for the file, such as `test_filenames`.

    Raises:
        ShapeError: points or colours are not (N, 3).
    """
    frames = []
    for view in views:
        camera, photo = view.camera, view.read()
        frame = {
            "file_path": f"images/{view.name}",
            "transform_matrix": _camera_to_world(camera),
            "w": camera.W,
            "h": camera.H,
            **_nerfstudio_lens(view.name, camera),
            **keys_of_shutter(camera),
        }
        _save_photo(folder / "images" / view.name, photo)
        if _save_mask(folder / "masks" / f"{view.name}.png", photo):
            frame["mask_path"] = f"masks/{view.name}.png"
        frames.append(frame)
    plain = all(view.camera.projection.plain for view in views)
    contents: dict[str, Any] = {"camera_model": "PINHOLE"} if plain else {}
    contents |= {"frames": frames, **(extra or {})}
    folder.mkdir(parents=True, exist_ok=True)
    if points is not None and colors is not None:
        write_points_ply(folder / "points.ply", _cloud(points, colors))
        contents["ply_file_path"] = "points.ply"
    _save_json(folder / "transforms.json", contents)


def write_blender(folder: Path, train: Sequence[View], test: Sequence[View]) -> None:
    """Write train/NAME.png, test/NAME.png and the two transforms files.

    Args:
        folder: The scene; created if missing.
        train: Training views.
        test: Test views. All views need square pixels, the same field of view and a centred principal point, because
            the format cannot represent anything else.

    Raises:
        ArgumentError: a camera does not meet these conditions.
    """
    folder.mkdir(parents=True, exist_ok=True)
    for part, views in (("train", train), ("test", test)):
        frames = []
        for view in views:
            _check_blender(view, (*train, *test)[0].camera)
            _save_photo(folder / part / Path(view.name).with_suffix(".png"), view.read())
            name = f"./{part}/{Path(view.name).with_suffix('')}"
            frames.append({"file_path": name, "transform_matrix": _camera_to_world(view.camera)})
        angle = 2.0 * math.atan(0.5 * views[0].camera.W / views[0].camera.fx) if views else 1.0
        name = TRAIN_FILE if part == "train" else f"transforms_{part}.json"
        _save_json(folder / name, {"camera_angle_x": angle, "frames": frames})


def _check_blender(view: View, first: Camera) -> None:
    camera = view.camera
    middle = np.allclose((camera.cx, camera.cy), ((camera.W - 1) / 2, (camera.H - 1) / 2), rtol=0, atol=1e-9)
    one_field = math.isclose(camera.fx / camera.W, first.fx / first.W, rel_tol=1e-9)
    if not (middle and one_field and math.isclose(camera.fx, camera.fy, rel_tol=1e-9)):
        raise ArgumentError(
            f"{view.name}: Blender's layout needs square pixels, a common field of view and a centred principal point;"
            " write transforms.json instead"
        )


def _nerfstudio_lens(name: str, camera: Camera) -> dict[str, Any]:
    """Return the keys of a frame's lens in transforms.json.

    Raises:
        ArgumentError: the format has no model for the camera's projection.
    """
    model, _, _, values = _intrinsics(camera)
    if model not in ("PINHOLE", "OPENCV", "FULL_OPENCV", "OPENCV_FISHEYE"):
        raise ArgumentError(
            f"{name}: transforms.json has no model for its lens; write COLMAP's layout instead"
        )
    fx, fy, cx, cy, *coefficients = values
    found: dict[str, Any] = {"fl_x": fx, "fl_y": fy, "cx": cx, "cy": cy}
    if camera.projection.plain:
        return found
    names = {"OPENCV_FISHEYE": FISHEYE_NAMES}.get(model, PERSPECTIVE_NAMES)
    found["camera_model"] = "OPENCV_FISHEYE" if model == "OPENCV_FISHEYE" else "OPENCV"
    return found | dict(zip(names, coefficients, strict=False))


def _cloud(points: ArrayLike, colors: ArrayLike) -> Cloud:
    sizes: dict[str, int] = {}
    return Cloud(
        float64_array("points", points, ("N", 3), sizes), float64_array("colors", colors, ("N", 3), sizes)
    )


def _intrinsics(camera: Camera) -> Intrinsic:
    """Return a camera in COLMAP's terms; a rolling shutter has no place in them.

    Raises:
        ArgumentError: no model of COLMAP has the camera's projection.
    """
    pinhole = tuple(float(v) for v in (camera.fx, camera.fy, camera.cx + 0.5, camera.cy + 0.5))
    if camera.projection.kind == "equirectangular":
        return SPHERE, camera.W, camera.H, (float(camera.W), float(camera.H))
    given = dict(zip(COEFFICIENTS, camera.coefficients or (0.0,) * len(COEFFICIENTS), strict=True))
    if camera.projection.kind in ("perspective", "fisheye"):
        for name, ours in OF_KIND[camera.projection.kind, camera.projection.radial_first]:
            names = [ours.get(key, key) for key in dict(MODELS)[name].split()[len(pinhole) :]]
            if all(value == 0.0 for key, value in given.items() if key not in names):
                return name, camera.W, camera.H, (*pinhole, *(given[key] for key in names))
    raise ArgumentError(f"camera: COLMAP has no model for its {camera.projection.kind} projection")


def _camera_to_world(camera: Camera) -> list[list[float]]:
    """Return the camera-to-world matrix (4x4) with OpenGL's camera axes."""
    matrix = np.eye(4)
    matrix[:3, :3] = camera.R.T * np.array([1.0, -1.0, -1.0])
    matrix[:3, 3] = camera.eye
    rows: list[list[float]] = matrix.tolist()
    return rows


def _quaternion(camera: Camera) -> tuple[float, ...]:
    """Convert R to (w, x, y, z): the eigenvector with the largest eigenvalue of a matrix linear in R.

    Source: Bar-Itzhack 2000, "New method for extracting the quaternion from a rotation matrix".
    """
    (a, b, c), (d, e, f), (g, h, i) = camera.R
    matrix = np.array(
        [
            [a + e + i, h - f, c - g, d - b],
            [h - f, a - e - i, b + d, c + g],
            [c - g, b + d, e - a - i, f + h],
            [d - b, c + g, f + h, i - a - e],
        ]
    )
    quat = np.linalg.eigh(matrix)[1][:, -1]
    w, x, y, z = (float(q) for q in (quat if quat[0] >= 0 else -quat))
    return w, x, y, z


_Pose = tuple[int, tuple[float, ...], np.ndarray, int, str]


def _write_bin(
    model: Path,
    cameras: dict[Intrinsic, int],
    poses: Sequence[_Pose],
    seen: Sequence[VisiblePoints],
    cloud: tuple[np.ndarray, np.ndarray],
) -> None:
    data = struct.pack("<Q", len(cameras))
    numbers = {name: number for number, (name, _) in enumerate(MODELS)}
    for (name, W, H, values), camera in cameras.items():
        data += struct.pack(f"<IiQQ{len(values)}d", camera, numbers[name], W, H, *values)
    (model / "cameras.bin").write_bytes(data)
    data = struct.pack("<Q", len(poses))
    for (image, quat, shift, camera, name), shown in zip(poses, seen, strict=True):
        data += struct.pack("<I7dI", image, *quat, *shift, camera) + name.encode() + b"\0"
        marks = np.empty(len(shown.points), [("pixel", "<f8", 2), ("point", "<i8")])
        marks["pixel"], marks["point"] = shown.pixels, shown.points + 1
        data += struct.pack("<Q", len(marks)) + marks.tobytes()
    (model / "images.bin").write_bytes(data)
    rows = []
    tracks = tracks_of(seen, len(cloud[0]))
    for i, (point, color, track) in enumerate(zip(*cloud, tracks, strict=True), 1):
        rows.append(struct.pack("<Q3d3BdQ", i, *point, *color, UNMEASURED, len(track.images)))
        rows.append(np.stack([track.images + 1, track.places], axis=1).astype("<u4").tobytes())
    (model / "points3D.bin").write_bytes(struct.pack("<Q", len(tracks)) + b"".join(rows))


def _write_txt(
    model: Path,
    cameras: dict[Intrinsic, int],
    poses: Sequence[_Pose],
    seen: Sequence[VisiblePoints],
    cloud: tuple[np.ndarray, np.ndarray],
) -> None:
    def line(*values: Any) -> str:  # noqa: ANN401
        return " ".join(v if isinstance(v, str) else repr(v) for v in values) + "\n"

    text = "# CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]\n"
    for (name, W, H, values), camera in cameras.items():
        text += line(camera, name, W, H, *values)
    (model / "cameras.txt").write_text(text, encoding="utf-8")
    text = "# IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME, then a line of points\n"
    for (image, quat, shift, camera, name), shown in zip(poses, seen, strict=True):
        text += line(image, *quat, *shift.tolist(), camera, name)
        marks = zip(shown.pixels.tolist(), (shown.points + 1).tolist(), strict=True)
        text += line(*(number for pixel, point in marks for number in (*pixel, point)))
    (model / "images.txt").write_text(text, encoding="utf-8")
    points, rgb = (each.tolist() for each in cloud)
    lines = ["# POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[]\n"]
    for i, (point, color, track) in enumerate(zip(points, rgb, tracks_of(seen, len(points)), strict=True), 1):
        pairs = np.stack([track.images + 1, track.places], axis=1).ravel().tolist()
        lines.append(line(i, *point, *color, UNMEASURED, *pairs))
    (model / "points3D.txt").write_text("".join(lines), encoding="utf-8")


def _save_photo(path: Path, photo: Photo) -> None:
    pixels = photo.image
    if pixels.dtype != np.uint8:
        pixels = np.round(255.0 * pixels).astype(np.uint8)
    if photo.alpha is not None:
        pixels = np.concatenate([pixels, photo.alpha[..., None]], axis=2)
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(pixels).save(path)


def _save_mask(path: Path, photo: Photo) -> bool:
    if photo.mask is None:
        return False
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.where(photo.mask, 255, 0).astype(np.uint8)).save(path)
    return True


def _save_json(path: Path, contents: dict[str, Any]) -> None:
    path.write_text(json.dumps(contents, indent=1) + "\n", encoding="utf-8")
