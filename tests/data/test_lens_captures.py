"""Photos through lenses and moving cameras: points of the surface are at the pixels that `Camera.sight` says."""

import numpy as np
import pytest

from gsplat_edu import ArgumentError, Camera
from gsplat_edu.scene.projection import Distortion, Projection
from gsplat_edu.scene.shutter import AT_ONCE, RollingShutter
from lab.captures.fine_rays import fine_rays
from lab.captures.garden import photograph_garden
from lab.captures.lens_captures import (
    LENS_KINDS,
    LENS_SCENES,
    fisheye_180,
    lens_capture,
    lens_photos,
    shaken,
    with_rays,
)
from lab.captures.solids import solids
from lab.captures.solids_photos import photograph_solids, solids_orbit

SIZE = 48


def cameras_of(scene):
    """Return a camera of every projection and a moving one, in one pose."""
    (pinhole,) = LENS_SCENES[scene].cameras(1, (SIZE, 36))
    rng = np.random.default_rng(0)
    lens = Projection(distortion=Distortion.of(k1=-0.2, k2=0.03, p1=0.004))
    moving = RollingShutter((0.02, 0.05, -0.03), (0.05, 0.02, 0.04), "left")
    return {
        "pinhole": pinhole,
        "distorted": pinhole.through(lens),
        "fisheye": fisheye_180(pinhole, SIZE),
        "panorama": Camera.panorama(pinhole.R, pinhole.eye, SIZE // 2, SIZE),
        "orthographic": Camera(pinhole.R, pinhole.eye, 12.0, 12.0, 23.5, 17.5, 36, SIZE).through(
            Projection("orthographic")
        ),
        "shaken": shaken(pinhole, 8.0, LENS_SCENES[scene].target, rng),
        "fisheye, moving": fisheye_180(pinhole, SIZE).through(Projection("fisheye"), moving),
    }


NAMES = tuple(cameras_of("solids"))


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("scene", LENS_SCENES)
def test_points_of_the_surface_are_seen_at_their_pixels(scene, name):
    """The garden's points belong to a ray a quarter of a pixel left of and above the centre."""
    camera = cameras_of(scene)[name]
    points = LENS_SCENES[scene].photograph(camera).points
    shown = np.isfinite(points[..., 0]) & with_rays(camera)
    assert shown.sum() > 20
    rows, columns = np.nonzero(shown)
    seen = camera.sight(points[shown])
    aside = -0.25 if scene == "garden" else 0.0
    # float32 in the garden; three steps of Newton's method if the camera moves
    atol = 2e-3 if scene == "garden" else 1e-6 if camera.shutter is None else 1e-4
    assert seen.valid.all()
    np.testing.assert_allclose(seen.u, columns + aside, rtol=0, atol=atol)
    np.testing.assert_allclose(seen.v, rows + aside, rtol=0, atol=atol)


@pytest.mark.parametrize("scene", LENS_SCENES)
def test_the_formulas_of_a_pinhole_are_the_general_rays(scene):
    """A distortion of nearly nothing takes the general way, and makes the same photo."""
    camera = cameras_of(scene)["pinhole"]
    general = camera.through(Projection(distortion=Distortion.of(k1=1e-12)))
    photograph = LENS_SCENES[scene].photograph
    apart = np.abs(photograph(camera).image.astype(int) - photograph(general).image)
    assert not general.pinhole and (apart > 1).mean() < 1e-3


def test_rows_of_a_moving_camera_are_those_of_cameras_at_rest():
    """A row is photographed by a camera at rest in the pose of the row, but for the motion within the row."""
    (rest,) = LENS_SCENES["solids"].cameras(1, (SIZE, 36))
    shutter = RollingShutter((0.0, 0.1, 0.0), (0.1, 0.05, 0.0), "down")
    scene = solids(True)
    depth = photograph_solids(scene, rest.through(shutter=shutter)).depth
    for row in (13, 18, 30):
        time = (row + 0.5) / 36 - 0.5
        R = shutter.rotation(time) @ rest.R
        there = Camera.posed(R, rest.eye + time * shutter.shift, rest.intrinsics)
        np.testing.assert_allclose(depth[row], photograph_solids(scene, there).depth[row], rtol=0, atol=1e-9)
    assert np.abs(depth - photograph_solids(scene, rest).depth)[13].max() > 0.05


def test_fine_rays_are_those_of_places_within_pixels():
    camera = cameras_of("solids")["fisheye, moving"]
    origins, rays = fine_rays(camera, 3)
    has = with_rays(camera)
    np.testing.assert_allclose(rays[1::3, 1::3][has], camera.rays()[has], rtol=0, atol=1e-12)
    np.testing.assert_allclose(origins[1::3, 1::3][has], camera.origins()[has], rtol=0, atol=1e-12)


@pytest.mark.parametrize("pixels", [20.0, 40.0])
def test_a_point_at_the_middle_of_a_shaken_image_moves_by_the_given_pixels(pixels):
    place = LENS_SCENES["garden"]
    for camera in place.cameras(5, (320, 240)):
        moving = shaken(camera, pixels, place.target, np.random.default_rng(3))
        ends = []
        for time in (-0.5, 0.5):
            R = moving.shutter.rotation(time) @ camera.R
            end = Camera.posed(R, camera.eye + time * moving.shutter.shift, camera.intrinsics)
            ends.append(np.array(end.project(end.world_to_cam(place.target))[:2]))
        assert np.linalg.norm(ends[1] - ends[0]) == pytest.approx(pixels, rel=0.01)


@pytest.mark.parametrize("kind", LENS_KINDS)
def test_a_capture_has_its_cameras_and_pinholes_of_the_same_poses(kind):
    found = lens_capture(kind, "garden", 40, 3, start=50)
    assert len(found.views) == len(found.pinholes) == 3
    assert found.points.shape == found.colors.shape == (50, 3) and np.ptp(found.colors) > 0.1
    for view, plain in zip(found.views, found.pinholes, strict=True):
        assert plain.camera.pinhole and not view.camera.pinhole
        np.testing.assert_array_equal(view.camera.R, plain.camera.R)
        np.testing.assert_array_equal(view.camera.eye, plain.camera.eye)
        assert (view.read().mask is None) == (kind != "fisheye")
    motions = {view.camera.motion for view in found.views}
    assert len(motions) == (3 if kind.startswith(("shutter", "blur")) else 1)


def test_a_blurred_photo_is_the_average_of_moments_in_linear_light():
    (view,) = lens_capture("blur_8", "garden", 40, 1, start=50).views
    shutter, rest = view.camera.shutter, view.camera.through()
    assert shutter.readout == AT_ONCE and shutter.exposure == 1
    moments = []
    for time in (np.arange(16) + 0.5) / 16 - 0.5:
        R, eye = shutter.rotation(time) @ rest.R, rest.eye + time * shutter.shift
        value = photograph_garden(Camera.posed(R, eye, rest.intrinsics)).image / 255
        moments.append(np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4))
    light = np.mean(moments, axis=0)
    mixed = np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)
    np.testing.assert_allclose(view.read().image, 255 * mixed, rtol=0, atol=0.51)
    sharp = photograph_garden(rest).image
    assert (
        np.abs(np.diff(sharp.astype(float), axis=1)).mean()
        > 1.2 * np.abs(np.diff(view.read().image.astype(float), axis=1)).mean()
    )


def test_a_fisheye_s_photo_is_a_circle():
    (view,) = lens_capture("fisheye", "garden", 64, 1, start=10).views
    photo = view.read()
    rows, columns = np.mgrid[:64, :64] - 31.5
    np.testing.assert_array_equal(photo.mask, np.hypot(rows, columns) <= 32.0)
    assert (photo.image[~photo.mask] == 0).all() and photo.image[photo.mask].mean() > 40


def test_pixels_beyond_the_end_of_a_lens_are_black():
    camera = solids_orbit(1, (SIZE, 36))[0]
    wide = Camera(camera.R, camera.eye, 20.0, 20.0, 23.5, 17.5, 36, SIZE)
    barrel = wide.through(Projection(distortion=Distortion.of(k1=-0.3)))
    there = with_rays(barrel)
    assert 0.2 < there.mean() < 0.95
    for photo in (photograph_solids(solids(True), barrel).image, photograph_garden(barrel).image):
        assert (photo[~there] == 0).mean() > 0.8 and photo[there].mean() > 20
    found = lens_photos("solids", [barrel], [wide], 10, np.random.default_rng(0))
    assert (found.views[0].read().image[~there] == 0).all()


def test_unknown_names_are_refused(as_shipped):
    with pytest.raises(ArgumentError, match="kind"):
        lens_capture("cylinder")
    with pytest.raises(ArgumentError, match="scene"):
        lens_capture("fisheye", "moon")
