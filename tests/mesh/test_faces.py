"""Cameras with a lens are shown by pinholes: they see what the lens sees, and photos are drawn in them."""

import numpy as np
import pytest

from gsplat_edu import ArgumentError, Camera, load_backend
from gsplat_edu.evaluate.topology import topology
from gsplat_edu.mesh.depths import render_depths
from gsplat_edu.mesh.extract import extract_mesh
from gsplat_edu.mesh.faces import drawn_in, faces_of, in_view
from gsplat_edu.render.settings import RenderSettings
from gsplat_edu.scene.projection import Distortion, Projection
from gsplat_edu.scene.shutter import RollingShutter
from splat_ball import RADIUS, ball

SETTINGS = RenderSettings(jacobian_limit=1.3)
FISHEYE = Projection("fisheye", Distortion.of(k1=-0.02))
BARREL = Projection("perspective", Distortion.of(k1=-0.2, k2=0.05))
PAN = RollingShutter([0.02, -0.05, 0.01], [0.05, 0.0, 0.02])


def looking(eye, f, side, projection=None, shutter=None):
    camera = Camera.looking_at(eye, (0, 0, 0), f, f, side, side)
    return camera.through(projection or Projection(), shutter)


LENSES = {
    "fisheye": looking((0.4, -0.5, -3), 40, 96, FISHEYE),
    "cropped fisheye": looking((0.4, -0.5, -3), 90, 96, FISHEYE),
    "barrel": looking((0.4, -0.5, -3), 90, 96, BARREL),
    "wide": looking((0.4, -0.5, -3), 25, 96, Projection("perspective", Distortion.of(k1=-0.02))),
    "shutter": looking((0.4, -0.5, -3), 90, 96, Projection(), PAN),
    "panorama": Camera.panorama(np.eye(3), (0.2, 0.1, -3), 48, 96),
}


@pytest.mark.parametrize("name", LENSES)
def test_every_ray_of_a_lens_is_in_a_face(name):
    camera = LENSES[name].through(LENSES[name].projection)
    rays = camera.rays().reshape(-1, 3)
    points = camera.eye + rays[np.isfinite(rays).all(axis=1)]
    faces = faces_of(LENSES[name])
    shown = np.zeros(len(points), dtype=bool)
    for face in faces:
        assert face.pinhole and np.array_equal(face.eye, camera.eye)
        seen = face.sight(points)
        # rays meet the face between its pixels' centres, or at most half a pixel beside the outermost ones
        shown |= (
            seen.valid
            & (seen.u >= -0.51)
            & (seen.v >= -0.51)
            & (seen.u <= face.W - 0.49)
            & (seen.v <= face.H - 0.49)
        )
        assert in_view(camera, face).any()
    assert shown.all()
    assert len(faces) == {"fisheye": 5, "wide": 5, "panorama": 6}.get(name, 1)
    # a pixel of the lens's middle is as large as one of a face
    assert np.isclose(faces[0].fx, camera.fx, rtol=0.02)


def test_a_pinhole_is_its_own_face_and_an_orthographic_camera_has_none():
    pinhole = looking((0, 0, -3), 90, 96)
    assert faces_of(pinhole) == [pinhole]
    with pytest.raises(ArgumentError, match="orthographic"):
        faces_of(looking((0, 0, -3), 90, 96, Projection("orthographic")))


@pytest.mark.parametrize("name", LENSES)
def test_a_photo_is_drawn_in_a_face_as_the_pinhole_would_see_it(name):
    camera = LENSES[name]
    # the photo of a wall whose colours are its places; with a shutter, each row from where the camera was then
    # wall z = 1, seen from z < 0
    origins, rays = camera.origins(), camera.rays()
    with np.errstate(all="ignore"):
        far = (1.0 - origins[..., 2]) / rays[..., 2]
        places = (origins + far[..., None] * rays)[..., :2]
    photo = np.where((far > 0)[..., None], places, 0).astype(np.float32)
    compared = 0
    for face in faces_of(camera):
        toward = face.rays()
        with np.errstate(all="ignore"):
            depth = (1.0 - face.eye[2]) / toward[..., 2]
        hit = (depth > 0) & (depth < 8)
        drawn, inside = drawn_in(face, np.where(hit, depth, 0).astype(np.float32), camera, photo)
        expected = (face.eye + depth[..., None] * toward)[..., :2]
        both = hit & inside
        both &= np.abs(expected).max(axis=-1) < 3  # where a step of a pixel is a small one on the wall
        if name == "panorama":
            both[:2] = both[-2:] = both[:, :2] = both[:, -2:] = False
        compared += int(both.sum())
        # the places between four pixels of the photo are interpolated: the second derivative of the lens times
        # an eighth of a pixel squared, on a wall at 4, a pixel of which is 4 / f
        error = np.abs(drawn - expected)[both]
        assert not len(error) or np.quantile(error, 0.98) < 0.2 * 4 / camera.fx, name
    assert compared > 200


@pytest.mark.parametrize("name", ["fisheye", "barrel", "shutter", "panorama"])
def test_a_ball_is_meshed_through_a_lens(name):
    index = np.arange(20) + 0.5
    y, turn = 0.9 * (1 - 2 * index / 20), np.pi * (1 + 5**0.5) * index
    ring = np.sqrt(1 - y * y)
    eyes = 3.0 * np.stack([ring * np.cos(turn), y, ring * np.sin(turn)], axis=1)
    cameras = []
    for i, eye in enumerate(eyes):
        if name == "panorama":
            camera = Camera.panorama(Camera.looking_at(eye, (0, 0, 0), 1, 1, 8, 8).R, eye, 120, 240)
        else:
            shape = {"fisheye": (FISHEYE, None), "barrel": (BARREL, None), "shutter": (Projection(), PAN)}[
                name
            ]
            camera = looking(eye, {"fisheye": 60}.get(name, 150), 120, *shape)
        cameras.append((f"{i:02d}", camera))
    result = extract_mesh(ball(), cameras, SETTINGS, load_backend("cpu"))
    shape = topology(result.mesh)
    assert shape.components == 1 and shape.manifold
    off = np.linalg.norm(result.mesh.vertices, axis=1) - RADIUS
    # as for pinholes: depths are those of means, in front of the ball where it slants. A pixel of the panoramas is
    # 0.05 wide there, and as much of the ball's curve.
    assert np.abs(off).mean() < 0.03 and np.abs(off).max() < 0.1
    assert {view.name for view in result.views} <= {name for name, _ in cameras}
    assert all(view.lens is not None and view.camera.pinhole for view in result.views)


def test_what_a_lens_does_not_see_is_not_in_its_depth_maps():
    views = render_depths(ball(), [("a", LENSES["fisheye"])], SETTINGS, load_backend("cpu"))
    for view in views:
        seen = in_view(LENSES["fisheye"], view.camera)
        assert not (view.rendered[~seen] > 0).any() and not view.clear[~seen].any()
