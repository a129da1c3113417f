"""region.json: read strictly, used by train, stored in the run, and of no effect on other commands."""

import json

import cv2
import numpy as np
import pytest
from PIL import Image

from gsplat_edu.base.errors import DatasetError
from gsplat_edu.cli.main import main
from gsplat_edu.data.dataset import DataSettings, load_dataset
from gsplat_edu.data.procedural import procedural_capture
from gsplat_edu.data.region import REGION, read_region, write_region
from gsplat_edu.data.region_masks import AROUND
from gsplat_edu.data.writers import write_colmap
from gsplat_edu.runs.folder import RunFolder
from gsplat_edu.scene.camera import Camera
from gsplat_edu.scene.region import Region, seen_in

BOX = Region(np.array([0.1, 0.2, 0.3]), np.eye(3), np.array([0.3, 0.4, 0.5]))
WORDS = ("--iterations", "20", "--backend", "cpu", "--sky", "none", "--appearance", "none")


@pytest.fixture
def capture(tmp_path):
    write_colmap(tmp_path / "capture", *procedural_capture(32, 10, splats=60))
    return tmp_path / "capture"


def train(capture, out, *words):
    return main(["train", str(capture), "--out", str(out), *WORDS, *words])


def scene(out):
    return RunFolder(out).scene(20).read_bytes()


def test_a_region_is_written_read_and_removed(capture):
    assert read_region(capture) is None
    write_region(capture, BOX)
    assert read_region(capture).numbers == BOX.numbers
    assert [path.name for path in capture.iterdir() if "region" in path.name] == [REGION]
    dataset = load_dataset(capture)
    assert dataset.region.numbers == BOX.numbers
    assert any("region.json" in str(note) for note in dataset.notes)
    assert load_dataset(capture, DataSettings(region=())).region is None
    write_region(capture, None)
    assert not (capture / REGION).exists()
    write_region(capture, None)


@pytest.mark.parametrize(("z", "seen"), [(4.0, "some"), (-4.0, "none"), (0.0, "all")])
def test_a_box_is_seen_by_the_rays_that_enter_it_ahead_of_the_camera(z, seen):
    """The witness steps along each ray. The box before, behind or around the camera is turned about its axis."""
    camera = Camera(np.eye(3), (0, 0, 0), 20.0, 20.0, 11.5, 9.5, 20, 24)
    turn = np.array([[0.8, -0.6, 0.0], [0.6, 0.8, 0.0], [0.0, 0.0, 1.0]])
    box = Region(np.array([0.1, 0.0, z]), turn, np.array([1.0, 0.7, 0.5]))
    places = camera.rays()[..., None, :] * np.linspace(0.0, 6.0, 3_001)[:, None]
    expected = (np.abs((places - box.center) @ turn) <= box.half).all(axis=-1).any(axis=-1)
    found = seen_in(box, camera)
    assert {"some": found.any() and not found.all(), "none": not found.any(), "all": found.all()}[seen]
    assert (found != expected).sum() <= 2, "a corner that a step passes over"


@pytest.mark.parametrize(
    ("content", "told"),
    [
        ("", "is not JSON"),
        ("[1, 2]", "is [1, 2], but has to be an object"),
        ('{"center": [0, 0, 0], "half": [1, 1, 1]}', "lacks 'rotation'"),
        ('{"center": [0, 0, 0], "rotation": 3, "half": [1, 1, 1]}', "rotation: is 3, but has to be a list"),
        ('{"center": [0, 0, NaN], "rotation": [[1,0,0],[0,1,0],[0,0,1]], "half": [1, 1, 1]}', "center[2]"),
        ('{"center": [0, 0, 0], "rotation": [[1,0,0],[0,1,0],[0,0,1]], "half": [1, -1, 1]}', "half"),
        ('{"center": [0, 0, 0], "rotation": [[1,1,0],[0,1,0],[0,0,1]], "half": [1, 1, 1]}', "rotation"),
        (
            '{"center": [0, 0, 0], "rotation": [[1,0,0],[0,1,0],[0,0,1]], "half": [1, 1, 1], "a": 1}',
            "unknown key",
        ),
        (" " * 70_000, "larger than"),
    ],
)
def test_a_bad_file_costs_one_line(capture, tmp_path, capsys, content, told):
    (capture / REGION).write_text(content)
    with pytest.raises(DatasetError) as caught:
        read_region(capture)
    assert told in str(caught.value) and str(capture / REGION) in str(caught.value)
    assert train(capture, tmp_path / "run") == 2
    said = capsys.readouterr().err
    assert told in said and said.count("\n") == 1


def test_a_bad_file_that_is_not_wanted_is_not_read(capture, tmp_path):
    (capture / REGION).write_text("[1, 2]")
    assert train(capture, tmp_path / "run", "--set", "region=none") == 0


@pytest.mark.slow
def test_a_run_stores_its_region_and_resumes_with_it(capture, tmp_path, capsys):
    write_region(capture, BOX)
    whole, out = tmp_path / "whole", tmp_path / "out"
    assert train(capture, whole) == 0
    assert "only what the photos show of the box of region.json counts" in capsys.readouterr().out.replace(
        "\n", " "
    )
    assert RunFolder(whole).read_config()["data"]["region"] == list(BOX.numbers)
    assert train(capture, out, "--time-limit", "0.001s") == 0
    write_region(capture, None)  # the run keeps its own
    assert train(capture, out, "--resume") == 0
    assert scene(out) == scene(whole)
    assert train(capture, out, "--resume", "--set", "region=none") == 2
    assert "region" in capsys.readouterr().err


@pytest.mark.slow
def test_without_a_region_and_with_one_ignored_a_run_is_as_before(capture, tmp_path):
    assert train(capture, tmp_path / "before") == 0
    write_region(capture, BOX)
    assert train(capture, tmp_path / "ignored", "--set", "region=none") == 0
    assert scene(tmp_path / "before") == scene(tmp_path / "ignored")
    for name in ("before", "ignored"):
        assert "region" not in RunFolder(tmp_path / name).read_config()["data"]
    # a run that was made before the box was drawn is evaluated and resumed as it was
    assert train(capture, tmp_path / "before", "--resume") == 0
    assert train(capture, tmp_path / "drawn") == 0
    assert scene(tmp_path / "drawn") != scene(tmp_path / "before")


def test_only_the_pixels_count_whose_ray_meets_the_box(capture):
    """Point by point along each ray, against the formula; a few px around them count too."""
    write_region(capture, BOX)
    plain, boxed = load_dataset(capture, DataSettings(region=())), load_dataset(capture)
    for one, other in zip(plain.train, boxed.train, strict=True):
        camera, photo = one.camera, other.read()
        along = np.linspace(0.0, 12.0, 4_000)[:, None]
        met = np.zeros((camera.H, camera.W), dtype=bool)
        for (row, column), _ in np.ndenumerate(met):
            places = camera.origins()[row, column] + along * camera.rays()[row, column]
            met[row, column] = (np.abs((places - BOX.center) @ BOX.rotation) <= BOX.half).all(axis=1).any()
        reach = 2 * AROUND + 1
        around = cv2.dilate(met.view(np.uint8), np.ones((reach, reach), np.uint8)).astype(bool)
        assert 0.02 < met.mean() < 1.0
        assert (photo.mask != around).mean() < 0.02  # rays that graze an edge fall between the points
        assert (photo.image == one.read().image).all() and not photo.excluded.any()


def test_a_mask_of_the_capture_still_counts(capture):
    write_region(capture, BOX)
    (capture / "masks").mkdir()
    names = sorted(path.name for path in (capture / "images").iterdir())
    for name in names:
        mask = np.full((24, 32), 255, np.uint8)
        mask[:, :20] = 0
        Image.fromarray(mask).save(capture / "masks" / f"{name}.png")
    photo = load_dataset(capture).train[0].read()
    assert not photo.mask[:, :20].any() and photo.mask.any()
    assert photo.excluded[:, :20].all() and not photo.excluded[:, 20:].any()


def test_a_box_that_no_photo_shows_is_refused(capture, tmp_path, capsys):
    write_region(capture, BOX.moved(np.array([0.0, 1e4, 0.0])))
    assert train(capture, tmp_path / "run") == 2
    said = capsys.readouterr().err
    assert "no photo shows the box" in said and said.count("\n") == 1
    assert not (tmp_path / "run").exists()


def test_blocks_refuse_a_box(capture, tmp_path, capsys):
    write_region(capture, BOX)
    assert train(capture, tmp_path / "run", "--blocks", "2") == 2
    said = capsys.readouterr().err
    assert "region.json" in said and said.count("\n") == 1


def test_the_box_of_a_far_capture_moves_with_its_origin(tmp_path):
    views, points, colors = procedural_capture(32, 10, splats=60)
    far = np.array([5e4, 0.0, 0.0])
    moved = [
        type(view)(
            type(view.camera)(
                view.camera.R,
                view.camera.eye + far,
                **{key: getattr(view.camera, key) for key in ("fx", "fy", "cx", "cy", "H", "W")},
            ),
            view.read().image,
            name=view.name,
        )
        for view in views
    ]
    write_colmap(tmp_path / "far", moved, points + far, colors)
    write_region(tmp_path / "far", BOX.moved(far))
    dataset = load_dataset(tmp_path / "far")
    assert np.abs(dataset.origin).max() > 0
    assert np.allclose(dataset.region.center + dataset.origin, BOX.center + far)
    assert json.loads((tmp_path / "far" / REGION).read_text())["center"][0] == pytest.approx(5e4 + 0.1)
