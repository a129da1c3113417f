"""Choose which intrinsics of a camera are refined, by cross-validation on its photos.

Every camera starts with one focal length, one distortion coefficient and a centred principal point. More freedom always
fits the photos used for the fit better; with few photos or poor geometry it yields implausible intrinsics. A camera's
photos are therefore split in two halves. The intrinsics found on one half are held fixed while the poses and points of
the other half are refined. A freer model is accepted only if it explains the other half better, in both directions.
"""

from __future__ import annotations

import copy
from collections import Counter
from collections.abc import Collection
from typing import NamedTuple

import numpy as np
import pycolmap

from .database import is_wide
from .judge import residuals, take_out

WITNESSES = 20
"""Consider freer lens models for a camera with at least this number of photos: ten in each half."""

HALF = 30
"""Largest number of photos in a half; more cost time and do not change the result."""

SEEN = 30
"""Smallest median number of points seen by a half's photos for the comparison to be meaningful."""

GAIN = 0.02
"""Smallest fraction by which a freer lens has to reduce the error in the other half's photos."""

CENTRED = 0.1
"""Largest distance of a principal point from the image centre, as a fraction of the size."""

CIRCLE_CENTRED = 0.2
"""The same of a fisheye, whose circle may lie off the middle of the sensor."""

REFINEMENTS = 30
"""Iterations of the adjustments for cross-validation, which start from the solution of a simpler lens."""

FOLLOWED = 2
"""Number of rounds in which cameras copy the lens of the camera that they follow and all others are adjusted."""


class Rung(NamedTuple):
    """A step of the ladder: which of a camera's parameters are refined."""

    model: str
    centre: bool

    def __str__(self) -> str:
        """Return the name used in messages."""
        return f"{self.model}, free centre" if self.centre else self.model


LENS_LADDER = (
    Rung("SIMPLE_RADIAL", centre=False),
    Rung("RADIAL", centre=False),
    Rung("OPENCV", centre=False),
    Rung("OPENCV", centre=True),
)
"""Lens models with increasing freedom: 2, 3, 6 and 8 parameters."""


FISHEYE_LADDER = (
    Rung("SIMPLE_RADIAL_FISHEYE", centre=False),
    Rung("SIMPLE_RADIAL_FISHEYE", centre=True),
    Rung("RADIAL_FISHEYE", centre=True),
    Rung("OPENCV_FISHEYE", centre=True),
)
"""The same of fisheyes: 2, 4, 5 and 8 parameters."""

RIM = 0.5
"""Radius up to which the polynomial of a fisheye has to grow, as a fraction of the longer side: where its round image
usually ends."""


class Kin(NamedTuple):
    """Link from a camera with scaled or cropped photos to its main camera, with the ratio of focal lengths."""

    main: int
    factor: float


def refined(
    model: pycolmap.Reconstruction,
    climb: bool,
    threads: int,
    kin: dict[int, Kin] | None = None,
    fixed: Collection[int] = (),
) -> tuple[pycolmap.Reconstruction, dict[int, str]]:
    """Run a final bundle adjustment, with as much freedom for each camera as its photos support.

    Args:
        model: A model in which all cameras have the lens model used for mapping.
        climb: Whether freer lens models are considered; a free principal point always is.
        threads: Number of threads.
        kin: Cameras that follow another one, by number.
        fixed: Cameras whose intrinsics stay.

    Returns:
        The adjusted model, and the refined parameters of each camera, by number.
    """
    photos = Counter(model.image(image).camera_id for image in model.reg_image_ids())
    kin = {camera: one for camera, one in (kin or {}).items() if camera in photos}
    stay = set(kin).union(fixed)
    chosen = {camera: _climbed(model, camera, climb, threads) for camera in sorted(set(photos) - stay)}
    result = copy.deepcopy(model)
    for camera, rung in chosen.items():
        _change(result.camera(camera), rung.model)
    for _ in range(FOLLOWED if kin else 1):
        _follow(result, kin)
        adjust(result, threads, fixed=stay)
    if any(rung.centre for rung in chosen.values()):
        centred = {camera for camera, rung in chosen.items() if not rung.centre}
        free = copy.deepcopy(result)
        adjust(free, threads, centre=True, fixed=centred | stay)
        if all(_believable(free.camera(camera)) for camera in chosen):
            result = free
        else:
            chosen = {camera: rung._replace(centre=False) for camera, rung in chosen.items()}
    if not all(_believable(result.camera(camera)) for camera in chosen):
        return model, {camera: model.camera(camera).model_name for camera in photos}
    if kin:
        _follow(result, kin)
        adjust(result, threads, fixed=set(photos))
    result.update_point_3d_errors()
    names = {camera: model.camera(camera).model_name for camera in photos}
    names |= {camera: str(rung) for camera, rung in chosen.items()}
    return result, names | {camera: names[one.main] for camera, one in kin.items()}


def simplified(model: pycolmap.Reconstruction, name: str, threads: int) -> None:
    """Give all cameras but fisheyes a simpler lens with a centred principal point, and run a bundle adjustment.

    `refined` can then choose the freedom that their photos support, as for models mapped with that lens model.

    Args:
        model: The model; changed in place.
        name: Name of a lens model with one focal length.
        threads: Number of threads.
    """
    for number, camera in model.cameras.items():
        if is_wide(camera):
            continue
        bends = [camera.params[i] for i in camera.extra_params_idxs()]
        after = pycolmap.Camera.create_from_model_name(
            number, name, camera.mean_focal_length(), camera.width, camera.height
        )
        params = np.array(after.params)
        for index, value in zip(after.extra_params_idxs(), bends, strict=False):
            params[index] = value
        camera.model = after.model
        camera.params = params.tolist()
    adjust(model, threads)


def _follow(model: pycolmap.Reconstruction, kin: dict[int, Kin]) -> None:
    """Copy each camera's lens from the camera that it follows, scaled to its size with the principal point."""
    for number, one in kin.items():
        camera, main = model.camera(number), model.camera(one.main)
        params = np.array(main.params)
        params[list(main.focal_length_idxs())] *= one.factor
        x, y = main.principal_point_idxs()
        params[x] = camera.width / 2 + one.factor * (params[x] - main.width / 2)
        params[y] = camera.height / 2 + one.factor * (params[y] - main.height / 2)
        camera.model = main.model
        camera.params = params.tolist()


def _climbed(model: pycolmap.Reconstruction, camera: int, climb: bool, threads: int) -> Rung:
    """Return the freest rung that still improves the fit of held-out photos."""
    given = Rung(model.camera(camera).model_name, centre=False)
    ladder = FISHEYE_LADDER if is_wide(model.camera(camera)) else LENS_LADDER
    rungs = [rung for rung in ladder if rung != given] if climb else [given._replace(centre=True)]
    images = sorted(
        (i for i in model.reg_image_ids() if model.image(i).camera_id == camera),
        key=lambda i: model.image(i).name,
    )
    if len(images) < WITNESSES:
        return given
    middle = len(images) // 2
    blocks = images[max(0, middle - HALF) : middle], images[middle : middle + HALF]
    halves = [_part(model, set(block)) for block in blocks]
    if any(_median_seen(half) < SEEN for half in halves):
        return given
    best, errors = given, _errors(halves, given, threads)
    for rung in rungs:
        found = _errors(halves, rung, threads)
        gained = all(new < old for new, old in zip(found, errors, strict=True))
        if gained and sum(found) < (1.0 - GAIN) * sum(errors):
            best, errors = rung, found
    return best


def _errors(halves: list[pycolmap.Reconstruction], rung: Rung, threads: int) -> list[float]:
    """Return, for each half, the error of its photos with the intrinsics found on the other half."""
    found = []
    for one, other in ((0, 1), (1, 0)):
        teacher, judge = copy.deepcopy(halves[one]), copy.deepcopy(halves[other])
        (camera,) = {teacher.image(image).camera_id for image in teacher.reg_image_ids()}
        _change(teacher.camera(camera), rung.model)
        adjust(teacher, threads, iterations=REFINEMENTS)
        if rung.centre:
            adjust(teacher, threads, iterations=REFINEMENTS, centre=True)
        if not _believable(teacher.camera(camera)):
            return [np.inf, np.inf]
        _change(judge.camera(camera), rung.model)
        judge.camera(camera).params = list(teacher.camera(camera).params)
        adjust(judge, threads, iterations=REFINEMENTS, fixed={camera})
        found.append(_error(judge))
    return found


def _error(model: pycolmap.Reconstruction) -> float:
    """Return the mean reprojection error, px, with a soft L1 loss that limits the effect of wrong matches."""
    errors = np.concatenate([residuals(model, image)[2] for image in sorted(model.reg_image_ids())])
    return float(np.mean(2.0 * (np.sqrt(1.0 + np.minimum(errors, 1e6)) - 1.0)))


def _part(model: pycolmap.Reconstruction, images: set[int]) -> pycolmap.Reconstruction:
    """Return the model reduced to some of its photos."""
    part = copy.deepcopy(model)
    take_out(part, set(part.reg_image_ids()) - images)
    return part


def _median_seen(model: pycolmap.Reconstruction) -> float:
    return float(np.median([model.image(image).num_points3D for image in model.reg_image_ids()]))


def _change(camera: pycolmap.Camera, name: str) -> None:
    """Change a camera's lens model without changing its distortion; the new model never has fewer parameters."""
    if camera.model_name == name:
        return
    focal, (x, y) = camera.focal_length_x, (camera.principal_point_x, camera.principal_point_y)
    bends = [camera.params[i] for i in camera.extra_params_idxs()]
    after = pycolmap.Camera.create_from_model_name(camera.camera_id, name, focal, camera.width, camera.height)
    params = np.array(after.params)
    for index, value in zip(after.principal_point_idxs(), (x, y), strict=True):
        params[index] = value
    for index, value in zip(after.extra_params_idxs(), bends, strict=False):
        params[index] = value
    camera.model = after.model
    camera.params = params.tolist()


def adjust(
    model: pycolmap.Reconstruction,
    threads: int,
    *,
    iterations: int = 100,
    centre: bool = False,
    fixed: set[int] | None = None,
) -> None:
    """Adjust poses, points and intrinsics; the intrinsics of some cameras may be held fixed."""
    options = pycolmap.BundleAdjustmentOptions()
    options.refine_principal_point, options.print_summary = centre, False
    options.ceres.use_gpu = False
    options.ceres.loss_function_type = pycolmap.LossFunctionType.SOFT_L1
    options.ceres.solver_options.num_threads = threads
    options.ceres.solver_options.max_num_iterations = iterations
    options.ceres.solver_options.function_tolerance = 1e-6
    config = pycolmap.BundleAdjustmentConfig()
    for image in sorted(model.reg_image_ids()):
        config.add_image(image)
    for camera in sorted(fixed or ()):
        config.set_constant_cam_intrinsics(camera)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    pycolmap.create_default_bundle_adjuster(options, config, model).solve()


def _believable(camera: pycolmap.Camera) -> bool:
    """Return whether intrinsics are plausible."""
    x, y = camera.principal_point_x / camera.width, camera.principal_point_y / camera.height
    if is_wide(camera) and not _grows(camera):
        return False
    centred = CIRCLE_CENTRED if is_wide(camera) else CENTRED
    return max(abs(x - 0.5), abs(y - 0.5)) <= centred and not camera.has_bogus_params(0.1, 10.0, 1.0)


def _grows(camera: pycolmap.Camera) -> bool:
    """Return whether a fisheye's polynomial grows up to `RIM`, beyond the angles at which features were used."""
    bends = [camera.params[i] for i in camera.extra_params_idxs()]
    theta = np.linspace(0.0, np.pi, 1024)
    image = theta * (1.0 + sum(k * theta ** (2 * i) for i, k in enumerate(bends, 1)))
    rim = RIM * max(camera.width, camera.height) / camera.mean_focal_length()
    turned = np.flatnonzero(np.diff(image) <= 0)
    return bool(image[turned[0] if len(turned) else -1] >= rim)
