import dataclasses
import json

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gsplat_edu.base.errors import ArgumentError, CheckpointError
from gsplat_edu.base.text import image_file_names
from gsplat_edu.render.settings import RenderSettings
from gsplat_edu.runs.folder import FORMAT, RunFolder, render_settings
from gsplat_edu.scene.camera import Camera
from gsplat_edu.scene.views import View


@pytest.fixture
def folder(tmp_path):
    return RunFolder(tmp_path / "run")


def views(count=3):
    rng = np.random.default_rng(0)
    result = []
    for i in range(count):
        R = Rotation.random(random_state=i).as_matrix()
        camera = Camera(R, rng.normal(size=3), *rng.uniform(50, 60, 2), *rng.uniform(2, 4, 2), 5, 7)
        result.append(View(camera, np.zeros((5, 7, 3)), name=f"left/{i}.jpg"))
    return result


def test_the_layout_of_a_run_folder(folder):
    root = folder.path
    assert not folder.exists()
    folder.write_config({"version": "1"})
    assert folder.exists()
    assert folder.config == root / "config.json" and folder.log_file == root / "log.jsonl"
    assert folder.metrics == root / "metrics.json" and folder.cameras == root / "cameras.json"
    assert folder.renders == root / "renders" and folder.checkpoints == root / "checkpoints"
    assert folder.report == root / "report.html"
    assert folder.scene(70) == root / "point_cloud" / "iteration_70" / "point_cloud.ply"


def test_config_and_metrics_are_read_as_written(folder):
    config = {"version": "0.1", "origin": [0.1, 1e-300, -3.0], "data": {"path": "ä", "points": None}}
    folder.write_config(config)
    assert folder.read_config() == config
    assert folder.read_metrics() == {}
    folder.write_metrics({"test": {"psnr": 0.1 + 0.2}})
    assert folder.read_metrics() == {"test": {"psnr": 0.1 + 0.2}}


@pytest.mark.parametrize(("number", "by"), [(None, "no number"), (0, "number 0"), ("1", "no number")])
def test_a_run_of_another_layout_is_refused(folder, number, by):
    folder.write_config({"version": "0.1"})
    written = json.loads(folder.config.read_text())
    assert written.pop("format") == FORMAT
    folder.config.write_text(json.dumps(written if number is None else written | {"format": number}))
    with pytest.raises(
        CheckpointError, match=rf"config\.json: has {by} for its format.* train the run again"
    ):
        folder.read_config()


def test_numbers_that_json_lacks_are_refused(folder):
    folder.write_metrics({"psnr": 1.0})
    before = folder.metrics.read_bytes()
    for bad in (float("nan"), float("inf"), {1, 2}):
        with pytest.raises(ArgumentError, match=r"metrics\.json: cannot be written as JSON"):
            folder.write_metrics({"psnr": bad})
    assert folder.metrics.read_bytes() == before
    folder.metrics.write_text('{"psnr": NaN}')
    with pytest.raises(CheckpointError, match=r"metrics\.json: is not JSON \(NaN is not valid JSON\)"):
        folder.read_metrics()


def test_missing_and_damaged_files_are_named(folder):
    with pytest.raises(CheckpointError, match=r"run: is not a run: it has no config\.json; give the folder"):
        folder.read_config()
    with pytest.raises(CheckpointError, match="run: contains no scene"):
        folder.latest_scene()
    with pytest.raises(CheckpointError, match=r"cameras\.json: does not exist"):
        folder.read_cameras()
    folder.write_config({})
    for text, says in (("[1]", "is not a JSON object"), ("{", "is not JSON"), ("", "is not JSON")):
        folder.config.write_text(text)
        with pytest.raises(CheckpointError, match=rf"config\.json: {says}") as caught:
            folder.read_config()
        assert "\n" not in str(caught.value)


def test_only_a_torn_last_line_is_left_out(folder):
    assert folder.log() == []
    folder.write_config({})
    lines = [{"iteration": 1, "loss": 0.5}, {"iteration": 2, "loss": 0.25}]
    text = "".join(json.dumps(line) + "\n" for line in lines)
    for torn in ("", '{"iteration": 3, "lo', '{"iteration": 3}'):  # the last line may be cut as well
        folder.log_file.write_text(text + torn)
        assert folder.log() == lines
    folder.log_file.write_text('{"iterat\n' + text)
    with pytest.raises(CheckpointError, match=r"log\.jsonl: line 1: is not JSON"):
        folder.log()
    folder.log_file.write_text(text + "7\n")
    with pytest.raises(CheckpointError, match=r"log\.jsonl: line 3: is not a JSON object"):
        folder.log()


def test_the_latest_scene_has_the_most_iterations(folder):
    for iteration in (900, 7000, 30):
        path = folder.scene(iteration)
        path.parent.mkdir(parents=True)
        path.write_bytes(b"")
    folder.scene(99999).parent.mkdir()  # the run was killed while writing it
    (folder.path / "point_cloud" / "iteration_best").mkdir()
    (folder.path / "point_cloud" / "iteration_best" / "point_cloud.ply").write_bytes(b"")
    assert folder.latest_scene() == (folder.scene(7000), 7000)


def same(a, b):
    numbers = ("fx", "fy", "cx", "cy", "H", "W")
    return (
        a.R.tobytes() == b.R.tobytes()
        and a.eye.tobytes() == b.eye.tobytes()
        and all(getattr(a, n) == getattr(b, n) for n in numbers)
    )


def test_cameras_are_read_back_exactly(folder):
    train, test = views()[:2], views()[2:]
    folder.write_cameras(train, test)
    read = folder.read_cameras()
    assert [(name, split) for name, split, _ in read] == [
        ("left/0.jpg", "train"),
        ("left/1.jpg", "train"),
        ("left/2.jpg", "test"),
    ]
    assert all(same(view.camera, camera) for view, (_, _, camera) in zip(views(), read, strict=True))


def test_cameras_are_written_as_viewers_read_them(folder):
    folder.write_cameras(views(), [], origin=(100.0, 0.0, 0.0))
    entry, camera = json.loads(folder.cameras.read_text())[1], views()[1].camera
    assert (entry["id"], entry["img_name"], entry["width"], entry["height"]) == (1, "left/1.jpg", 7, 5)
    np.testing.assert_array_equal(entry["position"], np.add(camera.eye, (100.0, 0.0, 0.0)))
    # The matrix is camera to world, so its third column is the camera's forward axis.
    np.testing.assert_array_equal(np.array(entry["rotation"])[:, 2], camera.R[2])
    back = folder.read_cameras((100.0, 0.0, 0.0))[1][2]
    np.testing.assert_allclose(back.eye, camera.eye, atol=1e-13)  # float64 near 100 is accurate to 2^-47


def test_a_cameras_file_without_our_keys_is_read(folder):
    """Inria's files have no split and no principal point, for which the image's centre is used."""
    folder.write_cameras(views(1), [])
    (entry,) = json.loads(folder.cameras.read_text())
    folder.cameras.write_text(
        json.dumps([{k: v for k, v in entry.items() if k not in ("cx", "cy", "split")}])
    )
    ((_, split, camera),) = folder.read_cameras()
    assert (split, camera.cx, camera.cy) == ("train", 3.0, 2.0)


@pytest.mark.usefixtures("as_shipped")
@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"rotation": None}, "entry 0: rotation: is null, but has to be a list"),
        ({"rotation": [[1, 0, 0], [0, 1, 0], [0, 0, -1]]}, "entry 0: R: is not a rotation"),
        ({"position": [1, 2]}, r"entry 0: position: is \[1, 2\], but has to have 3 entries"),
        ({"fx": "wide"}, 'entry 0: fx: is "wide", but has to be a number'),
        ({"height": 2.5}, "entry 0: height: is 2.5, but has to be a whole number"),
        ({"split": "val"}, 'entry 0: split: is "val", but has to be one of test, train'),
        ({"width": ...}, "entry 0: lacks 'width'"),
    ],
)
def test_a_damaged_camera_is_named(folder, change, says):
    folder.write_cameras(views(1), [])
    (entry,) = json.loads(folder.cameras.read_text())
    entry = {k: v for k, v in {**entry, **change}.items() if v is not ...}
    folder.cameras.write_text(json.dumps([entry]))
    with pytest.raises(CheckpointError, match=rf"cameras\.json: {says}"):
        folder.read_cameras()


def test_render_settings_come_from_the_config():
    settings = RenderSettings(background=(1.0, 0.5, 0.0), sh_degree=2, antialiased=True)
    config = json.loads(json.dumps({"render": dataclasses.asdict(settings)}))
    assert render_settings(config) == settings
    assert render_settings({}) == RenderSettings()
    assert render_settings({"render": {"sh_degree": 1}}) == RenderSettings(sh_degree=1)


@pytest.mark.usefixtures("as_shipped")
@pytest.mark.parametrize(
    ("section", "says"),
    [
        ({"glow": 1, "fog": 2}, "render: unknown settings 'fog', 'glow'; use the version"),
        ({"fo\ng": 1}, r"render: unknown settings 'fo\\ng'; use the version"),
        ([], "render: is not an object"),
        ({"sh_degree": 9}, "render: sh_degree: is 9"),
        ({"background": "white"}, "render: background: cannot be read"),
    ],
)
def test_invalid_render_settings_are_named(section, says):
    with pytest.raises(CheckpointError, match=rf"config\.json: {says}"):
        render_settings({"render": section})


def test_image_names_become_different_file_names():
    names = [
        "left/0001.jpg",
        "left_0001.png",
        "../../etc/passwd",
        "",
        "ä b.JPEG",
        "v1.25",
        ".hidden",
        "LEFT_0001",
    ]
    files = image_file_names(names)
    assert files[0] == "left_0001.png" and files[1] == "left_0001_2.png"
    assert files[3] == "view_0003.png" and files[4] == "ä_b.png" and files[5] == "v1.25.png"
    assert len({file.lower() for file in files}) == len(names)
    assert not any("/" in file or file.startswith(".") for file in files)
