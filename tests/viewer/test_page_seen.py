"""A page tints what fewer than two photos saw, as the native kernels count it."""

import dataclasses
import gzip
import io

import numpy as np
import pytest
import torch
from PIL import Image

from gsplat_edu.base.constants import C0, SH_OFFSET
from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.io.scene import Scene
from gsplat_edu.render.api import render
from gsplat_edu.runs.source import Source, file_settings
from gsplat_edu.scene.camera import Camera, look_at
from gsplat_edu.viewer import page
from gsplat_edu.viewer.page_proof import (
    MOST_COUNTED,
    Proof,
    ShownPhoto,
    chosen_views,
    rounded_counts,
    seen_of,
)

TINT, GREY = np.array([230, 159, 0]) / 255, np.array([0.299, 0.587, 0.114])

LEAST_PSNR = 35.0
"""As for other pictures of the page."""


@pytest.fixture
def source(random_gaussians, tmp_path):
    """Splats of which the training cameras see some, and a held-out camera that sees them from behind."""
    gaussians = random_gaussians(500, rest=0)
    sh0 = 0.5 * torch.tanh(gaussians.sh0) / C0  # colours from 0 to 1
    gaussians = dataclasses.replace(gaussians, sh0=sh0, logit_opacities=gaussians.logit_opacities + 2)
    eyes = [(0.4, -0.6, -2.2), (-0.4, -0.5, -2.3), (0.9, -0.2, -2.0), (0.2, 0.1, 2.4)]
    named = [
        (f"IMG_{i}.jpg", Camera(look_at(eye, (0.0, 0.0, 0.0)), eye, 230.0, 230.0, 150.0, 100.0, 200, 300))
        for i, eye in enumerate(eyes)
    ]
    scene = Scene(gaussians)
    held_out = frozenset({"IMG_3.jpg"})
    return Source(tmp_path / "a.ply", scene, tuple(named), file_settings(scene), held_out=held_out)


def written(path, source, proof):
    tour = page.Tour(proof=proof)
    page.write(path, source.scene, source.cameras, source.settings, source.held_out, tour)
    return path


def tinted(gaussians, seen):
    """Return the splats in the colours that the page should give them."""
    colors = (C0 * gaussians.sh0[:, 0] + SH_OFFSET).clamp(min=0).numpy()
    grey = np.repeat(colors @ GREY[:, None], 3, axis=1)
    colors = np.where((seen < 2)[:, None], 0.25 * grey + 0.75 * TINT, grey)
    return dataclasses.replace(
        gaussians, sh0=torch.tensor((colors - SH_OFFSET) / C0, dtype=torch.float32)[:, None]
    )


def psnr(a, b):
    return -10 * np.log10(np.mean((a.astype(np.float64) - b) ** 2))


def test_the_tint_is_that_of_the_native_kernels_counts(visit, tmp_path, source):
    seen = seen_of(source)
    few = (seen < 2).mean()
    assert 0.1 < few < 0.9, "the test scene has splats of both kinds"
    shown = visit(fresh=True).open(written(tmp_path / "a.html", source, Proof(seen))).ready()
    views = [source.cameras[0][1], source.cameras[3][1]]
    shown.open_controls().tab.uncheck("#kept")

    def native(gaussians, camera):
        with torch.no_grad():
            return render(gaussians, camera, settings=source.settings, backend="cpu").image.numpy()

    for camera in views:
        assert psnr(shown.picture(camera), native(source.scene.gaussians, camera)) > LEAST_PSNR
    shown.tab.click("#seen")
    for camera in views:
        expected = native(tinted(source.scene.gaussians, seen), camera)
        assert psnr(shown.picture(camera), expected) > LEAST_PSNR
        flipped = native(tinted(source.scene.gaussians, 2 * (seen < 2)), camera)
        assert psnr(shown.picture(camera), flipped) < LEAST_PSNR - 10, "the measure tells the splats apart"
    assert shown.tab.get_attribute("#seen", "aria-pressed") == "true"
    assert f"{round(100 * few)} %" in shown.tab.inner_text("#legend")
    shown.press("v")
    assert shown.tab.get_attribute("#seen", "aria-pressed") == "false" and not shown.tab.is_visible("#legend")
    for camera in views:
        assert psnr(shown.picture(camera), native(source.scene.gaussians, camera)) > LEAST_PSNR


def test_what_no_photo_saw_fades_into_the_colour_of_the_photos_borders(visit, tmp_path, source):
    photo = io.BytesIO()
    Image.fromarray(np.full((40, 60, 3), (200, 100, 50), np.uint8)).save(photo, "JPEG", quality=95)
    proof = Proof(seen_of(source), [ShownPhoto(0, photo.getvalue(), (0.8, 0.4, 0.2))])
    assert proof.border() == pytest.approx((0.8, 0.4, 0.2))
    shown = visit(fresh=True).open(written(tmp_path / "a.html", source, proof)).ready()
    whole = source.scene.gaussians
    opacity = torch.sigmoid(whole.logit_opacities) * torch.where(torch.tensor(proof.seen == 0), 0.15, 1.0)
    fading = dataclasses.replace(whole, logit_opacities=torch.logit(opacity))
    settings = dataclasses.replace(source.settings, background=proof.border())
    camera = source.cameras[3][1]
    with torch.no_grad():
        expected = render(fading, camera, settings=settings, backend="cpu").image.numpy()
        plain = render(whole, camera, settings=source.settings, backend="cpu").image.numpy()
    assert psnr(expected, plain) < LEAST_PSNR - 10, "the measure tells faded splats"
    assert psnr(shown.picture(camera), expected) > LEAST_PSNR
    shown.open_controls().tab.uncheck("#kept")
    assert psnr(shown.picture(camera), plain) > LEAST_PSNR


def test_held_out_photos_do_not_count(source):
    seen = seen_of(source)
    every = seen_of(dataclasses.replace(source, held_out=frozenset()))
    assert seen.max() == 2 and every.max() == 4
    assert (every >= seen).all() and (every > seen).any()


def test_counts_are_capped_and_one_byte_a_splat(tmp_path, source):
    many = dataclasses.replace(source, cameras=source.cameras[:1] * (MOST_COUNTED + 3))
    seen = seen_of(many)
    assert seen.dtype == np.uint8 and seen.max() == MOST_COUNTED
    plain, proven = tmp_path / "a.html", tmp_path / "b.html"
    written(plain, source, None)
    written(proven, source, Proof(seen_of(source)))
    assert b'class="seen"' not in plain.read_bytes().split(b'id="facts"')[1].split(b"<script>")[0]
    more = proven.stat().st_size - plain.stat().st_size
    assert 0 < more < len(gzip.compress(seen_of(source).tobytes())) * 4 / 3 + 1500
    assert len(page.read(proven).gaussians) == len(source.scene.gaussians)


def test_a_page_without_counts_has_no_switch(visit, tmp_path, source):
    shown = visit().open(written(tmp_path / "a.html", source, None)).ready()
    assert not shown.tab.is_visible("#seen")
    assert "photos_seen" not in shown.evaluate("document.getElementById('splat.vert').textContent")


def test_counts_are_rounded_down_to_powers_of_two():
    count = np.array([0, 1, 2, 3, 4, 7, 8, 63, 64, 127, 128, 255, 256, 10**6], np.int32)
    assert rounded_counts(count).tolist() == [0, 1, 2, 2, 4, 4, 8, 32, 64, 64, 128, 128, 128, 128]


def test_counts_have_to_fit_the_scene(tmp_path, source):
    with pytest.raises(ArgumentError, match="counts 3 splats"):
        written(tmp_path / "a.html", source, Proof(np.zeros(3, np.uint8)))
    with pytest.raises(ArgumentError, match="no training cameras"):
        seen_of(dataclasses.replace(source, cameras=source.cameras[3:]))


def test_photos_are_spread_evenly_and_a_third_is_held_out(source):
    names = [(f"{i:03d}", source.cameras[0][1]) for i in range(48)]
    many = dataclasses.replace(
        source, cameras=tuple(names), held_out=frozenset(f"{i:03d}" for i in range(0, 48, 8))
    )
    chosen = chosen_views(many, 12)
    assert len(chosen) == len(set(chosen)) == 12 and chosen == sorted(chosen)
    assert sum(i % 8 == 0 for i in chosen) == 4
    gaps = np.diff([-2, *[i for i in chosen if i % 8], 50])
    assert gaps.max() <= 10
    assert chosen_views(many, 100) == list(range(48))
    assert chosen_views(source, 2) == [1, 3]
