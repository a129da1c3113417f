"""Depth of a capture: unit and kind are found from the points, and what does not fit is named."""

import json

import numpy as np
import pytest

from data.conftest import WRITERS
from data.depth_maps import (
    SIZE,
    exact_depths,
    ray_lengths,
    small_camera,
    traced,
    views_of,
    write_capture,
    write_maps,
)
from gsplat_edu.base.errors import DatasetError
from gsplat_edu.data.capture import Cloud
from gsplat_edu.data.dataset import Dataset
from gsplat_edu.data.depths import CAPTURE, POINTS, SCAN, DepthSource, with_depth
from gsplat_edu.data.points import write_points_ply
from gsplat_edu.data.reader import CaptureReader
from gsplat_edu.data.settings import DataSettings
from gsplat_edu.data.sparse_depth import sparse_depth, tracked_points

EVERY = DataSettings(test_every=0)


def given(folder, source, settings=EVERY):
    """Return dataset and report of a capture with depth."""
    reader = CaptureReader(folder)
    return with_depth(Dataset.of(reader, settings), reader, source)


def check_exact(dataset, within=2e-3):
    """Compare the samples of each view with the exact depth at the sensor's pixels."""
    for view, depth in zip(dataset.train, exact_depths(), strict=True):
        samples, small = view.depth(), small_camera(view.camera)
        u = np.rint(small.fx * samples.rays[:, 0] + small.cx).astype(int)
        v = np.rint(small.fy * samples.rays[:, 1] + small.cy).astype(int)
        assert len(samples) > 0.6 * (depth > 0).sum()
        assert np.abs(samples.depths / depth[v, u] - 1).max() < within


@pytest.mark.parametrize("kind", ["z", "ray"])
@pytest.mark.parametrize("layout", ["colmap", "transforms"])
def test_unit_and_kind_are_found(tmp_path, kind, layout):
    """The points tell millimetres from metres, and z from ray length."""
    folder = write_capture(tmp_path / "capture", layout)
    ray = kind == "ray"
    maps = write_maps(
        tmp_path / "maps",
        lambda depth, view: depth * (ray_lengths(view.camera) if ray else 1.0),
        scale=2500.0,
    )
    dataset, report = given(folder, DepthSource(maps))
    assert report.fit.kind == kind and report.fit.certain
    assert report.fit.unit == pytest.approx(1 / 2500, rel=0.01)
    assert report.fit.spread < 0.02 and not report.rejected and not report.missing
    check_exact(dataset, 0.01)  # the unit comes from points with noise
    dataset, report = given(folder, DepthSource(maps, kind, 1 / 2500))
    check_exact(dataset)


def test_a_wrong_unit_and_a_wrong_kind_are_refused_in_one_line(tmp_path):
    folder, maps = write_capture(tmp_path / "capture"), write_maps(tmp_path / "maps")
    with pytest.raises(DatasetError, match=r"depth_unit=1, depth is \d+ times too large .* or give 0\.00"):
        given(folder, DepthSource(maps, unit=1.0))
    with pytest.raises(
        DatasetError, match=r"values are camera depth \(z\), not lengths of rays.*leave depth_kind out"
    ):
        given(folder, DepthSource(maps, "ray"))
    inverse = write_maps(tmp_path / "inverse", lambda depth, view: 1 / np.maximum(depth, 0.1), 20_000)
    with pytest.raises(DatasetError, match="neither z nor ray length in any unit.*take `depth_kind=inverse`"):
        given(folder, DepthSource(inverse))
    with pytest.raises(DatasetError, match="larger values are farther away"):
        given(folder, DepthSource(maps, "inverse"))
    rng = np.random.default_rng(0)
    noise = write_maps(tmp_path / "noise", lambda depth, view: rng.uniform(0.5, 8, depth.shape))
    with pytest.raises(DatasetError, match="check that the maps belong to these photos"):
        given(folder, DepthSource(noise))


def test_inverse_depth_gets_a_scale_and_a_shift_for_each_photo(tmp_path):
    """A map whose relief is upside down is rejected, and the others become the exact depth."""
    rng = np.random.default_rng(1)
    lines = {view.name: (rng.uniform(0.5, 2), rng.uniform(0, 0.3)) for view in traced().views}
    odd = traced().views[3].name

    def change(depth, view):
        a, b = lines[view.name]
        inverse = np.where(depth > 0, 1 / np.maximum(depth, 0.1), 0)
        return np.where(depth > 0, a * (0.6 - inverse if view.name == odd else inverse) + b, 0)

    folder, maps = write_capture(tmp_path / "capture"), write_maps(tmp_path / "maps", change, 20_000)
    dataset, report = given(folder, DepthSource(maps, "inverse"))
    assert [name for name, _ in report.rejected] == [odd]
    assert set(views_of(dataset)) == {view.name for view in traced().views} - {odd}
    for view, depth in zip(dataset.train, exact_depths(), strict=True):
        if view.name == odd:
            continue
        samples, small = view.depth(), small_camera(view.camera)
        u = np.rint(small.fx * samples.rays[:, 0] + small.cx).astype(int)
        v = np.rint(small.fy * samples.rays[:, 1] + small.cy).astype(int)
        assert np.median(np.abs(samples.depths / depth[v, u] - 1)) < 0.02
    assert any("not used" in line and odd in line for line in report.lines())


def test_a_map_in_another_unit_and_missing_maps_are_named(tmp_path):
    names = [view.name for view in traced().views]
    folder = write_capture(tmp_path / "capture")
    maps = write_maps(tmp_path / "maps", lambda depth, view: depth * (2.0 if view.name == names[2] else 1.0))
    (maps / names[5]).unlink()
    dataset, report = given(folder, DepthSource(maps))
    assert [name for name, _ in report.rejected] == [names[2]] and report.missing == (names[5],)
    assert dataset.train[2].depth is None and dataset.train[5].depth is None and report.used == 8
    said = " ".join(report.lines())
    assert f"{names[2]} (depth is " in said and f"1 photos have no depth map: {names[5]}" in said


def test_transforms_json_names_maps(tmp_path):
    folder = write_capture(tmp_path, "transforms")
    write_maps(folder / "depths")
    contents = json.loads((folder / "transforms.json").read_text())
    for frame in contents["frames"]:
        frame["depth_file_path"] = frame["file_path"].replace("images/", "./depths/")
    (folder / "transforms.json").write_text(json.dumps(contents))
    dataset, report = given(folder, DepthSource(CAPTURE))
    assert report.used == 10 and report.fit.kind == "z"
    check_exact(dataset, 0.01)
    contents["frames"][0]["depth_file_path"] = 3
    (folder / "transforms.json").write_text(json.dumps(contents))
    with pytest.raises(DatasetError, match="depth_file_path is 3, but must be a path"):
        given(folder, DepthSource(CAPTURE))


def test_a_map_of_another_shape_is_refused(tmp_path):
    folder, maps = write_capture(tmp_path / "capture"), write_maps(tmp_path / "maps")
    name = traced().views[0].name
    (maps / name).unlink()
    np.save(maps / f"{name}.npy", np.ones((40, 30)))
    with pytest.raises(DatasetError, match="is 30x40 px, but the camera of view_000.png 64x48"):
        given(folder, DepthSource(maps))


def test_without_points_the_unit_has_to_be_named(tmp_path):
    folder, maps = write_capture(tmp_path / "capture", "transforms"), write_maps(tmp_path / "maps")
    contents = json.loads((folder / "transforms.json").read_text())
    del contents["ply_file_path"]
    (folder / "transforms.json").write_text(json.dumps(contents))
    with pytest.raises(DatasetError, match="too few to find its unit; name it with `depth_unit=U`"):
        given(folder, DepthSource(maps))
    dataset, report = given(folder, DepthSource(maps, unit=0.001))
    assert report.fit.points == 0 and "unchecked" in report.lines()[0]
    check_exact(dataset)


@pytest.mark.parametrize("layout", ["colmap", "text"])
def test_points_in_tracks_give_sparse_depth(tmp_path, layout):
    made = traced()
    WRITERS[layout](tmp_path, made.views, made.points, made.colors)
    dataset, report = given(tmp_path, DepthSource(POINTS))
    assert report.used == 10 and report.points > 100
    tracked = tracked_points(tmp_path)
    for view in dataset.train:
        depth = view.depth()
        at = view.camera.world_to_cam(tracked.points[tracked.seen[view.name]])
        at = at[[0 <= u <= 63 and 0 <= v <= 47 for u, v in zip(*view.camera.project(at)[:2], strict=True)]]
        assert depth.sparse and len(depth) == len(at) > 0.9 * len(tracked.seen[view.name])
        assert np.allclose(depth.depths, at[:, 2], rtol=1e-6)
        assert np.allclose(depth.rays, at[:, :2] / at[:, 2:], rtol=1e-5, atol=1e-6)


def test_points_of_large_error_or_few_views_are_left_out(tmp_path):
    """An error of 3 px, and two views, are not enough."""
    made = traced()
    WRITERS["text"](tmp_path, made.views, made.points, made.colors)
    path = tmp_path / "sparse" / "0" / "points3D.txt"
    lines = path.read_text().splitlines()
    before = len(tracked_points(tmp_path).points)
    changed = [
        " ".join([*line.split()[:7], "3.0", *line.split()[8:]]) if i % 2 else line
        for i, line in enumerate(lines)
    ]
    path.write_text("\n".join([lines[0], *changed[1:]]) + "\n")
    after = len(tracked_points(tmp_path).points)
    assert 0.4 * before < after < 0.6 * before
    views = np.zeros(len(made.points), int)
    for line in (tmp_path / "sparse" / "0" / "images.txt").read_text().splitlines()[2::2]:
        views[np.array(line.split()[2::3], int) - 1] += 1
    assert before == (views >= 3).sum()


def test_a_capture_without_tracks_says_so(tmp_path):
    with pytest.raises(DatasetError, match="has no tracks of points that photos see"):
        given(write_capture(tmp_path, "transforms"), DepthSource(POINTS))


def test_samples_fit_photos_of_any_size_and_distorted_ones(tmp_path):
    """Rays do not change with the resolution; through a lens that distorts they follow the pinhole's."""
    folder, maps = write_capture(tmp_path / "capture"), write_maps(tmp_path / "maps")
    full, _ = given(folder, DepthSource(maps))
    half, _ = given(folder, DepthSource(maps), DataSettings(resolution=2.0, test_every=0))
    assert np.array_equal(full.train[0].depth().rays, half.train[0].depth().rays)
    assert full.train[0].scaled(2.0).depth is full.train[0].depth
    path = folder / "sparse" / "0" / "cameras.bin"
    path.unlink()
    made, camera = traced(), traced().views[0].camera
    WRITERS["text"](folder, made.views, made.points, made.colors)
    cameras = path.with_suffix(".txt")
    values = f"64 48 {camera.fx} {camera.cx + 0.5} {camera.cy + 0.5} 0.05"
    cameras.write_text(f"1 SIMPLE_RADIAL {values}\n")
    for name in ("images.bin", "points3D.bin"):
        path.with_name(name).unlink()
    dataset, _ = given(folder, DepthSource(maps))
    samples, small = dataset.train[0].depth(), small_camera(dataset.train[0].camera)
    columns = small.fx * samples.rays[:, 0] + small.cx
    assert np.abs(columns - np.rint(columns)).max() < 0.05 and columns.max() < SIZE[0] - 0.9


def scan_of_all():
    """Return the points that a scanner at every camera would measure, world units."""
    points = []
    for view, depth in zip(traced().views, exact_depths(), strict=True):
        small = small_camera(view.camera)
        v, u = np.nonzero(depth)
        z = depth[v, u]
        local = np.stack([(u - small.cx) / small.fx * z, (v - small.cy) / small.fy * z, z], axis=1)
        points.append(local @ view.camera.R + view.camera.eye)
    return np.concatenate(points)


def test_a_scan_gives_depth_where_nothing_hides_it(tmp_path):
    """A point that another surface hides would say that the photo sees farther than it does."""
    folder, scan = write_capture(tmp_path / "capture", "transforms"), scan_of_all()
    write_points_ply(tmp_path / "scan.ply", Cloud(scan, np.full(scan.shape, 0.5)))
    reader = CaptureReader(folder)
    dataset = Dataset.of(reader, EVERY, points=tmp_path / "scan.ply")
    dataset, report = with_depth(dataset, reader, DepthSource(SCAN), tmp_path / "scan.ply")
    assert report.used == 10 and "from the scan" in report.lines()[0]
    for view, exact in zip(dataset.train, exact_depths(), strict=True):
        samples, everything = view.depth(), sparse_depth(view.camera, scan)
        assert not samples.sparse and len(samples) > (exact > 0).sum()
        # beside an edge, the pixel that a point rounds to may show another surface
        assert (
            right_share(samples, view.camera, exact)
            > 0.95
            > 0.85
            > right_share(everything, view.camera, exact)
        )


def right_share(samples, camera, exact):
    """Return the share of samples within the slack of occlusion of the exact depth at their pixels."""
    small = small_camera(camera)
    u = np.rint(small.fx * samples.rays[:, 0] + small.cx).astype(int)
    v = np.rint(small.fy * samples.rays[:, 1] + small.cy).astype(int)
    inside = (u >= 0) & (u < SIZE[0]) & (v >= 0) & (v < SIZE[1])
    true = exact[v[inside], u[inside]]
    return (np.abs(samples.depths[inside] / np.maximum(true, 1e-9) - 1) < 0.06).mean()


def test_a_scan_has_to_be_named(tmp_path):
    with pytest.raises(DatasetError, match="^depth: comes from the scan that `points` names"):
        given(write_capture(tmp_path, "transforms"), DepthSource(SCAN))
