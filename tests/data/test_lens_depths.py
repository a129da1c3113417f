"""Depth of photos that keep their lens: maps are read in the lens's own pixels, and points seen through it."""

import numpy as np
import pytest

from gsplat_edu import Camera
from gsplat_edu.base.errors import DatasetError
from gsplat_edu.data.dataset import Dataset
from gsplat_edu.data.depth_fit import no_jumps
from gsplat_edu.data.depths import POINTS, DepthSource, with_depth
from gsplat_edu.data.reader import CaptureReader
from gsplat_edu.data.settings import DataSettings
from gsplat_edu.data.sparse_depth import sparse_depth
from gsplat_edu.data.tracks import visible_points
from gsplat_edu.data.writers import write_colmap
from gsplat_edu.scene.projection import Distortion, Projection
from gsplat_edu.scene.views import View
from lens_captures import FISHEYE, room_cameras, room_depth, room_photo, write_room
from lens_scenes import LENSES, around, lens_camera
from panorama_room import depths_of

PANORAMA = Projection("equirectangular")
WIDE = pytest.mark.parametrize("projection", [FISHEYE, PANORAMA], ids=["fisheye", "panorama"])
NATIVE = DataSettings(test_every=0, lens="native")


def given(folder, source, settings=NATIVE):
    """Return dataset and report of a capture with depth."""
    reader = CaptureReader(folder)
    return with_depth(Dataset.of(reader, settings), reader, source)


def write_room_maps(folder, cameras, change=lambda depth, cosine: depth, factor=2):
    """Write maps of a sensor with more pixels than the photos: the change of exact distances."""
    folder.mkdir()
    for i, camera in enumerate(cameras):
        fine = camera.scaled(factor * camera.W, factor * camera.H)
        rays = np.nan_to_num(fine.rays()) @ camera.R.T
        np.save(folder / f"r{i:02}.png.npy", change(room_depth(fine), rays[..., 2]))
    return folder


def check_exact(view, true, projection, within):
    """Compare a view's samples with the exact depth at the sensor's pixels; return their rays in camera axes."""
    samples, camera = view.depth(), view.camera
    H, W = true.shape
    fine = camera.scaled(W, H)
    u, v = samples.rays[:, 0] * fine.fx + fine.cx, samples.rays[:, 1] * fine.fy + fine.cy
    columns, rows = np.rint(u).astype(int), np.rint(v).astype(int)
    assert np.abs(u - columns).max() < 1e-3 and np.abs(v - rows).max() < 1e-3  # no pixel between pixels
    assert np.abs(samples.depths / true[rows, columns] - 1).max() < within
    return camera.projection.directions(samples.rays[:, 0], samples.rays[:, 1], camera.widest)


@WIDE
@pytest.mark.parametrize("kind", ["ray", "z"])
def test_maps_are_read_in_the_pixels_of_the_lens(tmp_path, projection, kind):
    """Points tell the unit, and z from distance. Distances past 90 degrees are used; z ends where it tells little."""
    cameras = write_room(tmp_path / "room", projection, 5, 48)
    maps = write_room_maps(
        tmp_path / "maps", cameras, lambda depth, z: 400 * depth * (np.maximum(z, 0) if kind == "z" else 1)
    )
    for source in (DepthSource(maps), DepthSource(maps, kind, 1 / 400)):
        dataset, report = given(tmp_path / "room", source)
        assert report.used == 5 and report.fit.kind == kind and report.fit.certain
        assert report.fit.unit == pytest.approx(1 / 400, rel=0.01) and report.fit.spread < 0.05
        for view, camera in zip(dataset.train, cameras, strict=True):
            true = room_depth(camera.scaled(2 * camera.W, 2 * camera.H))
            cosines = check_exact(view, true, projection, 0.01 if source.unit == 0 else 1e-5)[:, 2]
            assert (cosines.min() < -0.3) if kind == "ray" else (0.1 < cosines.min() < 0.12)
            shown = true.size if kind == "ray" else (true > 0).sum() / 3
            assert len(view.depth()) > 0.6 * shown


@WIDE
def test_inverse_depth_of_a_wide_lens_is_that_of_the_distance(tmp_path, projection):
    cameras = write_room(tmp_path / "room", projection, 4, 48)
    change = lambda depth, z: 0.4 / np.maximum(depth, 0.05) + 0.1  # noqa: E731
    maps = write_room_maps(tmp_path / "maps", cameras, change)
    dataset, report = given(tmp_path / "room", DepthSource(maps, "inverse"))
    assert report.used == 4 and report.fit.spread < 0.05
    for view, camera in zip(dataset.train, cameras, strict=True):
        samples, fine = view.depth(), camera.scaled(2 * camera.W, 2 * camera.H)
        columns, rows = (
            np.rint(samples.rays[:, i] * f + c).astype(int)
            for i, (f, c) in enumerate([(fine.fx, fine.cx), (fine.fy, fine.cy)])
        )
        assert np.median(np.abs(samples.depths / room_depth(fine)[rows, columns] - 1)) < 0.03


def test_without_points_a_lens_that_sees_behind_has_distances(tmp_path):
    """A z of 0 or less is no depth, so the maps of a wide lens are taken for distances unless the user says z."""
    cameras = write_room(tmp_path / "room", FISHEYE, 3, 32)
    maps = write_room_maps(tmp_path / "maps", cameras)
    (tmp_path / "room/sparse/0/points3D.txt").unlink()
    dataset, report = given(tmp_path / "room", DepthSource(maps, unit=1.0))
    assert report.fit.kind == "ray" and "unchecked" in report.lines()[0]
    check_exact(dataset.train[0], room_depth(cameras[0].scaled(64, 64)), FISHEYE, 1e-5)


def test_a_distorted_perspective_lens_has_z(tmp_path):
    """Its depth is z as of a pinhole; ray lengths are divided by the length of the ray of its own pixel."""
    lens = Projection(distortion=Distortion.of(k1=-0.2, k2=0.03))
    cameras = [camera.through(lens).scaled(64, 64) for camera in room_cameras(Projection("fisheye"), 4, 32)]
    views = [View(camera, room_photo(camera), name=f"r{i:02}.png") for i, camera in enumerate(cameras)]
    rng = np.random.default_rng(0)
    there = rng.integers(0, 64, (3_000, 2))
    points = np.concatenate(
        [c.eye + (room_depth(c)[..., None] * c.rays())[there[:, 0], there[:, 1]] for c in cameras]
    )
    write_colmap(tmp_path / "room", views, points[np.isfinite(points).all(axis=1)], np.full_like(points, 0.5))
    maps = write_room_maps(tmp_path / "maps", cameras)
    for i, camera in enumerate(cameras):
        fine = camera.scaled(128, 128)
        lengths = np.linalg.norm(np.nan_to_num(fine.rays()), axis=-1)
        np.save(maps / f"r{i:02}.png.npy", room_depth(fine) * lengths)
    dataset, report = given(tmp_path / "room", DepthSource(maps, unit=1.0))
    assert report.fit.kind == "ray" and report.fit.certain
    for view, camera in zip(dataset.train, cameras, strict=True):
        check_exact(view, room_depth(camera.scaled(128, 128)), lens, 1e-4)


@pytest.mark.parametrize("name", LENSES)
def test_points_are_seen_through_lens_and_shutter(name):
    """Place and depth are those that the renderer gives a Gaussian at the point; none beyond the image remains."""
    camera, points = lens_camera(name), np.asarray(around(300).means)
    depth, sight = sparse_depth(camera, points), camera.sight(points)
    inside = sight.valid & (sight.v >= 0) & (sight.v <= camera.H - 1)
    if not camera.projection.wraps:
        inside &= (sight.u >= 0) & (sight.u <= camera.W - 1)
    assert depth.sparse and len(depth) == inside.sum() > 10
    assert np.allclose(depth.rays[:, 0] * camera.fx + camera.cx, sight.u[inside], atol=1e-4)
    assert np.allclose(depth.rays[:, 1] * camera.fy + camera.cy, sight.v[inside], atol=1e-4)
    assert np.allclose(depth.depths, sight.depth[inside], rtol=1e-6)
    if camera.projection.along_ray:
        assert (camera.world_to_cam(points[inside])[:, 2] < 0).any()
    seen = visible_points(camera, points)
    assert np.isin(seen.points, np.flatnonzero(sight.valid)).all() and len(seen.points) > 5
    assert np.allclose(seen.pixels, np.stack([sight.u, sight.v], axis=1)[seen.points] + 0.5)


@WIDE
def test_tracks_give_the_depth_of_points_behind(tmp_path, projection):
    """The tracks of a written model list what the lens sees, and the depth is the distance from the camera."""
    cameras = room_cameras(projection, 5, 40)
    views = [View(camera, room_photo(camera), name=f"r{i:02}.png") for i, camera in enumerate(cameras)]
    rays = np.random.default_rng(0).normal(size=(1_500, 3))
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    points = cameras[0].eye + depths_of(cameras[0].eye, rays)[:, None] * rays
    write_colmap(tmp_path, views, points, np.full_like(points, 0.5))
    dataset, report = given(tmp_path, DepthSource(POINTS))
    assert report.used == 5 and report.points > 100
    for view in dataset.train:
        depth = view.depth()
        directions = view.camera.projection.directions(depth.rays[:, 0], depth.rays[:, 1], view.camera.widest)
        at = view.camera.eye + depth.depths[:, None] * (directions @ view.camera.R)
        distances = np.linalg.norm(at[:, None] - points, axis=2).min(axis=1)
        assert distances.max() < 1e-4 and (directions[:, 2] < -0.2).any()


def test_maps_of_a_panorama_that_is_cut_into_faces_are_refused(tmp_path):
    cameras = write_room(tmp_path / "room", PANORAMA, 3, 48)
    maps = write_room_maps(tmp_path / "maps", cameras)
    with pytest.raises(DatasetError, match="faces, which have no depth maps; train with `lens=native`"):
        given(tmp_path / "room", DepthSource(maps), DataSettings(test_every=0))


def test_points_at_the_seam_of_a_panorama_have_depth():
    """Straight behind the camera, between the last and the first column, where a point of another lens is outside."""
    camera = Camera.panorama(np.eye(3), np.zeros(3), 20, 40)
    longitudes = np.pi * np.array([0.98, 0.999, -0.999, -0.98])  # 39.1, 39.48, -0.48 and -0.1 px
    points = 3 * np.stack([np.sin(longitudes), np.zeros(4), np.cos(longitudes)], axis=1)
    depth = sparse_depth(camera, points)
    np.testing.assert_allclose(depth.depths, 3.0, rtol=1e-6)
    np.testing.assert_allclose(
        depth.rays[:, 0] * camera.fx + camera.cx, [39.1, 39.48, -0.48, -0.1], atol=1e-5
    )


@pytest.mark.parametrize("columns", [0, 1, 5, 19])
def test_jumps_of_depth_are_found_across_the_seam(columns):
    """A near wall ends between the columns 19 and 0 and between 9 and 10; turning the map moves what is left out."""
    depth = np.where(np.arange(20) < 10, 2.0, 3.0) * np.ones((6, 1))
    held = no_jumps(np.roll(depth, columns, axis=1), 0.05, wraps=True)
    beside = np.isin(np.arange(20), (0, 9, 10, 19))
    assert (held == np.roll(~beside, columns)).all()
    assert columns or no_jumps(depth, 0.05)[:, [0, 19]].all()  # an edge of any other map


def test_a_map_is_read_at_the_edges_of_a_panorama(tmp_path):
    """Samples of a smooth map begin in the first column and end in the last; one beside a jump there is left out."""
    cameras = write_room(tmp_path / "room", PANORAMA, 3, 48)
    maps = write_room_maps(tmp_path / "maps", cameras, lambda depth, z: 0 * depth + 2.0, factor=1)
    broken = np.full((48, 96), 2.0)
    broken[:, 40:] = 4.0
    np.save(maps / "r01.png.npy", broken)
    (tmp_path / "room/sparse/0/points3D.txt").unlink()
    dataset, _ = given(tmp_path / "room", DepthSource(maps, unit=1.0))
    for view, edges in zip(dataset.train, [True, False, True], strict=True):
        u = np.rint(view.depth().rays[:, 0] * view.camera.fx + view.camera.cx)
        assert {0.0 in u, 95.0 in u} == {edges} and 20.0 in u and 60.0 in u
