"""Photos as the page's pinhole cameras see them, against formulas of an image that is known everywhere."""

import numpy as np
import pytest

from gsplat_edu.data.lens import lens_of
from gsplat_edu.data.lens_formulas import FORMULAS, PERSPECTIVE
from modules_in_node import answer

NAMES = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")


def area(N, n):
    """Return the matrix that averages N pixels along a side into n, by the overlaps of intervals."""
    edges = np.linspace(0.0, N, n + 1)
    k = np.arange(N)
    overlap = np.minimum(edges[1:, None], k + 1) - np.maximum(edges[:-1, None], k)
    return np.maximum(overlap, 0.0) * n / N


@pytest.mark.parametrize("size", [(8, 6), (7, 5), (16, 12), (1, 1)])
def test_smaller_photos_are_means_over_areas(size):
    """Rounding to bytes costs half a level, float64 nothing that counts beside it."""
    w, h = size
    pixels = np.random.default_rng(0).integers(0, 256, (12, 16, 4))
    body = "return [...reduced(given.pixels, [16, 12], 4, given.size)];"
    found = answer("lens.js", "reduced", body, {"pixels": pixels.ravel().tolist(), "size": size})
    wanted = np.einsum("yY,xX,YXc->yxc", area(12, h), area(16, w), pixels[..., :3])
    assert np.abs(np.reshape(found, (h, w, 3)) - wanted).max() <= 0.5 + 1e-9


def smooth(u, v):
    """Return an image whose waves are 57 px long, at any position."""
    return np.stack(
        [127 + 100 * np.sin(u / 9), 127 + 100 * np.cos(v / 9), 127 + 60 * np.sin((u + v) / 12)], axis=-1
    )


LENSES = [
    {},
    {"k1": -0.1},
    {"k1": 0.08, "k2": -0.02},
    {"k1": -0.08, "p1": 0.004, "p2": -0.003, "k3": 0.01, "k4": 0.01},
]


@pytest.mark.parametrize("given", LENSES)
@pytest.mark.parametrize("longest", [48, 200])
def test_an_undistorted_photo_shows_what_lies_on_its_rays(given, longest):
    """A pixel shows the original image at the place where the lens images its ray.

    Averages over s original px err by f'' s²/24 in each direction, and linear interpolation over m px by f'' m²/8,
    with |f''| <= 100/81: at s = 2 and m = 1 by 0.41 and 0.31 in two directions, and by less at the full size.
    Rounding thrice adds 1.5.
    """
    W, H = 96, 72
    v, u = np.mgrid[:H, :W].astype(float)
    photo = np.round(smooth(u, v)).astype(int)
    stored = np.concatenate([photo, np.full((H, W, 1), 255)], axis=-1)
    fields = {"W": W, "H": H, "fx": 90.0, "fy": 88.0, "cx": 48.3, "cy": 35.1}
    lens = {**fields, "coefficients": [given.get(name, 0.0) for name in NAMES]}
    body = """const { pinhole, pixels } = asPinhole(given.stored, given.lens, given.longest);
    const { W, H, fx, fy, cx, cy } = pinhole;
    const at = (x, y) => distorted(given.lens.coefficients, (x - cx) / fx, (y - cy) / fy);
    const places = Array.from({ length: W * H }, (_, i) => at(i % W, Math.floor(i / W)));
    return { pinhole, pixels: [...pixels], places };"""
    argument = {"stored": stored.ravel().tolist(), "lens": lens, "longest": longest}
    found = answer("lens.js", "asPinhole, distorted", body, argument)
    pinhole, places = found["pinhole"], np.array(found["places"])
    assert (pinhole["W"], pinhole["H"]) == ((48, 36) if longest == 48 else (W, H))
    u, v = (places * [fields["fx"], fields["fy"]] + [fields["cx"], fields["cy"]]).T
    assert u.min() > -0.6 and u.max() < W - 0.4 and v.min() > -0.6 and v.max() < H - 0.4  # no empty border
    wanted = smooth(u, v).reshape(pinhole["H"], pinhole["W"], 3)
    error = np.abs(np.reshape(found["pixels"], wanted.shape) - wanted)
    assert error[1:-1, 1:-1].max() < 2.3
    assert np.median(error) < 0.7


def test_formulas_and_pinholes_are_those_of_python():
    """OpenCV, which finds Python's pinhole, follows nine points of each edge, at most 48 rows from the innermost one.

    The ray's x changes by k1 x y² along an edge, by 0.06 * 0.57 * (48 / 900)² = 1e-4 between the two. The rectangle's
    half width is 0.57, so the focal length of 900 px differs by at most 0.15 px.
    """
    c = dict(zip(NAMES, (-0.06, 0.02, 0.001, -0.002, 0.003, 0.01, -0.004, 0.002), strict=True))
    lens = lens_of({"fx": 900.0, "fy": 905.0, "cx": 512.5, "cy": 380.5, **c}, 1024, 768)
    x, y = np.meshgrid(np.linspace(-0.5, 0.5, 5), np.linspace(-0.4, 0.4, 5))
    body = """return { image: given.rays.map(([x, y]) => distorted(given.lens.coefficients, x, y)),
      pinhole: pinholeOf(given.lens), back: given.rays.map(([x, y]) => {
        const [a, b] = distorted(given.lens.coefficients, x, y);
        return rayOf(given.lens, given.lens.fx * a + given.lens.cx, given.lens.fy * b + given.lens.cy);
      }) };"""
    fields = {name: getattr(lens, name) for name in ("W", "H", "fx", "fy", "cx", "cy")}
    rays = np.stack([x.ravel(), y.ravel()], axis=-1)
    given = {"lens": {**fields, "coefficients": list(c.values())}, "rays": rays.tolist()}
    found = answer("lens.js", "distorted, pinholeOf, rayOf", body, given)
    wanted = FORMULAS["perspective"].image(*rays.T, np.array([c[name] for name in PERSPECTIVE]))
    np.testing.assert_allclose(found["image"], np.stack(wanted, axis=-1), rtol=0, atol=1e-15)
    np.testing.assert_allclose(found["back"], rays, rtol=0, atol=1e-12)
    pinhole = lens.undistorted()
    for name in ("fx", "fy", "cx", "cy"):
        assert abs(found["pinhole"][name] - getattr(pinhole, name)) < 0.15


@pytest.mark.parametrize("k1", [-1.2, -0.6, 40.0])
def test_a_lens_that_folds_or_stretches_its_image_is_refused(k1):
    lens = {"W": 96, "H": 72, "fx": 60, "fy": 60, "cx": 47.5, "cy": 35.5, "coefficients": [k1, *[0.0] * 7]}
    body = "try { return pinholeOf(given); } catch (error) { return error.message; }"
    found = answer("lens.js", "pinholeOf", body, lens)
    assert isinstance(found, str) and "image_undistorter" in found
