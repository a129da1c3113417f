"""A smaller, sound model is preferred to a global model with wrong poses, which `doctor` reports.

The models are synthetic, because no input makes a mapper fail in a given way.
"""

import json
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image

from gsplat_edu.data.colmap import read_images
from gsplat_edu.data.reader import CaptureReader
from gsplat_edu.doctor.before import examine
from gsplat_edu.sfm import mapping
from gsplat_edu.survey.capture import prepare
from gsplat_edu.survey.finding import Severity
from sfm.engine_check import printed

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("colmap")]

SOUND, ALL = 26, 40

MODELS = """
from pathlib import Path
from engine.database import add_camera, add_photo, opened

root, SOUND, ALL = Path({root!r}), {sound}, {all}
rng = np.random.default_rng(0)
points = rng.normal(size=(400, 3))
points /= np.linalg.norm(points, axis=1)[:, None] * rng.uniform(1.0, 2.0, 400)[:, None]
camera = pycolmap.Camera(model="SIMPLE_RADIAL", width=320, height=240, params=[352, 160, 120, 0], camera_id=1)


def pose(number):
    # A wrong camera is 20 times too far away, or looks 30 degrees past the object.
    turn = 2 * np.pi * number / ALL
    away = 20.0 if number > SOUND and number % 2 else 1.0
    eye = 4 * away * np.array([np.sin(turn), 0.2 * np.sin(3 * turn), -np.cos(turn)])
    forward = -eye / np.linalg.norm(eye)
    right = np.cross([0.0, 1.0, 0.0], forward)
    right /= np.linalg.norm(right)
    R = np.stack([right, np.cross(forward, right), forward])
    if number > SOUND and away == 1.0:
        R = pycolmap.Rotation3d(np.array([0.0, np.radians(30), 0.0])).matrix() @ R
    return pycolmap.Rigid3d(np.column_stack([R, -R @ eye]))


poses = {{number: pose(number) for number in range(1, ALL + 1)}}
seen, places = {{}}, {{}}
for number in poses:
    local = points @ poses[number].rotation.matrix().T + poses[number].translation
    found = np.array(camera.img_from_cam(local))
    shown = np.flatnonzero((local[:, 2] > 0) & (found > 0).all(axis=1) & (found < [320, 240]).all(axis=1))
    some = rng.permutation(shown)[: 120 if number <= SOUND else 2 + number % 10]
    seen[number], places[number] = some, found[some] + rng.normal(0, 0.2, (len(some), 2))


def model(count):
    made = pycolmap.Reconstruction()
    made.add_camera_with_trivial_rig(camera)
    tracks = {{}}
    for number in range(1, count + 1):
        image = pycolmap.Image(name=f"{{number:02d}}.png", keypoints=places[number], camera_id=1, image_id=number)
        made.add_image_with_trivial_frame(image, poses[number])
        for index, point in enumerate(seen[number]):
            tracks.setdefault(int(point), []).append(pycolmap.TrackElement(number, index))
    for point, elements in sorted(tracks.items()):
        if len(elements) > 1:
            made.add_point3D(points[point], pycolmap.Track(elements), np.zeros(3, np.uint8))
    made.update_point_3d_errors()
    return made


for name, count in (("incremental", SOUND), ("global", ALL)):
    folder = root / name / "sparse" / "0"
    folder.mkdir(parents=True)
    model(count).write_binary(folder)
with opened(str(root / "database.db")) as db, pycolmap.DatabaseTransaction(db):
    add_camera(db, camera)
    for number in poses:
        add_photo(db, f"{{number:02d}}.png", number, 1)
        db.write_keypoints(number, places[number].astype(np.float32))
    for a in poses:
        for b in range(a + 1, ALL + 1):
            _, first, second = np.intersect1d(seen[a], seen[b], return_indices=True)
            if len(first) >= 2:
                both = np.column_stack([first, second]).astype(np.uint32)
                geometry = pycolmap.TwoViewGeometry()
                geometry.config, geometry.inlier_matches = pycolmap.TwoViewGeometryConfiguration.CALIBRATED, both
                db.write_two_view_geometry(a, b, geometry)
                db.write_matches(a, b, both)
"""

JOB = """
import json
from engine import jobs

jobs.incremental = jobs.all_at_once = lambda *_: {{0: pycolmap.Reconstruction({model!r})}}
print(json.dumps(jobs.mapping(lambda done: None, **json.loads({order!r}))))
"""


@pytest.fixture(scope="module")
def models(colmap, tmp_path_factory):
    """Two models of the photos, each written as a capture, and the matches that both have."""
    root = tmp_path_factory.mktemp("models")
    printed(MODELS.format(root=str(root), sound=SOUND, all=ALL))
    rng = np.random.default_rng(1)
    for name, count in (("incremental", SOUND), ("global", ALL)):
        (root / name / "images").mkdir()
        for number in range(1, count + 1):
            pixels = rng.integers(0, 255, (240, 320, 3)).astype(np.uint8)
            Image.fromarray(pixels).save(root / name / "images" / f"{number:02d}.png")
    weak = [f"{number:02d}.png" for number in range(SOUND + 1, ALL + 1)]
    return SimpleNamespace(root=root, weak=weak, photos=root / "global" / "images")


def test_the_sound_model_is_chosen_over_one_with_more_poses(models, tmp_path, monkeypatch):
    """The global model has more poses, one for each of the 40 photos."""

    answers = {}

    def job(name, log, progress, **arguments):
        order = json.dumps(arguments | {"photos": str(models.photos)})
        model = models.root / arguments["attempt"]["mapper"] / "sparse" / "0"
        answer = json.loads(printed(JOB.format(model=str(model), order=order))[-1])
        return answers.setdefault(arguments["attempt"]["mapper"], answer)

    monkeypatch.setattr(mapping, "call", job)
    (tmp_path / "database.db").write_bytes((models.root / "database.db").read_bytes())
    ways = mapping.attempts("auto", "SIMPLE_RADIAL", ALL, 1, one_lens=True)
    said = []
    best = mapping.map_photos(
        tmp_path, ways, mapping.Cameras({}), ALL, ALL, 1, said.append, lambda *progress: None
    )
    sound = [f"{number:02d}.png" for number in range(1, SOUND + 1)]
    assert best["names"] == sound
    assert said[0] == "incremental mapper, SIMPLE_RADIAL: 26 of 40 photos have a pose that counts"
    assert [line.partition(":")[0] for line in said] == ["incremental mapper, SIMPLE_RADIAL"], (
        "one message, because both attempts agree"
    )
    centres = [np.linalg.norm(pose.shift) for pose in read_images(tmp_path / best["folder"] / "images.bin")]
    assert len(centres) == SOUND and max(centres) < 1.5 * min(centres), "no camera is far away"
    (left,) = answers["global"]["models"]
    assert left["names"] == sound and left["doubtful"] == models.weak, "alone, the model would be accepted"


def test_doctor_names_the_wrong_poses_of_the_global_model(models):
    findings = examine(prepare(CaptureReader(models.root / "global"))).findings
    (finding,) = [f for f in findings if f.name == "doubtful poses"]
    assert finding.severity is Severity.WARNING
    assert list(finding.images) == models.weak
    far = [label for label in finding.labels if "times as far as the others" in label]
    assert len(far) == 7
    sound = examine(prepare(CaptureReader(models.root / "incremental"))).findings
    assert not [f for f in sound if f.name in ("doubtful poses", "facing away")]
