import numpy as np
import pytest

from gsplat_edu.base.errors import DatasetError
from gsplat_edu.data.lens import Lens
from gsplat_edu.scene.camera import Camera
from gsplat_edu.sfm import mapping
from gsplat_edu.sfm.mapping import MANY_PHOTOS, Attempt, attempts, best_model, shared_cameras
from gsplat_edu.sfm.photos import PhotoFacts
from gsplat_edu.sfm.result import QUARTER, output_names
from sfm.databases import write_database, write_photos


def test_attempts_vary_mapper_lens_thresholds_and_cameras_in_turn():
    assert attempts("auto", "auto", 50, 1, one_lens=False) == [
        Attempt("incremental", "auto"),
        Attempt("global", "auto"),
        Attempt("incremental", "auto", free=True),
        Attempt("incremental", "auto", loose=True),
        Attempt("incremental", "auto", per_photo=True, loose=True),
    ]


def test_video_frames_always_share_a_camera():
    assert not any(way.per_photo for way in attempts("auto", "auto", 50, 1, one_lens=True))


def test_a_lens_is_freed_only_with_twenty_photos_per_camera():
    """A free lens is judged on held-out photos, so with too few photos no lens is freed."""
    for photos, cameras, free in ((19, 1, False), (20, 1, True), (59, 3, False)):
        ways = attempts("auto", "auto", photos, cameras, one_lens=True)
        assert {way.model for way in ways} == {"auto"}
        assert any(way.free for way in ways) == free


def test_a_lens_named_by_the_user_is_kept():
    assert not any(way.free for way in attempts("auto", "RADIAL", 50, 1, one_lens=True))


def test_mapper_and_lens_named_by_the_user_are_kept():
    ways = attempts("global", "OPENCV_FISHEYE", 50, 1, one_lens=False)
    assert {(way.mapper, way.model) for way in ways} == {("global", "OPENCV_FISHEYE")}


def test_many_photos_are_mapped_globally_first():
    assert attempts("auto", "auto", MANY_PHOTOS + 1, 1, one_lens=True)[0].mapper == "global"
    assert attempts("auto", "auto", MANY_PHOTOS, 1, one_lens=True)[0].mapper == "incremental"


def test_attempts_have_descriptions():
    assert str(Attempt("global", "OPENCV")) == "global mapper, OPENCV"
    last = attempts("auto", "auto", 50, 1, one_lens=False)[-1]
    assert str(last) == "incremental mapper, a camera per photo, lower thresholds"


@pytest.mark.parametrize("turns", [0, 1, 2, 3])
def test_a_turned_lens_projects_to_the_turned_pixel(turns):
    """A point projects to the place of its pixel in the rotated photo."""
    lens = Lens(40, 30, 50.0, 55.0, 18.0, 16.5)
    point = np.array([0.11, -0.07, 0.9])
    u, v, _ = Camera(np.eye(3), np.zeros(3), 50.0, 55.0, 18.0, 16.5, 30, 40).project(point)
    after = lens.turned(turns)
    R = np.linalg.matrix_power(QUARTER, turns)
    camera = Camera.posed(R, np.zeros(3), after)
    photo = np.zeros((30, 40))
    rows, columns = np.mgrid[:30, :40]
    photo = np.rot90(np.hypot(columns - u, rows - v), -turns)  # smallest where the point is
    found = camera.project(camera.world_to_cam(point))
    expected = np.unravel_index(photo.argmin(), photo.shape)
    assert photo.shape == (after.H, after.W)
    assert np.hypot(found[0] - expected[1], found[1] - expected[0]) <= 2**-0.5


def test_an_output_file_never_has_the_name_of_a_folder():
    photos = [PhotoFacts(name, "", 1, 1) for name in ("a.tif", "A.png/1.png", "b.tif", "c/b.png/1.jpg")]
    assert output_names(photos) == ["a_2.png", "A.png/1.png", "b.png", "c/b.png/1.jpg"]


WAYS = attempts("auto", "auto", 9, 1, one_lens=True)


def model(numbers, agreement=1.0, steady=100, error=0.5):
    """Return the result of the job "mapping" for a model of the given photos."""
    names = [f"{i}.jpg" for i in numbers]
    facts = {
        "folder": "0",
        "doubtful": [],
        "unclear": [],
        "points": 200,
        "lens": "SIMPLE_RADIAL",
        "per_photo": False,
    }
    return facts | {"names": names, "agreement": agreement, "steady": steady, "error": error}


@pytest.fixture
def mapped(monkeypatch, tmp_path):
    """Map ten photos by several attempts: each registers the given number of photos, or fails if it is None."""

    def run(*counts):
        tried, said = [], []

        def job(name, log, progress, **arguments):
            count = counts[len(tried)]
            tried.append(arguments["attempt"])
            if count is None:
                raise DatasetError(f"COLMAP's mapping failed, number {len(tried)}")
            return {"models": [model(range(count))]}

        monkeypatch.setattr(mapping, "call", job)
        monkeypatch.setattr(mapping, "without_implausible_lenses", lambda out, model: model)
        ways = WAYS[: len(counts)]
        try:
            best = mapping.map_photos(
                tmp_path, ways, mapping.Cameras({}), 10, 10, 1, said.append, lambda *progress: None
            )
        except DatasetError as error:
            best = error
        return best, len(tried), said

    assert len(WAYS) == 3
    return run


def test_attempts_stop_once_most_photos_are_registered(mapped):
    best, tried, said = mapped(4, 9, 10)
    assert tried == 2 and len(best["names"]) == 9
    assert best["folder"] == "models/2/0" and best["way"] == f"{WAYS[1]}, SIMPLE_RADIAL"
    assert said == [f"{WAYS[0]}: 4 of 10 photos have a pose that counts"]
    assert mapped(8, 9, 10)[1] == 1, "an attempt that registers 80 % is the last"


def test_the_largest_model_is_kept_if_no_attempt_registers_most_photos(mapped):
    best, tried, said = mapped(4, 7, 5)  # no two models have the same photos
    assert tried == 3 and len(best["names"]) == 7 and best["way"] == f"{WAYS[1]}, SIMPLE_RADIAL"
    assert said == [
        f"{way}: {count} of 10 photos have a pose that counts"
        for way, count in zip(WAYS, (4, 7, 5), strict=True)
    ]


def test_the_next_attempt_follows_a_failed_one(mapped):
    best, tried, said = mapped(None, 9, 10)
    assert tried == 2 and len(best["names"]) == 9
    assert said == [f"{WAYS[0]}: COLMAP's mapping failed, number 1"]
    best, tried, said = mapped(4, None, None)
    assert tried == 3 and len(best["names"]) == 4 and len(said) == 3
    best, tried, said = mapped(None, None, None)
    assert tried == 3 and str(best) == "COLMAP's mapping failed, number 3" and len(said) == 2


def test_output_names_keep_folders_and_match_the_file_type():
    names = [
        "a/IMG 1.JPG",
        "a/b.webp",
        "a/b.tif",
        "b.png",
        "B.tiff",
        "new\nline.jpg",
        "no_ending",
        "x\\y.jpeg",
    ]
    photos = [PhotoFacts(name, "", 1, 1) for name in names]
    assert output_names(photos) == [
        "a/IMG 1.JPG",
        "a/b.png",
        "a/b_2.png",
        "b.png",
        "B_2.png",
        "new_line.jpg",
        "no_ending.png",
        "x_y.jpeg",
    ]


def test_a_model_contradicted_by_its_matches_loses_despite_more_poses():
    sound, wrong = model(range(26), agreement=0.95), model(range(40), agreement=0.4, steady=300, error=0.1)
    assert best_model([wrong, sound]) is sound
    assert best_model([model(range(20)), sound]) is sound


def test_ties_between_models_are_broken_by_steady_points_then_error():
    thin, dense = model(range(30), steady=50, error=0.1), model(range(30), steady=100, error=0.5)
    assert best_model([thin, dense]) is dense
    assert best_model([dense, model(range(30), steady=99, error=0.4)])["error"] == 0.4


def test_photos_with_their_own_camera_count_six_eighths():
    """Such a photo has eight unknowns instead of six, so 26.7 of them count as 20 photos that share a camera."""
    shared = model(range(20))
    for count, taken in ((25, False), (27, False), (28, True)):
        free = model(range(count), error=0.1) | {"per_photo": True}
        assert (best_model([shared, free]) is free) == taken, count
    assert best_model([free]) is free


def group(count, W, H, kind=""):
    return {"names": [str(i) for i in range(count)], "width": W, "height": H, "kind": kind}


def test_photos_of_many_sizes_share_a_camera():
    sizes = [
        group(1, 320, 240),
        group(1, 333, 250),
        group(2, 640, 480),
        group(1, 401, 301),
        group(1, 280, 210),
    ]
    assert shared_cameras(sizes) == {1: 3, 2: 3, 4: 3, 5: 3}, "the group has the camera of the largest photos"
    others = [group(1, 240, 320), group(1, 320, 180), group(1, 160, 120, kind="Canon"), group(10, 320, 240)]
    assert shared_cameras([*sizes, *others[:3]]) == {1: 3, 2: 3, 4: 3, 5: 3}, (
        "other aspect ratios and other cameras are not merged"
    )
    assert shared_cameras([*sizes, others[3]]) == {}, "most photos have one size, so no cameras are merged"
    mixed = [*sizes, group(9, 800, 450), group(10, 800, 600)]
    assert shared_cameras(mixed) == {1: 3, 2: 3, 4: 3, 5: 3}, "a group of ten photos keeps its own camera"


def test_attempts_stop_once_two_models_agree(mapped):
    best, tried, _ = mapped(6, 6, 7)
    assert tried == 2 and len(best["names"]) == 6, "two attempts register the same six photos"


def test_the_error_gives_the_reason_why_there_are_no_poses(mapped, tmp_path):
    """Ten photos with 500 features each, whose 45 pairs match, most of them without parallax."""
    write_database(tmp_path / "database.db", [500] * 10, [(40, 6)] * 30 + [(40, 3)] * 15)
    write_photos(tmp_path / "photos", 10)
    best, _, _ = mapped(0, 0, 0)
    assert str(best).startswith(
        "none of 10 photos has a pose that counts; 10 of them are connected by matches; "
    )
    assert "500 features a photo, 45 of 45 pairs match with 40 inliers" in str(best)
    assert "67 % of them without parallax: photos from one spot" in str(best) and "\n" not in str(best)
