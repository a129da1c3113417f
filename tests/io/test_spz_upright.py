"""Scenes with any up direction stand upright in SPZ for programs that know nothing of our extension.

The files are decoded here, splat by splat, without the package.
"""

import struct
from dataclasses import replace

import numpy as np
import pytest
import torch
import zstandard

from gsplat_edu import Camera, build_cov3d_batch, quat_to_R_batch, render_gaussians
from gsplat_edu.io import spz
from gsplat_edu.io.scene import Scene
from gsplat_edu.scene.gaussians import Gaussians
from gsplat_edu.scene.sh import sh_basis

HALF_HARMONIC = 0.5 / 128
HALF_ANGLE = 0.5 / 511
"""Half a step of a quaternion's smaller components is at most so much, and the rotation's angle six times as much."""
ROUNDING = 1e-6

Y_UP = {
    (0.0, 0.0, 1.0): [[1, 0, 0], [0, 0, 1], [0, -1, 0]],
    (0.0, 0.0, -1.0): [[1, 0, 0], [0, 0, -1], [0, 1, 0]],
    (1.0, 0.0, 0.0): [[0, 1, 0], [1, 0, 0], [0, 0, -1]],
    (-1.0, 0.0, 0.0): [[0, -1, 0], [-1, 0, 0], [0, 0, -1]],
    (0.0, 1.0, 0.0): [[1, 0, 0], [0, 1, 0], [0, 0, 1]],
    (0.0, -1.0, 0.0): [[1, 0, 0], [0, -1, 0], [0, 0, -1]],
}
"""What takes our axes to right, up, back if an axis is up: signed permutations, by hand."""


def overlapping_scene():
    """Return 40 splats with view-dependent colours, none of whose coefficients is cut off by the format."""
    normal = torch.Generator().manual_seed(4)

    def drawn(*shape):
        return torch.randn(*shape, generator=normal, dtype=torch.float64)

    return Gaussians(
        means=3 * drawn(40, 3),
        quats=drawn(40, 4),
        log_scales=drawn(40, 3),
        sh0=drawn(40, 1, 3).clamp(-3, 3),
        sh_rest=(0.12 * drawn(40, 15, 3)).clamp(-0.35, 0.35),
        logit_opacities=2 * drawn(40),
    )


def angle_between(a, b):
    """Return the largest angle between rotations of quaternions."""
    a, b = (torch.nn.functional.normalize(q.double(), dim=1) for q in (a, b))
    chord = torch.minimum((a - b).norm(dim=1), (a + b).norm(dim=1))
    return float(4 * torch.asin(chord / 2).max())


def stored_splats(path):
    """Decode a file of version 4 splat by splat, without extensions, into Gaussians in the file's own axes."""
    data = path.read_bytes()
    count, degree, bits, streams, table = *struct.unpack_from("<I", data, 8), data[12], data[13], data[15], 0
    (table,) = struct.unpack_from("<I", data, 16)
    contents, start = [], table + 16 * streams
    for i in range(streams):
        (packed,) = struct.unpack_from("<Q", data, table + 16 * i)
        contents.append(zstandard.decompress(data[start : start + packed]))
        start += packed
    fixed, opacities, colours, scales, rotations, harmonics = [*contents, b""][:6]
    means = [
        int.from_bytes(fixed[i : i + 3], "little", signed=True) / 2**bits for i in range(0, 9 * count, 3)
    ]
    quats = []
    for (word,) in struct.iter_unpack("<I", rotations):
        parts = [0.0] * 4  # x, y, z, w
        largest, shift = word >> 30, 0
        for k in (3, 2, 1, 0):
            if k != largest:
                field = word >> shift & 1023
                parts[k] = (field & 511) / 511 / 2**0.5 * (-1.0 if field & 512 else 1.0)
                shift += 10
        parts[largest] = (1.0 - sum(part**2 for part in parts)) ** 0.5
        quats.append([parts[3], *parts[:3]])
    chosen = np.clip(np.frombuffer(opacities, np.uint8) / 255.0, 1e-6, 1 - 1e-6)
    width = (degree + 1) ** 2 - 1
    arrays = {
        "means": np.array(means).reshape(-1, 3),
        "quats": np.array(quats),
        "log_scales": np.frombuffer(scales, np.uint8).reshape(-1, 3) / 16 - 10.0,
        "sh0": (np.frombuffer(colours, np.uint8).reshape(-1, 1, 3) - 127.5) / 38.25,
        "sh_rest": np.frombuffer(harmonics, np.uint8).reshape(count, width, 3) / 128.0 - 1.0,
        "logit_opacities": np.log(chosen / (1 - chosen)),
    }
    return Gaussians(**{name: torch.from_numpy(array) for name, array in arrays.items()})


def numpy_image(g, camera):
    """Render with the NumPy renderer; colours are those of each splat's direction from the eye."""
    means = g.means.numpy()
    directions = torch.nn.functional.normalize(torch.from_numpy(means - camera.eye), dim=1).numpy()
    coefficients = torch.cat([g.sh0, g.sh_rest], dim=1).numpy()
    colors = np.maximum(
        np.einsum("nk,nkc->nc", sh_basis(directions)[:, : coefficients.shape[1]], coefficients) + 0.5, 0
    )
    cov3ds = build_cov3d_batch(g.scales.numpy(), quat_to_R_batch(g.quats.numpy()))
    image, _ = render_gaussians(camera, means, cov3ds, colors, g.opacities.numpy(), extent="exact")
    return image


@pytest.mark.parametrize("up", [*Y_UP, (0.6, 0.0, -0.8), None])
def test_y_is_up_in_the_file_and_reading_turns_the_scene_back(tmp_path, up):
    """Other programs, which skip our extension, see the scene upright: positions, shapes and colours by direction."""
    path, g = tmp_path / "a.spz", overlapping_scene()
    spz.write(path, Scene(g, up=up))
    stored = stored_splats(path)
    M, *_ = np.linalg.lstsq(g.means.numpy(), stored.means.numpy(), rcond=None)
    M = M.T  # takes the scene's axes to the file's
    bits = path.read_bytes()[13]
    assert np.linalg.det(M) == pytest.approx(1, abs=1e-5)
    np.testing.assert_allclose(M @ (up or (0.0, -1.0, 0.0)), (0.0, 1.0, 0.0), atol=1e-5)
    if up in Y_UP:
        steps = np.rint(g.means.numpy() @ np.transpose(Y_UP[up]) * 2**bits)
        np.testing.assert_array_equal(steps, stored.means.numpy() * 2**bits)

    read = spz.read(path)
    np.testing.assert_allclose(read.up, up or (0.0, -1.0, 0.0), atol=1e-15)
    # a step along each of the file's axes is at most sqrt(3) steps, and sqrt(7) in the block of degree 3
    assert float((read.gaussians.means - g.means).abs().max()) <= 0.5 * 3**0.5 * 2.0**-bits + ROUNDING
    assert float((read.gaussians.sh_rest - g.sh_rest).abs().max()) <= HALF_HARMONIC * 7**0.5 + ROUNDING
    assert angle_between(read.gaussians.quats, g.quats) <= 6 * HALF_ANGLE

    U, _, Vt = np.linalg.svd(M)
    M = U @ Vt  # a rotation to the last digit
    camera = Camera.looking_at((1.0, -2.0, -9.0), (0.2, 0.1, 0.0), 30.0, 31.0, 24, 28)
    turned = Camera(camera.R @ M.T, M @ camera.eye, 30.0, 31.0, camera.cx, camera.cy, 24, 28)
    own, shown = numpy_image(read.gaussians.map(torch.Tensor.double), camera), numpy_image(stored, turned)
    # float32 of what is read, and M from rounded positions: 1e-6 of the distance, and 30 px a radian
    np.testing.assert_allclose(shown, own, atol=2e-4)
    assert shown.max() > 0.2
    assert np.abs(numpy_image(replace(stored, sh_rest=0 * stored.sh_rest), turned) - shown).max() > 0.02
