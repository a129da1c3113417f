"""Mistakes of convention that are planted in a capture's file are named and undone, and no right capture is doubted."""

import json
import shutil
from dataclasses import replace

import cv2
import numpy as np
import pytest

from gsplat_edu.data.conventions import mistake
from gsplat_edu.data.reader import CaptureReader
from gsplat_edu.data.writers import write_transforms
from gsplat_edu.doctor.before import examine
from gsplat_edu.scene.views import View
from gsplat_edu.survey.capture import prepare
from gsplat_edu.survey.proof import Verdict, prove
from lab.captures.room import room_capture
from lab.captures.textured_box import box_orbit, photograph_box
from scene_files import kept_file

SIZE = WIDTH, HEIGHT = 480, 360

DISTORTION = {"k1": -0.3, "k2": 0.3, "p1": 0.03, "p2": -0.03}
"""Distortion of the photos of one capture."""

GL = np.diag([1.0, -1.0, -1.0, 1.0])


def box_views():
    return [
        View(camera, photograph_box(camera), name=f"box_{i:02d}.png")
        for i, camera in enumerate(box_orbit(14, 4.0, SIZE))
    ]


def off_centre(view):
    """Return a view whose photo lacks a margin on the right, so that its principal point is not in the middle."""
    cut = WIDTH // 8
    camera = replace(view.camera, W=WIDTH - cut)
    return View(camera, np.ascontiguousarray(photograph_box(view.camera)[:, : WIDTH - cut]), name=view.name)


def distorted(view):
    """Photograph with a distorting lens: each pixel shows what the pinhole photo has along its ray."""
    c = view.camera
    K = np.array([[c.fx, 0.0, c.cx], [0.0, c.fy, c.cy], [0.0, 0.0, 1.0]])
    u, v = np.meshgrid(np.arange(c.W, dtype=float), np.arange(c.H, dtype=float))
    pixels = np.stack([u.ravel(), v.ravel()], axis=1)
    seen = cv2.undistortPoints(pixels, K, np.array(list(DISTORTION.values())), P=K).reshape(c.H, c.W, 2)
    maps = seen[..., 0], seen[..., 1]
    photo = cv2.remap(photograph_box(c), *(m.astype(np.float32) for m in maps), cv2.INTER_LINEAR)
    return View(c, photo, name=view.name)


@pytest.fixture(scope="module")
def captures(tmp_path_factory):
    """Write three right captures: a box whose photos are cropped, a box through a distorting lens, and a room."""
    top = tmp_path_factory.mktemp("captures")
    write_transforms(top / "cropped", [off_centre(view) for view in box_views()])
    write_transforms(top / "distorted", [distorted(view) for view in box_views()])
    edit(top / "distorted", lambda frame: {**frame, "camera_model": "OPENCV", **DISTORTION})
    write_transforms(top / "room", room_capture(WIDTH, HEIGHT, 24)[0])
    return top


def edit(folder, change):
    """Change the frames of a transforms.json."""
    path = folder / "transforms.json"
    contents = json.loads(path.read_text())
    contents.pop("camera_model", None)
    contents["frames"] = [change(frame) for frame in contents["frames"]]
    path.write_text(json.dumps(contents))


def posed(function):
    """Change each camera-to-world matrix, which has OpenGL's axes."""
    return lambda frame: {**frame, "transform_matrix": function(np.array(frame["transform_matrix"])).tolist()}


def scaled(**factors):
    return lambda frame: {**frame, **{key: frame[key] * factor for key, factor in factors.items()}}


def renamed(**names):
    """Write the value of one key under another one."""
    return lambda frame: {**frame, **{key: frame[name] for key, name in names.items()}}


def transposed(M):
    M[:3, :3] = M[:3, :3].T.copy()
    return M


def translated(M):
    M[:3, 3] = np.linalg.inv(M)[:3, 3]
    return M


POSES = {
    "OpenCV axes": (posed(lambda M: M @ GL), "the cameras' y and z axes point the other way"),
    "PyTorch3D axes": (posed(lambda M: M @ np.diag([-1.0, 1, -1, 1])), "the cameras' x and z axes"),
    "world to camera": (posed(np.linalg.inv), "the matrices are inverted"),
    "world to camera, OpenCV axes": (posed(lambda M: np.linalg.inv(M @ GL)), "the matrices are inverted"),
    "rotations transposed": (posed(transposed), "the rotations are transposed"),
    "translations for centres": (posed(translated), "centres and translations of the cameras are exchanged"),
}

LENSES = {
    "focal length doubled": (scaled(fl_x=2, fl_y=2), "the focal length is 2 times too long"),
    "focal length halved": (scaled(fl_x=0.5, fl_y=0.5), "the focal length is 2 times too short"),
    "intrinsics of larger photos": (
        scaled(fl_x=2, fl_y=2, cx=2, cy=2),
        "focal length and principal point are those of photos 2 times larger",
    ),
}

SHAPES = {
    "height for width": (
        lambda frame: scaled(fl_x=frame["h"] / frame["w"], fl_y=frame["h"] / frame["w"])(frame),
        "the focal length refers to the photo's height",
    ),
    "width for height": (
        lambda frame: scaled(fl_x=frame["w"] / frame["h"], fl_y=frame["w"] / frame["h"])(frame),
        "the focal length refers to the photo's width",
    ),
    "undistorted photos": (
        # strong, because all matches lie in the middle of the photo, where distortion moves little
        lambda frame: {**frame, "camera_model": "OPENCV", "k1": -0.9, "k2": 0.1},
        "the photos are undistorted already",
    ),
}

CENTRE = {"cx and cy": (renamed(cx="cy", cy="cx"), "column and row of the principal point are exchanged")}

ORDERS = CENTRE | {
    "distortion negated": (scaled(k1=-1, k2=-1, p1=-1, p2=-1), "the distortion has the opposite sign"),
    "p1 and p2": (renamed(p1="p2", p2="p1"), "p1 and p2 are exchanged"),
}

CROPPED = CENTRE | {name: planted for name, planted in SHAPES.items() if name != "width for height"}

PLANTED = {
    "cropped": POSES | LENSES | CROPPED,
    "distorted": POSES | LENSES | ORDERS,
    "room": POSES | LENSES | SHAPES,
}
"""Twelve mistakes in each of the three captures."""


@pytest.mark.parametrize("capture", PLANTED)
def test_a_right_capture_is_not_doubted(captures, capture):
    found = prove(CaptureReader(captures / capture))
    assert found.verdict is Verdict.AGREE
    assert found.error < 1.0
    assert str(found).startswith("The poses agree with the photos: 0.")


@pytest.mark.slow
@pytest.mark.parametrize("name", ["fox", "snowmiku97", "truck11", "poses/opensfm"])
def test_a_real_capture_is_not_doubted(name):
    found = prove(CaptureReader(kept_file(name)))
    assert found.verdict is Verdict.AGREE, found


def test_what_moves_rays_by_a_fraction_of_a_pixel_is_not_claimed(captures, tmp_path):
    """With these coefficients, k1 and k2 exchanged move the median match by 0.1 px, as noise does."""
    shutil.copytree(captures / "distorted", tmp_path / "capture")
    edit(tmp_path / "capture", renamed(k1="k2", k2="k1"))
    found = prove(CaptureReader(tmp_path / "capture"))
    assert found.verdict is Verdict.AGREE
    assert found.error < 0.5


CASES = [
    pytest.param(
        capture,
        name,
        marks=[] if capture == "cropped" and name in POSES else [pytest.mark.slow],
        id=f"{capture}-{name}",
    )
    for capture, mistakes in PLANTED.items()
    for name in mistakes
]


@pytest.mark.parametrize(("capture", "name"), CASES)
def test_a_planted_mistake_is_named_and_undone(captures, tmp_path, capture, name):
    change, said = PLANTED[capture][name]
    shutil.copytree(captures / capture, tmp_path / "capture")
    edit(tmp_path / "capture", change)
    found = prove(CaptureReader(tmp_path / "capture"))
    assert found.verdict is Verdict.MISREAD, found
    assert mistake(found.reading).startswith(said)
    assert found.corrected < 1.0


def test_poses_of_other_photos_are_named(captures, tmp_path):
    """Poses in another order than the photos, which no reading of them can undo."""
    shutil.copytree(captures / "room", tmp_path / "capture")
    path = tmp_path / "capture" / "transforms.json"
    contents = json.loads(path.read_text())
    matrices = [frame["transform_matrix"] for frame in contents["frames"]]
    order = np.random.default_rng(1).permutation(len(matrices))
    for frame, at in zip(contents["frames"], order, strict=True):
        frame["transform_matrix"] = matrices[at]
    path.write_text(json.dumps(contents))
    found = prove(CaptureReader(tmp_path / "capture"))
    assert found.verdict is Verdict.DISAGREE
    assert "other photos or another lens" in str(found)


def test_the_doctor_tells_what_the_photos_say(captures, tmp_path):
    right = examine(prepare(CaptureReader(captures / "cropped")))
    assert "agreement" in right.fine
    assert any(line.startswith("The poses agree with the photos: 0.") for _, line in right.facts)
    shutil.copytree(captures / "cropped", tmp_path / "capture")
    edit(tmp_path / "capture", POSES["OpenCV axes"][0])
    wrong = examine(prepare(CaptureReader(tmp_path / "capture")))
    assert wrong.advice[0].startswith("correct the file of the poses for other programs")
    (said,) = (finding.sentence for finding in wrong.findings if finding.name == "misread poses")
    assert "only if the cameras' y and z axes point the other way" in said


@pytest.mark.parametrize("axes", [GL, np.eye(4)], ids=["OpenGL", "OpenCV"])
def test_points_choose_between_readings_that_differ_by_a_turn_of_the_world(captures, tmp_path, axes):
    """The photos agree with inverted matrices in two worlds; the points are in one of them."""
    views, points, colors = room_capture(WIDTH, HEIGHT, 24)
    write_transforms(tmp_path / "capture", views, points, colors)
    edit(tmp_path / "capture", posed(lambda M: np.linalg.inv(M @ axes)))
    reader = CaptureReader(tmp_path / "capture")
    found = prove(reader)
    assert mistake(found.reading).startswith("the matrices are inverted")
    for frame, view in zip(reader.under(found.reading).capture.frames, views, strict=True):
        np.testing.assert_allclose(frame.R, view.camera.R, atol=1e-9)
        np.testing.assert_allclose(frame.eye, view.camera.eye, atol=1e-9)


def test_blank_photos_prove_nothing(captures, tmp_path):
    shutil.copytree(captures / "room", tmp_path / "capture")
    for path in (tmp_path / "capture").rglob("*.png"):
        cv2.imwrite(str(path), np.full((HEIGHT, WIDTH, 3), 128, np.uint8))
    found = prove(CaptureReader(tmp_path / "capture"))
    assert found.verdict is Verdict.UNCHECKED
    assert str(found) == "The poses were not checked: too few matches between photos"


def test_the_result_does_not_depend_on_the_number_of_threads(captures):
    proofs = []
    for threads in (1, 2):
        cv2.setNumThreads(threads)
        proofs.append(prove(CaptureReader(captures / "cropped")))
    cv2.setNumThreads(-1)
    assert proofs[0] == proofs[1]
