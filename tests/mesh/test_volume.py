"""A sparse volume turns depth maps into the surface that they saw."""

import re

import numpy as np
import pytest
import torch

import known_surfaces as surfaces
from gsplat_edu import ArgumentError, Camera
from gsplat_edu.base.errors import NotEnoughMemoryError
from gsplat_edu.mesh.volume import SparseVolume

VOXEL = 0.017
"""1.7 pixels of the orbit's cameras at the solids."""


def scanned(depth_of, cameras, voxel=VOXEL, image_of=None, **settings):
    volume = SparseVolume(voxel, **settings)
    for camera in cameras:
        volume.integrate(depth_of(camera), camera, image=image_of and image_of(camera))
    return volume


@pytest.fixture(scope="module")
def sphere():
    return scanned(surfaces.sphere_depth, surfaces.orbit())


@pytest.fixture
def set_threads():
    before = torch.get_num_threads()
    yield torch.set_num_threads
    torch.set_num_threads(before)


def facing(H=60, W=80, focal=80.0):
    """A camera at the origin that looks along +z."""
    return Camera(np.eye(3), np.zeros(3), focal, focal, (W - 1) / 2, (H - 1) / 2, H, W)


def same(first, second):
    parts = [(mesh.vertices, mesh.faces, mesh.colors) for mesh in (first, second)]
    return all((a is None and b is None) or a.tobytes() == b.tobytes() for a, b in zip(*parts, strict=True))


def test_a_sphere_is_closed_round_and_where_it_was(sphere):
    mesh = sphere.mesh()
    surfaces.assert_closed_manifold(mesh)
    assert surfaces.euler(mesh) == 2
    assert np.abs(np.linalg.norm(mesh.vertices, axis=1) - 1).mean() < 0.03 * VOXEL
    assert surfaces.enclosed(mesh) == pytest.approx(4 / 3 * np.pi, rel=0.001)
    middle = mesh.corners.mean(axis=1)
    assert ((mesh.face_normals() * middle).sum(-1) >= 0).all()
    assert mesh.colors is None


def test_a_box_with_a_slanted_face_is_closed_and_where_it_was():
    mesh = scanned(surfaces.box_depth, surfaces.orbit()).mesh()
    surfaces.assert_closed_manifold(mesh)
    assert surfaces.euler(mesh) == 2
    outside = (mesh.vertices @ surfaces.BOX_NORMALS.T - surfaces.BOX_OFFSETS).max(axis=1)
    assert np.abs(outside).mean() < 0.06 * VOXEL
    assert np.abs(outside).max() < VOXEL  # the edges


@pytest.mark.parametrize("count", [2, 5])
def test_threads_do_not_change_a_bit(count, set_threads):
    cameras = surfaces.orbit(4)

    def made():
        return scanned(surfaces.sphere_depth, cameras, image_of=lambda c: surfaces.rays(c) * 0.2 + 0.5).mesh()

    set_threads(1)
    alone = made()
    set_threads(count)
    assert same(made(), alone) and len(alone.faces) > 1000


def test_a_slanted_plane_is_exact():
    camera, normal = facing(), np.array([0.3, -0.2, 1.0])
    depth = 2 / (surfaces.rays(camera) @ normal)
    volume = SparseVolume(0.03)
    volume.integrate(depth, camera)
    mesh = volume.mesh()
    assert len(mesh.faces) > 1000
    u, v, _ = camera.project(mesh.vertices)
    within = (np.abs(u - 39.5) < 38) & (
        np.abs(v - 29.5) < 28
    )  # beside the image's border, the nearest pixel counts
    assert within.sum() > 1000
    assert np.abs(mesh.vertices[within] @ normal - 2).max() < 0.01 * 0.03
    towards_camera = mesh.face_normals() @ normal
    assert (towards_camera <= 0).all()


def expected(centres, views, truncation):
    """The definition in float64: mean distance and weight at points, after (camera, depth, weights) of each view."""
    mean, total = np.zeros(len(centres)), np.zeros(len(centres))
    for camera, given, weighed in views:
        x, y, z = ((centres - camera.eye) @ camera.R.T).T
        ahead = z > 0
        u = np.where(ahead, camera.fx * x / np.where(ahead, z, 1) + camera.cx, -9)
        v = np.where(ahead, camera.fy * y / np.where(ahead, z, 1) + camera.cy, -9)
        u, v = np.clip(u, -2, camera.W + 1), np.clip(v, -2, camera.H + 1)
        depth, weights = np.pad(np.where(weighed > 0, given, 0), 3), np.pad(weighed, 3)
        left, top = np.floor(u).astype(int), np.floor(v).astype(int)
        right, down = u - left, v - top
        four = np.stack([depth[top + 3 + k // 2, left + 3 + k % 2] for k in range(4)])
        share = np.stack([(1 - right) * (1 - down), right * (1 - down), (1 - right) * down, right * down])
        smooth = (four.min(axis=0) > 0) & (four.max(axis=0) - four.min(axis=0) < truncation)
        nearest = (np.floor(v + 0.5).astype(int) + 3, np.floor(u + 0.5).astype(int) + 3)
        between = 1 / (share / np.where(smooth, four, 1)).sum(axis=0)
        behind = np.where(smooth, between, depth[nearest]) - z
        known = smooth | (depth[nearest] > 0)
        weight = weights[nearest] * np.where(smooth, 1, 1 / 64) * np.clip(2 + 2 * behind / truncation, 0, 1)
        weight = np.where(known, weight, 0)
        total = total + weight
        mean += np.where(
            weight > 0, (np.minimum(behind, truncation) - mean) * weight / np.maximum(total, 1e-30), 0
        )
    return mean, total


@pytest.mark.parametrize("seed", range(3))
def test_every_voxel_is_as_defined(seed):
    """Cameras anywhere, also in the middle of the surface, with rough depth: no block is skipped that a view sees."""
    rng = np.random.default_rng(seed)
    views = []
    for _ in range(6):
        R = np.linalg.qr(rng.normal(size=(3, 3)))[0]
        R *= np.sign(np.linalg.det(R))
        H, W = map(int, rng.integers(20, 70, 2))
        focal, middle = rng.uniform(15, 90, 2), rng.uniform(-0.2, 1.2, 2) * (W, H)
        camera = Camera(R, rng.normal(scale=0.5, size=3), *focal, *middle, H, W)
        depth = rng.uniform(0.1, 2.5) + 0.3 * rng.normal() * np.arange(W) / W + 0.01 * rng.normal(size=(H, W))
        depth = np.where(rng.uniform(size=(H, W)) < 0.02, 0, np.maximum(depth, 0)).astype(np.float32)
        weights = rng.integers(0, 40, (H, W)).clip(max=3).astype(np.float32)
        views.append((camera, depth, weights))
    volume = SparseVolume(0.05)
    for camera, depth, weights in views:
        volume.integrate(depth, camera, weights)
    places = np.empty((volume.blocks, 3), np.int64)
    distances, weights = np.empty((2, volume.blocks, 8, 8, 8), np.float32)
    volume._native.read(places=places, distances=distances, weights=weights)
    k, j, i = np.indices((8, 8, 8)).reshape(3, -1)
    centres = 0.05 * (8 * places[:, None] + np.stack([i, j, k], axis=-1) + 0.5)
    # Every voxel takes only the views up to those that made its block: all views see blocks of the first ones.
    again = SparseVolume(0.05)
    again._native.load(places=places, distances=np.zeros_like(distances), weights=np.zeros_like(weights))
    for camera, depth, given in views:
        again.integrate(depth, camera, given)
    assert again.blocks == volume.blocks
    again._native.read(places=places, distances=distances, weights=weights)
    mean, total = expected(centres.reshape(-1, 3), views, 3 * 0.05)
    # float32 decides otherwise at places between two pixels and at jumps of just the truncation
    close = np.isclose(weights.ravel(), total, atol=1e-3) & np.isclose(distances.ravel(), mean, atol=1e-4)
    assert (total > 0).mean() > 0.1 and (~close).sum() <= 3


def test_weights_weigh():
    camera = facing()
    volume = SparseVolume(0.1, truncation=0.5)
    plane = np.full((60, 80), 2.0)
    volume.integrate(plane, camera, weights=np.full((60, 80), 3.0))
    volume.integrate(plane + 0.1, camera, weights=np.full((60, 80), 1.0))
    volume.integrate(plane + 0.4, camera, weights=np.zeros((60, 80)))
    assert volume.mesh().vertices[:, 2] == pytest.approx(2.025, abs=1e-5)
    assert len(volume.mesh(min_weight=3.5).faces) > 100
    assert len(volume.mesh(min_weight=4.0).faces) == 0


def test_a_hole_in_the_depth_stays_open():
    def depth_of(camera):
        depth = surfaces.sphere_depth(camera)
        hit = camera.eye + depth[..., None] * surfaces.rays(camera)
        return np.where(hit[..., 0] > 0.8, 0, depth)

    mesh = scanned(depth_of, surfaces.orbit(), 0.04).mesh()
    ends = mesh.vertices[surfaces.open_edges(mesh).ravel()]
    assert len(ends) > 40 and (np.abs(ends[:, 0] - 0.8) < 0.12).all()
    assert mesh.vertices[:, 0].max() < 0.9 and mesh.vertices[:, 0].min() < -0.99


def test_blocks_smaller_than_a_pixel_leave_no_hole():
    camera = facing(12, 16, 16.0)
    volume = SparseVolume(2 / 16 / 12)  # a pixel covers 12 voxels of the plane at 2
    volume.integrate(np.full((12, 16), 2.0), camera)
    mesh = volume.mesh()
    border = len(surfaces.open_edges(mesh))
    assert len(mesh.vertices) - (3 * len(mesh.faces) + border) // 2 + len(mesh.faces) == 1  # a disc


def test_a_view_says_nothing_behind_its_surface():
    camera, volume = facing(), SparseVolume(0.1, truncation=0.3)
    volume.integrate(np.full((60, 80), 2.0), camera)
    assert same(volume.mesh(), volume.mesh())
    assert volume.mesh().vertices[:, 2] == pytest.approx(
        2.0, abs=1e-6
    )  # no second surface at the end of the band


def test_colors_are_those_of_the_surface():
    def image_of(camera):
        hit = camera.eye + surfaces.sphere_depth(camera)[..., None] * surfaces.rays(camera)
        return np.clip(0.5 + 0.4 * hit, 0, 1)

    cameras = surfaces.orbit(16)
    mesh = scanned(surfaces.sphere_depth, cameras, 0.03, image_of).mesh()
    error = np.abs(mesh.colors - (0.5 + 0.4 * mesh.vertices)).max(axis=1)
    assert error.mean() < 0.005 and error.max() < 0.05
    rounded = scanned(
        surfaces.sphere_depth, cameras, 0.03, lambda c: np.rint(255 * image_of(c)).astype(np.uint8)
    )
    assert np.abs(rounded.mesh().colors - mesh.colors).max() < 0.6 / 255
    white = scanned(
        surfaces.sphere_depth, cameras, 0.06, lambda c: np.full((c.H, c.W, 3), 255, np.uint8)
    ).mesh()
    assert np.array_equal(white.colors, np.ones_like(white.vertices))


def test_views_have_images_or_none():
    camera, plane, image = facing(), np.full((60, 80), 2.0), np.zeros((60, 80, 3), np.uint8)
    for first, second, words in (
        (None, image, "earlier views had none"),
        (image, None, "earlier views had one"),
    ):
        volume = SparseVolume(0.1)
        volume.integrate(plane, camera, image=first)
        before, size = volume.mesh(), volume.memory
        with pytest.raises(ArgumentError, match=words):
            volume.integrate(plane + 1, camera, image=second)
        assert same(volume.mesh(), before) and volume.memory == size


def test_tensors_and_float32_and_strides_are_the_same_as_arrays():
    camera = facing()
    depth = 2 + 0.01 * np.random.default_rng(0).normal(size=(60, 80)).astype(np.float32)
    wide = np.zeros((60, 160), np.float32)
    wide[:, ::2] = depth
    meshes = []
    for given in (depth, depth.astype(np.float64), torch.from_numpy(depth), wide[:, ::2]):
        volume = SparseVolume(0.1)
        volume.integrate(given, camera)
        meshes.append(volume.mesh())
    assert all(same(mesh, meshes[0]) for mesh in meshes)


def put(value, shape=(60, 80), dtype=np.float32):
    array = np.ones(shape, dtype)
    array[3, 1] = value
    return array


@pytest.mark.parametrize(
    ("words", "given"),
    [
        ("depth[3, 1]: is nan, but every entry has to be finite and at least 0", {"depth": put(np.nan)}),
        ("depth[3, 1]: is inf", {"depth": put(np.inf)}),
        ("depth[3, 1]: is 1e+300", {"depth": put(1e300, dtype=np.float64)}),
        ("depth[3, 1]: is -1.0", {"depth": put(-1)}),
        ("depth: expected shape (60, 80), got (80, 60)", {"depth": np.ones((80, 60), np.float32)}),
        ("depth: expected shape (60, 80), got (60, 80, 1)", {"depth": np.ones((60, 80, 1), np.float32)}),
        ("depth: is of dtype uint16, but has to be float32 or float64", {"depth": put(1, dtype=np.uint16)}),
        ("depth: is of dtype float16", {"depth": torch.ones(60, 80, dtype=torch.float16)}),
        ("depth: is of dtype torch.bfloat16", {"depth": torch.ones(60, 80, dtype=torch.bfloat16)}),
        ("depth: is on meta", {"depth": torch.ones(60, 80, device="meta")}),
        ("depth: is of type list, but has to be an array or a tensor", {"depth": [[1.0]]}),
        ("depth: reaches beyond 8388600 voxels", {"depth": put(1e30)}),
        ("weights[3, 1]: is -0.5", {"weights": put(-0.5)}),
        ("weights: expected shape (60, 80), got (60,)", {"weights": np.ones(60, np.float32)}),
        (
            "image[3, 1, 0]: is 1.5, but every entry has to be finite and from 0 to 1",
            {"image": put(1.5, (60, 80, 3))},
        ),
        ("image: expected shape (60, 80, 3), got (60, 80)", {"image": np.ones((60, 80), np.uint8)}),
        (
            "image: is of dtype int64, but has to be uint8, float32 or float64",
            {"image": put(1, (60, 80, 3), int)},
        ),
        ("camera: is not a camera", {"camera": object()}),
    ],
)
def test_what_does_not_fit_is_named_and_changes_nothing(words, given, as_shipped):
    volume = SparseVolume(0.1)
    arguments = {"depth": put(1), "camera": facing()} | given
    with pytest.raises(ArgumentError, match=re.escape(words)) as caught:
        volume.integrate(**arguments)
    assert "\n" not in str(caught.value)
    assert volume.memory == 0 and len(volume.mesh().faces) == 0


@pytest.mark.parametrize(
    ("words", "settings"),
    [
        ("voxel: is 0", {"voxel": 0.0}),
        ("voxel: is nan|voxel: is NaN", {"voxel": np.nan}),
        (
            "truncation: is 0.05, but has to be at least 0.1 and at most 6.4",
            {"voxel": 0.1, "truncation": 0.05},
        ),
        ("truncation: is 7", {"voxel": 0.1, "truncation": 7.0}),
        ("max_bytes: is -1", {"voxel": 0.1, "max_bytes": -1}),
        ("max_bytes: is 1.5", {"voxel": 0.1, "max_bytes": 1.5}),
    ],
)
def test_settings_out_of_range_are_named(words, settings, as_shipped):
    with pytest.raises(ArgumentError, match=words):
        SparseVolume(**settings)
    with pytest.raises(ArgumentError, match="min_weight: is -1"):
        SparseVolume(0.1).mesh(min_weight=-1)


def test_the_limit_is_kept_and_the_volume_unchanged():
    first, *others = surfaces.orbit(8)
    free = scanned(surfaces.sphere_depth, [first], 0.02)
    volume = scanned(surfaces.sphere_depth, [first], 0.02, max_bytes=free.memory)  # fits exactly
    before = volume.mesh()
    with pytest.raises(NotEnoughMemoryError) as caught:
        volume.integrate(surfaces.sphere_depth(others[-1]), others[-1])
    sizes = r"needs at least [\d.]+ MiB with this view, but may take [\d.]+ MiB"
    assert re.fullmatch(f"volume: {sizes}; take a voxel larger than 0.02", str(caught.value))
    assert same(volume.mesh(), before) and volume.memory == free.memory == 4120 * free.blocks
    volume.integrate(surfaces.sphere_depth(first), first)  # what needs no new block still goes in
    with pytest.raises(NotEnoughMemoryError):
        scanned(surfaces.sphere_depth, [first], 0.02, max_bytes=free.memory - 1)


def test_a_limit_ends_a_hopeless_view_early():
    """Voxels of a ten thousandth of a pixel: all blocks of the view would take terabytes."""
    camera = facing()
    volume = SparseVolume(1e-6, truncation=6.4e-5, max_bytes=10_000_000)
    with pytest.raises(NotEnoughMemoryError):
        volume.integrate(np.full((60, 80), 2.0), camera)
    assert volume.blocks == 0


def test_without_views_or_surfaces_the_mesh_is_empty():
    volume = SparseVolume(0.1)
    assert volume.mesh().vertices.shape == (0, 3) and volume.memory == 0
    volume.integrate(np.zeros((60, 80)), facing(), image=np.zeros((60, 80, 3)))
    mesh = volume.mesh()
    assert mesh.vertices.shape == mesh.faces.shape == mesh.colors.shape == (0, 3)
    assert (mesh.vertices.dtype, mesh.faces.dtype, mesh.colors.dtype) == (np.float64, np.int64, np.float32)


def test_a_mesh_outlives_its_volume(sphere):
    mesh = scanned(surfaces.sphere_depth, surfaces.orbit(2), 0.05).mesh()
    kept = mesh.vertices.copy()
    for _ in range(4):
        scanned(surfaces.sphere_depth, surfaces.orbit(2), 0.05).mesh()
    assert np.array_equal(mesh.vertices, kept)
