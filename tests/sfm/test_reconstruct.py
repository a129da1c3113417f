import itertools
import json
import shutil
import sqlite3
from contextlib import closing
from dataclasses import asdict, replace

import cv2
import numpy as np
import pytest
from PIL import Image

from gsplat_edu.base.errors import ArgumentError, DatasetError
from gsplat_edu.data.colmap import read_cameras
from gsplat_edu.data.dataset import DataSettings, load_dataset
from gsplat_edu.scene.camera import Camera
from gsplat_edu.sfm.colmap import call
from gsplat_edu.sfm.mapping import attempts, map_photos
from gsplat_edu.sfm.reconstruct import SfmOptions, reconstruct
from gsplat_edu.sfm.result import publish, published
from gsplat_edu.sfm.source import needs_poses
from lab.captures.textured_box import align_cameras, box_orbit, photograph_box
from sfm.textured_box import LIMIT, TURNED, cameras_of, check

pytestmark = pytest.mark.usefixtures("colmap")

STAGES = ("photos", "features", "matches", "mapping", "capture")


def test_every_photo_gets_its_pose(done):
    found = cameras_of(done.out)
    assert set(found) == set(done.truth)
    R = check(found, done.truth)
    for name, camera in found.items():
        assert (camera.W, camera.H) == (done.truth[name].W, done.truth[name].H), (
            "photos are upright and of full size"
        )
        assert abs(camera.fx / 352 - 1) < 0.03

    # up is the true one, because the true cameras are level
    assert np.degrees(np.arccos(R[1, 1])) < TURNED
    eyes = np.stack([camera.eye for camera in found.values()])
    first = found[min(found)]
    assert abs(np.median(np.linalg.norm(eyes, axis=1)) - 5) < 1e-6, "the cameras look at the origin, 5 away"
    assert abs(first.R[2, 0]) < 1e-6 and first.R[2, 2] > 0, "the first photo looks along +z"


def test_photos_are_upright_and_undistorted(done):
    """Undistortion moves each quarter of a photo by less than a pixel. The true cameras have no distortion, so
    undistortion moves pixels only by the error of the estimated lens. A texture of white noise, blurred by s px and
    moved by d px, keeps a correlation of exp(-d²/4s²) with itself: 0.94 at d = 1 and s = 2.
    """
    for view in load_dataset(done.out, DataSettings(test_every=0)).train:
        taken, written = (
            cv2.GaussianBlur(image.astype(np.float32).mean(axis=2), (0, 0), 2)
            for image in (photograph_box(done.truth[view.name]), view.read().image)
        )
        H, W = taken.shape
        assert written.shape == taken.shape
        for quarter in itertools.product(
            (slice(20, H // 2), slice(H // 2, -20)), (slice(20, W // 2), slice(W // 2, -20))
        ):
            shift, _ = cv2.phaseCorrelate(
                np.ascontiguousarray(taken[quarter]), np.ascontiguousarray(written[quarter])
            )
            assert np.hypot(*shift) < 1, (view.name, quarter)
            assert np.corrcoef(taken[quarter].ravel(), written[quarter].ravel())[0, 1] > 0.94, (
                view.name,
                quarter,
            )


def test_points_lie_on_the_box_and_the_floor(done):
    dataset = load_dataset(done.out, DataSettings(test_every=0))
    found = {view.name: view.camera for view in dataset.train}
    names = sorted(found)
    a, b = (np.stack([cameras[name].eye for name in names]) for cameras in (found, done.truth))
    R = align_cameras(found, done.truth).R
    s = np.linalg.norm(b - b.mean(axis=0)) / np.linalg.norm(a - a.mean(axis=0))
    points = s * (dataset.points - a.mean(axis=0)) @ R.T + b.mean(axis=0)
    floor = np.abs(points[:, 1])
    beyond = np.abs(points - [0.0, -0.5, 0.0]) - [0.7, 0.5, 0.5]
    box = np.abs(beyond.max(axis=1))
    # Two pixels at a distance of 4, along a ray that meets the floor at 45 degrees or less.
    assert np.mean(np.minimum(floor, box) < 4 * 2 * 4 / 352) > 0.9
    assert len(points) > 300
    assert dataset.colors.std() > 0.05, "points have the colours of the photos"


def test_progress_counts_photos_and_pairs(done):
    stages = list(dict.fromkeys(stage for stage, _, _ in done.progress))
    assert stages == ["photos", "features", "matches", "mapping", "writing photos"]
    last = {stage: (count, total) for stage, count, total in done.progress}
    pairs = 14 * 13 // 2
    assert last == {stage: (pairs, pairs) if stage == "matches" else (14, 14) for stage in stages}
    assert [sentence.split(":")[0] for sentence in done.said] == list(STAGES)
    assert "14 from one camera" in done.said[0], "the sensor is the same in either orientation"
    assert "14 of 14 photos have a pose (incremental mapper, SIMPLE_RADIAL)" in done.said[3], (
        "few photos determine only a simple lens"
    )
    assert "COLMAP" not in done.said[0] and (done.out / "sfm" / "log.txt").stat().st_size > 1000


def test_only_the_capture_and_its_work_folder_remain(done):
    assert sorted(path.name for path in done.out.iterdir()) == ["images", "sfm", "sparse"]
    assert {"result", "old"} & {path.name for path in (done.out / "sfm").iterdir()} == set()


def test_a_finished_run_does_nothing(done):
    before = {path: path.stat().st_mtime_ns for path in done.out.rglob("*.bin")}
    said = []
    reconstruct(done.options, said.append)
    assert all(sentence.endswith("(done before)") for sentence in said) and len(said) == len(STAGES)
    assert {path: path.stat().st_mtime_ns for path in done.out.rglob("*.bin")} == before


class StoppedError(Exception):
    pass


@pytest.mark.slow
def test_an_interrupted_run_resumes_after_the_last_completed_stage(done, phone, tmp_path):
    """With one thread, an interrupted run gives the bits of an uninterrupted one."""
    options = SfmOptions(phone.folder, tmp_path / "capture", max_features=LIMIT, threads=1)
    for finished, stage in enumerate(("photos", "features", "matches", "mapping", "writing photos")):
        said = []

        def stop(now, count, total, stage=stage):
            if now == stage and count > 0:
                raise StoppedError

        with pytest.raises(StoppedError):
            reconstruct(options, said.append, stop)
        assert [sentence.split(":")[0] for sentence in said] == list(STAGES[:finished])
        again = [sentence.endswith("(done before)") for sentence in said]
        assert again == [True] * (finished - 1) + [False] * (finished > 0), stage
        assert not (options.out / "sparse").exists(), "no capture appears before it is complete"
    said = []
    reconstruct(options, said.append)
    assert [sentence.endswith("(done before)") for sentence in said] == [True] * 4 + [False]

    whole, parts = cameras_of(done.out), cameras_of(options.out)
    assert set(parts) == set(whole)
    for name in whole:
        np.testing.assert_array_equal(parts[name].R, whole[name].R)
        np.testing.assert_array_equal(parts[name].eye, whole[name].eye)

    # With changed options, the first stage that uses them and all later stages run again, and replace the result.
    said = []
    reconstruct(replace(options, camera_model="SIMPLE_RADIAL", threads=0), said.append)
    assert said[3] == "mapping: camera_model changed; repeating this stage and the later ones"
    assert [sentence.endswith("(done before)") for sentence in said] == [True] * 3 + [False] * 3
    assert set(cameras_of(options.out)) == set(whole)


@pytest.fixture
def copied(done, tmp_path):
    """A copy of the finished capture."""
    shutil.copytree(done.out, tmp_path / "copy")
    return replace(done.options, out=tmp_path / "copy")


def test_missing_undistorted_photos_are_written_again(copied):
    shutil.rmtree(copied.out / "images")
    said = []
    reconstruct(copied, said.append)
    assert [sentence.endswith("(done before)") for sentence in said] == [True] * 4 + [False]
    assert len(cameras_of(copied.out)) == 14


def test_masks_that_no_run_wrote_are_kept(copied):
    mask = copied.out / "masks" / "mine.png"
    mask.parent.mkdir()
    mask.write_text("mine")
    reconstruct(replace(copied, camera_model="SIMPLE_RADIAL"))
    assert mask.read_text() == "mine" and published(copied.out / "sfm") == ("images", "sparse")


def test_publishing_over_foreign_files_is_refused(tmp_path):
    work, out = tmp_path / "out" / "sfm", tmp_path / "out"
    for part in ("images", "masks", "sparse"):
        (work / "result" / part).mkdir(parents=True)
    (out / "masks").mkdir()
    (out / "masks" / "mine.png").write_text("mine")
    with pytest.raises(ArgumentError, match="masks was not written by this command; move it away"):
        publish(work, out)
    assert (out / "masks" / "mine.png").is_file() and not (out / "images").exists()
    (out / "masks").rename(out / "kept")
    publish(work, out)
    assert published(work) == ("images", "masks", "sparse")
    (work / "result" / "images").mkdir(parents=True)
    publish(work, out)
    assert sorted(path.name for path in out.iterdir()) == ["images", "kept", "sfm"], (
        "the files of an earlier run are replaced"
    )


def test_photos_added_before_a_run_finished_are_not_overwritten(phone, tmp_path):
    options = SfmOptions(phone.folder, tmp_path / "out")

    def stop(*progress):
        raise StoppedError

    with pytest.raises(StoppedError):
        reconstruct(options, progress=stop)
    with pytest.raises(StoppedError):
        reconstruct(options, progress=stop)  # a resumed run accepts its own work folder
    (options.out / "images").mkdir()
    with pytest.raises(ArgumentError, match="already holds photos or poses"):
        reconstruct(options)


def test_matches_of_an_earlier_matcher_are_removed(copied, monkeypatch):
    def count(table):
        with closing(sqlite3.connect(copied.out / "sfm" / "database.db")) as reader:
            return reader.execute(f"SELECT COUNT(*) FROM {table}").fetchone()[0]

    features = count("descriptors")
    chosen = {(0, 5), (5, 10)}  # the neighbours IMG_00, IMG_01 and IMG_02
    monkeypatch.setattr("gsplat_edu.sfm.pairs.sequential_pairs", lambda total, overlap: chosen)
    assert count("matches") == 91
    with pytest.raises(StoppedError):
        reconstruct(replace(copied, matcher="sequential"), progress=_stop_at_mapping)
    assert count("two_view_geometries") == count("matches") == 2
    assert count("descriptors") == features


@pytest.mark.parametrize("first", ["leaves one out", "fails"])
def test_photos_that_likely_pairs_do_not_place_are_matched_with_all_others(likely, monkeypatch, first):
    map_once = prepared(likely, monkeypatch, {(0, 5), *itertools.combinations(range(1, 14), 2)}, first)
    said = []
    reconstruct(likely, said.append)
    assert map_once.calls == 2 and len(cameras_of(likely.out)) == 14
    with closing(sqlite3.connect(likely.out / "sfm" / "database.db")) as reader:
        assert reader.execute("SELECT COUNT(*) FROM matches").fetchone()[0] == 91
    count = 1 if first == "leaves one out" else 14
    assert any(f"{count} photo" in line and "matching more of their pairs" in line for line in said)
    assert [line.split(":")[0] for line in said if line.endswith(" s)")][-3:] == [
        "more matches",
        "mapping again",
        "capture",
    ]
    if first == "leaves one out":
        said.clear()
        reconstruct(likely, said.append)
        assert map_once.calls == 2, "a finished run is not mapped again"


@pytest.mark.parametrize("first", ["leaves one out", "fails"])
def test_photos_without_further_matches_are_not_mapped_again(likely, monkeypatch, first):
    map_once = prepared(likely, monkeypatch, set(itertools.combinations(range(14), 2)), first)
    if first == "fails":
        with pytest.raises(DatasetError, match="not enough"):
            reconstruct(likely)
    else:
        reconstruct(likely)
        assert len(cameras_of(likely.out)) == 13
    assert map_once.calls == 1


@pytest.fixture
def likely(copied):
    """A copy of the finished capture, whose photos are to be matched anew in likely pairs."""
    return replace(copied, matcher="likely")


def prepared(options, monkeypatch, pairs, first):
    """Choose the likely pairs, and how the first mapping ends; the function that replaces it counts its calls."""
    monkeypatch.setattr("gsplat_edu.sfm.likely.likely_pairs", lambda *choice: pairs)

    def mapped(*arguments):
        mapped.calls += 1
        if mapped.calls == 1 and first == "fails":
            raise DatasetError("not enough")
        model = map_photos(*arguments)
        if mapped.calls == 1:
            model["names"] = sorted(model["names"])[1:]
        return model

    mapped.calls = 0
    monkeypatch.setattr("gsplat_edu.sfm.reconstruct.map_photos", mapped)
    return mapped


def _stop_at_mapping(stage, count, total):
    if stage == "mapping":
        raise StoppedError


@pytest.mark.slow
def test_the_global_mapper_with_selected_pairs_finds_the_poses(done, tmp_path):
    """Select pairs by appearance and sequence instead of matching all."""
    out = tmp_path / "capture"
    options = replace(done.options, out=out, matcher="nearest", mapper="global")
    said = []
    reconstruct(options, said.append)
    check(cameras_of(out), done.truth)
    assert "global mapper" in said[3]


@pytest.mark.slow
def test_unusable_photos_are_named_and_left_out(phone, tmp_path):
    folder = tmp_path / "photos"
    folder.mkdir()
    for i, camera in enumerate(box_orbit(8, turn=2.5)):
        Image.fromarray(photograph_box(camera)).save(folder / f"good_{i}.jpg", quality=95)
    noise = np.random.default_rng(0).integers(0, 255, (240, 320, 3)).astype(np.uint8)
    Image.fromarray(noise).save(folder / "noise.png")
    (folder / "broken.jpg").write_bytes((folder / "good_0.jpg").read_bytes()[:3000])
    (folder / "notes.txt").write_text("not a photo")
    (folder / "textures").mkdir()
    Image.fromarray(noise).save(folder / "textures" / "atlas.png")
    said = []
    reconstruct(SfmOptions(folder, tmp_path / "out", max_image_size=300), said.append)
    found = cameras_of(tmp_path / "out")
    assert sorted(found) == [f"good_{i}.jpg" for i in range(8)]
    assert all((camera.W, camera.H) == (320, 240) for camera in found.values())
    words = "\n".join(said)
    assert "left out, cannot be decoded: broken.jpg" in words
    assert "left out, no pose was found: noise.png" in words
    assert "8 of 9 photos" in words and "the other one shares too little with them" in words


def test_a_job_that_fails_names_its_log(tmp_path):
    with pytest.raises(
        DatasetError, match=r"failed with code 1: see the last lines of .*log\.txt"
    ) as failure:
        call(
            "finish",
            tmp_path / "log.txt",
            model=str(tmp_path),
            out="",
            rotation=[],
            move=[],
            scale=1,
            photos={},
        )
    assert "\n" not in str(failure.value)
    assert "Traceback" in (tmp_path / "log.txt").read_text()


def test_a_damaged_list_of_stages_is_reported_in_one_line(done, tmp_path):
    (tmp_path / "sfm").mkdir()
    (tmp_path / "sfm" / "stages.json").write_text(json.dumps({"stages": {"photos": 3}}))
    with pytest.raises(DatasetError, match=r"stages\.photos: is 3, but has to be an object; remove .*sfm"):
        reconstruct(replace(done.options, out=tmp_path))


def test_which_sources_need_poses(done, phone, tmp_path):
    assert needs_poses(phone.folder)
    assert not needs_poses(done.out)
    assert needs_poses("walk.MP4") is False, "the file does not exist"
    (tmp_path / "walk.MP4").write_bytes(b"")
    assert needs_poses(tmp_path / "walk.MP4")
    assert not needs_poses(tmp_path), "a folder without photos"
    assert not needs_poses(tmp_path / "gone")


def test_the_feature_limit_is_exact(done):
    """COLMAP's own limit keeps whole scale levels, and counts keypoints, some of which have two features."""
    with closing(sqlite3.connect(done.out / "sfm" / "database.db")) as reader:
        (most,) = reader.execute("SELECT MAX(rows) FROM keypoints").fetchone()
    assert most == LIMIT
    with closing(sqlite3.connect(done.out / "sfm" / "database.db")) as reader:
        for table, size in (("keypoints", 4), ("descriptors", 1)):
            rows = reader.execute(f"SELECT rows, cols, LENGTH(data) FROM {table}").fetchall()
            assert all(length == size * count * columns for count, columns, length in rows)


@pytest.mark.slow
def test_focal_lengths_from_exif_separate_two_cameras(tmp_path):
    """The two cameras have different zooms and photo sizes."""
    folder, truth = tmp_path / "photos", {}
    folder.mkdir()
    for i, near in enumerate(box_orbit(12, turn=3.5)):
        camera = near
        if i % 2:
            camera = Camera(near.R, near.eye, 600.0, 600.0, 199.5, 149.5, 300, 400)
        name = f"{'zoom' if i % 2 else 'wide'}_{i:02d}.jpg"
        exif = Image.Exif()
        exif[0x0110] = "Phone"
        # The diagonal of the film is 43.27 mm, those of the photos are 400 and 500 px. EXIF stores integers.
        exif.get_ifd(0x8769)[0xA405] = round(43.27 * camera.fx / np.hypot(camera.W, camera.H))
        truth[name] = camera
        Image.fromarray(photograph_box(camera)).save(folder / name, quality=95, exif=exif)
    said = []
    reconstruct(SfmOptions(folder, tmp_path / "out"), said.append)
    assert "12 from 2 kinds of camera or zoom; 12 with a focal length in EXIF" in said[0]
    found = cameras_of(tmp_path / "out")
    assert set(found) == set(truth)
    check(found, truth)
    for name, camera in found.items():
        assert abs(camera.fx / truth[name].fx - 1) < 0.03
        assert (camera.W, camera.H) == (truth[name].W, truth[name].H)


def test_the_last_attempt_registers_most_photos(done, tmp_path):
    """The last attempt uses a camera per photo and lower thresholds."""
    way = attempts("auto", "auto", 14, 1, one_lens=False)[-1]
    work, progress = done.out / "sfm", []
    models = call(
        "mapping",
        tmp_path / "log.txt",
        progress.append,
        database=str(work / "database.db"),
        photos=str(work / "photos"),
        out=str(tmp_path),
        attempt=asdict(way),
        cameras={"shared": {}, "rig": None},
        threads=1,
        seed=0,
    )["models"]
    best = max(models, key=lambda model: len(model["names"]))
    assert len(best["names"]) >= 12 and max(progress) >= 12
    lenses = read_cameras(tmp_path / best["folder"] / "cameras.bin")
    assert len({lens.fx for lens in lenses.values()}) >= 12
