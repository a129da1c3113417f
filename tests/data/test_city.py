"""The cameras, points and photos of the city agree, and a seed determines every byte."""

import hashlib

import numpy as np
import pytest

from gsplat_edu.data.dataset import load_dataset
from lab.captures import city as procedural
from lab.captures.city import City, write_city

SMALL = City(photos=9, width=48, street=0.25, points=30, seed=3)


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    folder = tmp_path_factory.mktemp("city")
    write_city(folder, SMALL)
    return folder


def test_the_capture_is_read_as_it_was_made(written):
    dataset = load_dataset(written)
    views = sorted((*dataset.train, *dataset.test), key=lambda view: view.name)
    assert [view.name for view in views] == [name for name, _ in SMALL.cameras]
    for view, (_, camera) in zip(views, SMALL.cameras, strict=True):
        np.testing.assert_allclose(view.camera.R, camera.R, atol=1e-9)
        np.testing.assert_allclose(view.camera.eye, camera.eye, atol=1e-9)
        assert view.camera.intrinsics == pytest.approx(camera.intrinsics)


def test_points_lie_where_the_photos_show_them(written):
    errors = []
    for index, (_, camera) in enumerate(SMALL.cameras):
        image, points, colors = SMALL.photograph(index)
        u, v, z = camera.project(camera.world_to_cam(points))
        assert len(points) == 30 and (z > 0).all() and points[:, 1].max() < 1e-6
        shown = image[np.rint(v).astype(int), np.rint(u).astype(int)] / 255
        errors.append(np.abs(shown - colors).max(axis=1))
    assert np.median(np.concatenate(errors)) < 0.1, (
        "a pixel is the mean of four rays, and a point is one of them"
    )


def test_several_processes_write_the_same_bytes(written, tmp_path):
    write_city(tmp_path, SMALL, workers=2)
    files = [path.relative_to(written) for path in sorted(written.rglob("*")) if path.is_file()]
    assert len(files) == 9 + 3
    for file in files:
        digests = {hashlib.sha256((place / file).read_bytes()).digest() for place in (written, tmp_path)}
        assert len(digests) == 1, file


def test_the_command_writes_a_city(tmp_path, capsys):
    words = [
        str(tmp_path / "city"),
        "--photos",
        "3",
        "--width",
        "16",
        "--workers",
        "1",
        "--seed",
        "3",
    ]
    procedural.main(words)
    assert "3 photos of 16x12 px" in capsys.readouterr().out
    assert len(list((tmp_path / "city" / "images").iterdir())) == 3


def test_more_photos_make_a_larger_city_and_show_each_place_as_often():
    small, large = City(photos=36), City(photos=144)
    assert large.side == 2 * small.side
    for city in (small, large):
        seen = sum(_shows(camera, np.zeros(3)) for _, camera in city.cameras)
        assert seen >= 10


def _shows(camera, point):
    u, v, z = camera.project(camera.world_to_cam(point[None]))
    return bool(z[0] > 0 and 0 <= u[0] < camera.W and 0 <= v[0] < camera.H)
