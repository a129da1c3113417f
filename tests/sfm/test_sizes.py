"""Photos from one camera, each scaled to its own size, are mapped with one focal length."""

import json

import pytest

from sfm.engine_check import printed

pytestmark = pytest.mark.usefixtures("colmap")

SCENE = """
import json
from pathlib import Path
from engine import database, jobs

root, COUNT = Path({root!r}), 12
rng = np.random.default_rng(0)
points = rng.uniform(-1, 1, (250, 3)) * [1.4, 1.0, 1.4]
sizes = [(4 * side, 3 * side) for side in rng.permutation(np.arange(60, 60 + 4 * COUNT, 4)).tolist()]


def photo(number):
    # Like most paths, this one constrains the focal length weakly: a third of a turn at one height.
    turn = 2 * np.pi / 3 * number / COUNT
    eye = 4 * np.array([np.sin(turn), -0.4, -np.cos(turn)])
    forward = -eye / np.linalg.norm(eye)
    right = np.cross([0.0, 1.0, 0.0], forward) / np.linalg.norm(np.cross([0.0, 1.0, 0.0], forward))
    R = np.stack([right, np.cross(forward, right), forward])
    W, H = sizes[number]
    local = points @ R.T - R @ eye
    places = 1.1 * W * local[:, :2] / local[:, 2:] + [W / 2, H / 2] + rng.normal(0, 0.4, (len(points), 2))
    return places, np.flatnonzero(((places > 0) & (places < [W, H])).all(axis=1) & (rng.random(len(points)) < 0.5))


seen = []
with database.opened(str(root / "database.db")) as db, pycolmap.DatabaseTransaction(db):
    for number in range(COUNT):
        W, H = sizes[number]
        camera = pycolmap.Camera.create_from_model_name(number + 1, "SIMPLE_RADIAL", 0.85 * W, W, H)
        database.add_camera(db, camera)
        database.add_photo(db, f"{{number:02d}}.png", number + 1, number + 1)
        places, shown = photo(number)
        seen.append(shown)
        db.write_keypoints(number + 1, places[shown].astype(np.float32))
    options = pycolmap.TwoViewGeometryOptions()
    options.ransac.random_seed = 0
    for a in range(COUNT):
        for b in range(a + 1, COUNT):
            _, first, second = np.intersect1d(seen[a], seen[b], return_indices=True)
            both = np.column_stack([first, second]).astype(np.uint32)
            ends = [db.read_keypoints(i + 1)[:, :2].astype(np.float64) for i in (a, b)]
            cameras = [db.read_camera(i + 1) for i in (a, b)]
            geometry = pycolmap.estimate_two_view_geometry(cameras[0], ends[0], cameras[1], ends[1], both, options)
            db.write_matches(a + 1, b + 1, both)
            db.write_two_view_geometry(a + 1, b + 1, geometry)
shared = {{str(number): 1 for number in range(2, COUNT + 1)}}
for mapper in ("incremental", "global"):
    out = root / mapper
    out.mkdir()
    attempt = {{"mapper": mapper, "model": "auto", "free": False, "per_photo": False, "loose": False}}
    cameras = {{"shared": shared, "rig": None}}
    found = jobs.mapping(lambda done: None, str(root / "database.db"), str(root), str(out), attempt, cameras, 1, 0)
    (facts,) = found["models"]
    model = pycolmap.Reconstruction(str(out / facts["folder"]))
    lenses = {{tuple(model.camera(model.image(i).camera_id).params) for i in model.reg_image_ids()}}
    print(json.dumps([len(facts["names"]), model.camera(1).width, sorted(lenses)]))


def apart(path):
    # Median distance of matches from the epipolar lines of the pair's fundamental matrix, px.
    with database.opened(str(path)) as db:
        geometry = db.read_two_view_geometry(2, 5)
        rows = geometry.inlier_matches
        one = np.ones(len(rows))
        a, b = (np.column_stack([db.read_keypoints(i)[rows[:, k], :2], one]) for k, i in enumerate((2, 5)))
    lines = a @ geometry.F.T
    return float(np.median(np.abs((b * lines).sum(axis=1)) / np.linalg.norm(lines[:, :2], axis=1)))


print(json.dumps([apart(root / "database.db"), apart(root / "incremental" / "database.db")]))
"""


def test_photos_of_twelve_sizes_share_a_focal_length(tmp_path):
    *models, (before, after) = map(json.loads, printed(SCENE.format(root=str(tmp_path))))
    assert len(models) == 2, "both mappers ran"
    for count, width, lenses in models:
        ((focal, *middle, _),) = lenses
        assert count == 12
        # 0.4 px of noise on about 1,000 observations leaves an error well below 1 %.
        assert focal / width == pytest.approx(1.1, rel=0.01) and middle == [width / 2, 0.375 * width]
    assert before < 1 and after < 2 * before, "photos are enlarged up to 1.7 times"
