"""Rolling shutters in transforms.json: the convention, the round trip, the lens modes and bad values."""

import json
import re
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gsplat_edu.base.errors import ArgumentError, DatasetError
from gsplat_edu.data.dataset import Dataset, load_dataset
from gsplat_edu.data.lens import Lens
from gsplat_edu.data.loading_notes import IgnoredShutters, MotionBlurs, RollingShutters
from gsplat_edu.data.notes import UnusablePhotos
from gsplat_edu.data.reader import CaptureReader
from gsplat_edu.data.settings import DataSettings
from gsplat_edu.data.shutter_keys import keys_of_shutter, shutter_from_keys
from gsplat_edu.data.writers import write_transforms
from gsplat_edu.scene.camera import Camera
from gsplat_edu.scene.projection import PINHOLE
from gsplat_edu.scene.shutter import AT_ONCE, READOUTS, RollingShutter
from lab.captures.lens_captures import LENS_SCENES, lens_capture

NATIVE = DataSettings(lens="native", test_every=0)
KEYS = {
    "rolling_shutter_time": 0.02,
    "camera_linear_velocity": [1.0, -2.0, 0.5],
    "camera_angular_velocity": [0.6, -0.4, 0.9],
}


@pytest.fixture(scope="module")
def capture():
    """Three ray-traced photos of 40 x 30 px by moving cameras."""
    return lens_capture("shutter_20", "garden", 40, 3, start=50)


@pytest.fixture
def moving(tmp_path, small):
    """Write the small capture, of cameras at rest, with keys in the file and in its first frame."""

    def write(of_file=(), of_frame=()):
        write_transforms(tmp_path, *small)
        path = tmp_path / "transforms.json"
        contents = json.loads(path.read_text())
        contents["frames"][0].update(of_frame)
        path.write_text(json.dumps({**contents, **dict(of_file)}))
        return tmp_path

    return write


def notes_of(dataset, kind):
    return [note for note in dataset.notes if isinstance(note, kind)]


def test_velocities_are_the_cameras_own_in_opengl_axes():
    """Each row's rays are those of a pinhole that has moved by the velocities, computed from the pose matrix alone."""
    pose = Rotation.from_rotvec([0.3, -0.8, 0.2]).as_matrix()  # camera to world, OpenGL axes
    eye, flip = np.array([1.0, 2.0, 3.0]), np.diag([1.0, -1.0, -1.0])
    R = (pose @ flip).T
    shutter = shutter_from_keys("f", KEYS, R)
    camera = Camera(R, eye, 50.0, 50.0, 19.5, 14.5, 30, 40).through(PINHOLE, shutter)
    rays, origins = camera.rays(), camera.origins()
    for row in (0, 7, 14, 29):
        time = ((row + 0.5) / 30 - 0.5) * KEYS["rolling_shutter_time"]
        turned = pose @ Rotation.from_rotvec(time * np.array(KEYS["camera_angular_velocity"])).as_matrix()
        then = Camera(
            (turned @ flip).T,
            eye + time * pose @ np.array(KEYS["camera_linear_velocity"]),
            50.0, 50.0, 19.5, 14.5, 30, 40,
        )  # fmt: skip
        # Cayley's map is the rotation up to the third order, 1e-7 here; the motion is 1e-2
        np.testing.assert_allclose(rays[row], then.rays()[row], rtol=0, atol=1e-6)
        np.testing.assert_allclose(origins[row], np.broadcast_to(then.eye, (40, 3)), rtol=0, atol=1e-12)


@pytest.mark.parametrize("readout", READOUTS)
def test_what_is_written_is_read_again(tmp_path, small, readout):
    views, points, colors = small
    shutter = RollingShutter([0.01, -0.03, 0.02], [0.1, 0.05, -0.2], readout)
    moved = views[4].camera.through(PINHOLE, shutter)
    assert shutter_from_keys("f", keys_of_shutter(moved), moved.R).turn.tolist() == shutter.turn.tolist()
    photos = [replace_camera(view, view.camera.through(PINHOLE, shutter)) for view in views]
    write_transforms(tmp_path, photos, points, colors)
    for view, original in zip(load_dataset(tmp_path, NATIVE).train, photos, strict=True):
        found = view.camera.shutter
        assert found.turn.tolist() == shutter.turn.tolist() and found.readout == readout
        np.testing.assert_allclose(found.shift, shutter.shift, rtol=0, atol=1e-15)
        np.testing.assert_allclose(view.camera.rays(), original.camera.rays(), rtol=0, atol=1e-12)


@pytest.mark.parametrize(("readout", "exposure"), [("down", 0.4), ("left", 1.5), (AT_ONCE, 1.0)])
def test_an_exposure_is_written_and_read_again(tmp_path, small, readout, exposure):
    views, points, colors = small
    shutter = RollingShutter([0.01, -0.03, 0.02], [0.1, 0.05, -0.2], readout, exposure)
    photos = [replace_camera(view, view.camera.through(PINHOLE, shutter)) for view in views]
    write_transforms(tmp_path, photos, points, colors)
    dataset = load_dataset(tmp_path, NATIVE)
    for view in dataset.train:
        found = view.camera.shutter
        assert found.turn.tolist() == shutter.turn.tolist()
        np.testing.assert_allclose(found.shift, shutter.shift, rtol=0, atol=1e-15)
        assert (found.readout, found.exposure) == (readout, exposure)
    (note,) = notes_of(dataset, MotionBlurs)
    assert (note.photos, note.total) == (9, 9) and "motion blur" in str(note)
    assert len(notes_of(dataset, RollingShutters)) == (readout != AT_ONCE)


def test_a_global_shutter_with_an_exposure_time_is_blurred(moving):
    """E takes the place of the readout time; an exposure of half the unit is the same motion at half the length."""
    given = {**KEYS, "rolling_shutter_time": 0.0, "exposure_time": 0.01}
    R = np.eye(3)
    found, whole = (shutter_from_keys("f", values, R) for values in (given, KEYS))
    assert (found.readout, found.exposure) == (AT_ONCE, 1.0)
    np.testing.assert_allclose(found.turn, 0.5 * whole.turn, rtol=1e-15)
    rolling = shutter_from_keys("f", KEYS | {"exposure_time": 0.01}, R)
    assert (rolling.readout, rolling.exposure) == ("down", 0.5)
    camera = Camera(R, (0.0, 0.0, 0.0), 50.0, 50.0, 19.5, 14.5, 30, 40)
    half = RollingShutter(2 * found.turn, 2 * found.shift, AT_ONCE, 0.5)
    one, other = (
        shutter_from_keys("f", keys_of_shutter(camera.through(PINHOLE, each)), R) for each in (found, half)
    )
    assert (one.turn == other.turn).all() and one.exposure == other.exposure == 1
    dataset = load_dataset(moving(given), NATIVE)
    assert all(view.camera.shutter.readout == AT_ONCE for view in dataset.train)
    resting = load_dataset(moving(given))
    assert all(view.camera.pinhole for view in resting.train) and notes_of(resting, IgnoredShutters)


def replace_camera(view, camera):
    photo = view.read()
    return type(view)(camera, photo.image, mask=photo.mask, name=view.name)


def test_a_traced_capture_is_seen_by_the_cameras_that_are_read(tmp_path, capture):
    """The loaded cameras photograph the scene as the capture has it; cameras at rest do not."""
    write_transforms(tmp_path, capture.views, capture.points, capture.colors)
    photograph = LENS_SCENES["garden"].photograph
    resting = load_dataset(tmp_path, DataSettings(test_every=0)).train
    for view, still in zip(load_dataset(tmp_path, NATIVE).train, resting, strict=True):
        photo = view.read().image.astype(int)
        # a pixel whose ray passes an edge may round to the other side
        assert (np.abs(photograph(view.camera).image - photo).max(axis=2) > 1).mean() < 0.001
        assert (np.abs(photograph(still.camera).image - photo).max(axis=2) > 8).mean() > 0.2


def test_cameras_at_rest_write_no_keys_and_have_no_shutter(moving, small):
    folder = moving({"rolling_shutter_time": 0.03})
    assert not any(
        "velocity" in key for key in json.loads((folder / "transforms.json").read_text())["frames"][0]
    )
    assert all(view.camera.shutter is None for view in load_dataset(folder, NATIVE).train)


def test_a_frame_overrides_the_file_and_the_note_counts(moving):
    dataset = load_dataset(moving(KEYS, {"rolling_shutter_time": 0.0}), NATIVE)
    (note,) = notes_of(dataset, RollingShutters)
    assert [view.camera.shutter is None for view in dataset.train] == [True, *[False] * 8]
    assert (note.photos, note.total) == (8, 9)
    assert note.turn == pytest.approx(np.degrees(0.02 * np.linalg.norm([0.6, -0.4, 0.9])))
    assert "rolling shutter" in str(note)


def test_each_mode_keeps_or_ignores_the_shutter(moving):
    """auto keeps the lens of a mildly distorted photo that has a shutter; undistort ignores the shutter and says so."""
    folder = moving({**KEYS, "k1": 0.01, "camera_model": "OPENCV"})
    for lens in ("native", "auto"):
        dataset = load_dataset(folder, DataSettings(lens=lens))
        assert all(v.camera.shutter is not None and not v.camera.projection.plain for v in dataset.train)
        assert not notes_of(dataset, IgnoredShutters)
    dataset = load_dataset(folder)
    assert all(view.camera.pinhole for view in dataset.train)
    (note,) = notes_of(dataset, IgnoredShutters)
    assert note.photos == 9 and note.undistorted and "--lens native" in str(note)


def test_a_lens_that_the_renderer_lacks_loses_its_shutter(moving):
    reader = CaptureReader(moving(KEYS))
    frames = [
        replace(frame, lens=replace(_lens(frame), coefficients=(-0.1,), model="division"))
        for frame in reader.capture.frames
    ]
    reader.__dict__["capture"] = replace(reader.capture, frames=tuple(frames))
    dataset = Dataset.of(reader, DataSettings(lens="native"))
    assert all(view.camera.pinhole for view in dataset.train)
    (note,) = notes_of(dataset, IgnoredShutters)
    assert not note.undistorted and "does not have their lens" in str(note)


def _lens(frame):
    assert isinstance(frame.lens, Lens)
    return frame.lens


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("rolling_shutter_time", -0.02, "is -0.02, but must be at least 0 seconds"),
        ("rolling_shutter_time", "fast", "is fast, but must be a number"),
        ("rolling_shutter_time", [0.1], r"is \[0.1\], but must be a number"),
        ("exposure_time", -1, "is -1, but must be at least 0 seconds"),
        ("camera_linear_velocity", [1, 2], r"is \[1, 2\], but must be three numbers"),
        ("camera_linear_velocity", [1, 2, "3"], "but must be three numbers"),
        ("camera_angular_velocity", [0, float("nan"), 0], "but must be three numbers"),
        ("camera_angular_velocity", [90, 0, 0], "turns by 1.8 radians .* radians per second"),
        ("exposure_time", 2, "turns by 2.31 radians while the photo is exposed, .* exposure_time in seconds"),
        ("rolling_shutter_readout", "diagonal", "is diagonal, but must be one of down, up, right, left"),
    ],
)
def test_bad_values_are_refused_in_one_line(moving, key, value, message):
    """Of one frame, which is left out; of all frames, which is an error."""
    (note,) = notes_of(load_dataset(moving(KEYS, {key: value})), UnusablePhotos)
    assert len(note.problems) == 1 and re.search(message, str(note))
    with pytest.raises(DatasetError, match=f"transforms.json, frame .*: .*{message}") as caught:
        load_dataset(moving({**KEYS, key: value}))
    assert "\n" not in str(caught.value)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("place", ["of_file", "of_frame"])
@pytest.mark.parametrize(
    ("keys", "named"),
    [
        (
            {"rolling_shutter_time": 1e300, "camera_angular_velocity": [1e300, 0, 0]},
            "rolling_shutter_time is 1e[+]300",
        ),
        (
            {"rolling_shutter_time": 5e-324, "exposure_time": 1.0, "camera_linear_velocity": [1, 0, 0]},
            "5e-324|4.94",
        ),
        ({"rolling_shutter_time": 0.02, "exposure_time": 1e300, **KEYS}, "exposure_time is 1e[+]300"),
        ({"rolling_shutter_time": 1.0, "camera_linear_velocity": [1e300] * 3}, "camera_linear_velocity is"),
        ({"rolling_shutter_time": 1.0, "camera_angular_velocity": [1e200] * 3}, "camera_angular_velocity is"),
    ],
)
def test_huge_values_are_named_before_they_overflow(moving, place, keys, named):
    """Those of the whole file end the reading; a photo with such values is left out and named."""
    capture = moving(**{place: keys})
    if place == "of_frame":
        assert re.search(named, "\n".join(map(str, load_dataset(capture, NATIVE).notes)))
        return
    with pytest.raises(DatasetError, match=named):
        load_dataset(capture, NATIVE)


@pytest.mark.filterwarnings("error")
def test_a_huge_turn_is_compared_before_it_is_squared():
    for turn in ([1e200, 1e200, 0.0], [0.9, 0.9, 0.0]):
        with pytest.raises(ArgumentError, match="more than a radian"):
            RollingShutter(turn, [0.0, 0.0, 0.0])
