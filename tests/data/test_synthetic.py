import numpy as np

from gsplat_edu import render_gaussians, sphere_shell
from gsplat_edu.data.synthetic import sphere_cameras, sphere_capture


def test_cameras_are_the_chapters():
    """Three rings by elevation, eight azimuths each, radius 3, fx = 150 size / 128."""
    cameras = sphere_cameras(64)
    expected = [
        3 * np.array([np.cos(el) * np.sin(a), np.sin(el), -np.cos(el) * np.cos(a)])
        for el in (-0.35, 0.0, 0.35)
        for a in np.radians(range(0, 360, 45))
    ]
    np.testing.assert_allclose([c.eye for c in cameras], expected, rtol=0, atol=1e-15)
    assert {(c.fx, c.fy, c.cx, c.cy, c.H, c.W) for c in cameras} == {(75, 75, 32, 32, 64, 64)}


def test_the_held_out_camera_is_not_a_training_camera():
    capture = sphere_capture(16)
    a, el = np.radians(202.5), 0.18
    eye = 3 * np.array([np.cos(el) * np.sin(a), np.sin(el), -np.cos(el) * np.cos(a)])
    np.testing.assert_allclose(capture.held_out.camera.eye, eye, rtol=0, atol=1e-15)
    distances = [np.linalg.norm(view.camera.eye - eye) for view in capture.train]
    assert len(distances) == 24 and min(distances) > 1


def test_photos_are_the_reference_renderers():
    view = sphere_capture(16).train[5]
    image, _ = render_gaussians(view.camera, *sphere_shell())
    np.testing.assert_array_equal(view.image, np.clip(image, 0, 1).astype(np.float32))
