"""`convert RUN page.html --verify photos`: what visitors of the page can check, and what a guided tour carries."""

import base64
import dataclasses
import gzip
import io
import json
import re
import shutil

import numpy as np
import pytest
from PIL import Image

from gsplat_edu.clean.evidence import judging_backend
from gsplat_edu.clean.sight import times_seen
from gsplat_edu.cli.main import main
from gsplat_edu.data.dataset import DataSettings, load_dataset
from gsplat_edu.data.procedural import procedural_capture
from gsplat_edu.data.writers import write_colmap
from gsplat_edu.edits.identity import identity_of
from gsplat_edu.io.ply import save_ply
from gsplat_edu.render.field import BEYOND, LEAST_BEYOND
from gsplat_edu.render.settings import RenderSettings
from gsplat_edu.runs.folder import RunFolder
from gsplat_edu.runs.source import open_source
from gsplat_edu.scene.projection import Projection
from gsplat_edu.scene.views import View
from splats import splats_on

SETTINGS = RenderSettings(depth=False, jacobian_limit=1.3)


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A run, and its capture."""
    root = tmp_path_factory.mktemp("made")
    views, points, colors = procedural_capture(size=32, count=12)
    write_colmap(root / "capture", views, points, colors)
    dataset = load_dataset(root / "capture", DataSettings(test_every=4))
    folder = RunFolder(root / "run")
    data = {**dataclasses.asdict(DataSettings(test_every=4)), "path": str(root / "capture"), "points": None}
    folder.write_config(
        {
            "version": "0",
            "data": data,
            "train": {"iterations": 30},
            "render": dataclasses.asdict(SETTINGS),
            "origin": dataset.origin.tolist(),
            "backend": "cpu",
        }
    )
    save_ply(folder.scene(30), splats_on(points - dataset.origin, colors), dataset.origin)
    folder.write_cameras(dataset.train, dataset.test, dataset.origin)
    return folder, dataset


def convert(*words, code=0):
    try:
        assert main(["convert", *map(str, words)]) == code
    except SystemExit as stop:  # argparse exits by itself
        assert stop.code == code


def parts_of(path):
    """Return the facts of a page, its counts, and its photos."""
    text = path.read_text()
    facts = json.loads(text.split('id="facts">')[1].split("</script>")[0])

    def inflated(kind):
        found = re.findall(f'base64" class="{kind}">([^<]*)<', text)
        return gzip.decompress(b"".join(map(base64.b64decode, found))) if found else None

    data, photos = inflated("photos"), []
    for entry in facts.get("photos", ()):
        photos.append((entry["index"], data[: entry["bytes"]]))
        data = data[entry["bytes"] :]
    return facts, inflated("seen"), photos


def test_the_page_gets_counts_and_photos_without_names(made, tmp_path, capsys):
    folder, dataset = made
    out = tmp_path / "a.html"
    convert(folder.path, out, "--verify", "photos=6")
    said = capsys.readouterr().out
    facts, seen, photos = parts_of(out)
    source = open_source(folder.path)
    cameras = [camera for name, camera in source.cameras if name not in source.held_out]
    expected = times_seen(source.scene.gaussians, cameras, source.settings, judging_backend(None))
    rounded = [0 if n == 0 else 2 ** int(np.log2(n)) for n in expected]
    np.testing.assert_array_equal(np.frombuffer(seen, np.uint8), rounded)
    assert f"fewer than 2 photos saw {100 * (expected < 2).mean():.1f} % of the splats; 6 photos" in said
    assert "PSNR" in said, "the file is verified as well"
    assert len(photos) == 6
    assert sum(facts["cameras"][index]["held_out"] for index, _ in photos) == 2
    views = {view.name: view for view in (*dataset.train, *dataset.test)}
    for index, jpeg in photos:
        photo = Image.open(io.BytesIO(jpeg))
        name = source.cameras[index][0]
        assert not photo.getexif() and photo.format == "JPEG"
        assert facts["cameras"][index]["held_out"] == (name in source.held_out)
        pixels = np.asarray(photo).astype(float)
        apart = {other: np.abs(pixels - view.read().image).mean() for other, view in views.items()}
        assert min(apart, key=apart.get) == name, "the photo of this camera, up to JPEG's losses"
        assert name.encode() not in out.read_bytes()


def test_edits_move_the_page_its_counts_and_its_tour(made, tmp_path):
    folder, _ = made
    source = open_source(folder.path)
    eye, R = source.cameras[0][1].eye, source.cameras[0][1].R
    pose = {"position": eye.tolist(), "rotation": R.T.tolist(), "fov": 50}
    edits = tmp_path / "edits.json"
    operations = [
        {"op": "scale", "points": [[0, 0, 0], [1, 0, 0]], "length": 2.0, "unit": "m"},
        {"op": "view", "name": "Front", **pose, "text": "Seen from the front.\nTwo lines."},
        {"op": "view", "name": "Plain", **pose},
    ]
    identity = identity_of(source.scene).document()
    document = {"format": "gsplat_edu edits", "version": 1, "scene": identity, "operations": operations}
    edits.write_text(json.dumps(document))
    convert(folder.path, tmp_path / "a.html", "--edits", edits, "--verify", "photos=2")
    facts, seen, photos = parts_of(tmp_path / "a.html")
    assert [view.get("text") for view in facts["cameras"][:2]] == ["Seen from the front.\nTwo lines.", None]
    np.testing.assert_allclose(facts["cameras"][0]["eye"], 2 * eye, rtol=1e-6)
    assert [facts["cameras"][index]["name"] for index, _ in photos] == [
        f"photo {index - 1}" for index, _ in photos
    ], "photos come behind the two views"
    convert(folder.path, tmp_path / "b.html", "--verify", "photos=2")
    before = np.frombuffer(parts_of(tmp_path / "b.html")[1], np.uint8).astype(int)
    after = np.frombuffer(seen, np.uint8).astype(int)
    assert (before == after).mean() > 0.95, "the cameras move with the splats; only the near plane does not"


def test_every_page_has_a_poster_of_its_start(made, tmp_path):
    folder, _ = made
    convert(folder.path, tmp_path / "a.html")
    text = (tmp_path / "a.html").read_text()
    poster = re.search(r'<img id="poster" alt="[^"]+" src="data:image/jpeg;base64,([^"]+)">', text)
    data = base64.b64decode(poster[1])
    picture = np.asarray(Image.open(io.BytesIO(data)))
    assert len(data) <= 60_000
    camera = parts_of(tmp_path / "a.html")[0]["start"]["camera"]
    assert picture.shape == (camera["H"], camera["W"], 3) and picture.std() > 10
    facts, seen, photos = parts_of(tmp_path / "a.html")
    assert seen is None and photos == [] and "seen" not in facts, "evidence is there on request only"


def test_a_capture_that_has_moved_is_given(made, tmp_path, capsys):
    folder, dataset = made
    run = RunFolder(tmp_path / "run")
    shutil.copytree(folder.path, run.path)
    config = json.loads(run.config.read_text())
    config["data"]["path"] = str(tmp_path / "gone")
    run.config.write_text(json.dumps({"format": 1, **config}))
    out = tmp_path / "a.html"
    convert(run.path, out, "--verify", "photos", code=2)
    assert "dataset" in capsys.readouterr().err and not out.exists()
    convert(run.path, out, "--verify", "photos", "--dataset", dataset.path)
    assert len(parts_of(out)[2]) == 12


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["RUN", "a.spz", "--verify", "photos"], "--verify photos: a.spz is no page"),
        (["SCENE", "a.html", "--verify", "photos"], "give the run that made it"),
        (["RUN", "SCENE", "a.html", "--merge", "--verify", "photos"], "is for the page of one run"),
        (["RUN", "a.html", "--verify", "photos=0"], "has to be from 1 to 200"),
        (["RUN", "a.html", "--verify", "photos=many"], "put --verify behind OUT"),
        (["--verify", "RUN", "a.html"], "put --verify behind OUT"),
        (["RUN", "a.html", "--dataset", "."], "--dataset: has an effect only with --size or --verify photos"),
        (["RUN", "a.html", "--verify", "photos", "--dataset", "nowhere"], "nowhere does not exist"),
    ],
)
def test_mistakes_take_one_line(made, tmp_path, capsys, monkeypatch, words, said):
    folder, _ = made
    shutil.copy(folder.scene(30), tmp_path / "plain.ply")
    monkeypatch.chdir(tmp_path)
    names = {"RUN": folder.path, "SCENE": tmp_path / "plain.ply"}
    convert(*(names.get(word, word) for word in words), code=2)
    err = capsys.readouterr().err
    assert said in err and err.count("\n") == 1


def test_a_scene_trained_through_lenses_is_told_apart_for_other_viewers(made, tmp_path, capsys):
    folder, dataset = made
    shutil.copytree(folder.path, tmp_path / "wide")
    wide = [
        View(view.camera.through(Projection("fisheye")), view.read().image, name=view.name)
        for view in dataset.train
    ]
    RunFolder(tmp_path / "wide").write_cameras(wide, [], dataset.origin)
    capsys.readouterr()
    for source, name, told in (
        (tmp_path / "wide", "a.ply", True),
        (tmp_path / "wide", "a.html", False),
        (folder.path, "b.ply", False),
    ):
        convert(source, tmp_path / name)
        assert ("viewers that draw pinholes may show splats" in capsys.readouterr().out) == told
    facts = re.search(
        rb'<script[^>]*id="facts"[^>]*>(.*?)</script>', (tmp_path / "a.html").read_bytes(), re.S
    )
    assert json.loads(facts[1])["settings"]["beyond"] == [BEYOND, LEAST_BEYOND]
