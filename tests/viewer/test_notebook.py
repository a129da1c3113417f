"""What a notebook shows: pictures, curves, the viewer's page in a frame, signatures and short lines."""

import html
import inspect
import io
import os
import pydoc
import re
import subprocess
import sys

import numpy as np
import pytest
import torch
from PIL import Image

import gsplat_edu
from gsplat_edu import Camera, Scene, load_backend, load_dataset, recipe, training
from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.data.procedural import procedural_capture
from gsplat_edu.data.writers import write_colmap
from gsplat_edu.scene.shutter import RollingShutter
from gsplat_edu.train.initialize import random_ball
from viewer.pages import RESTS
from waiting import until, until_in


@pytest.fixture
def ball():
    return random_ball(300, torch.Generator().manual_seed(0))


@pytest.fixture
def output(ball):
    return gsplat_edu.render(ball, Camera.looking_at((0, 0, -3), (0, 0, 0), 40, 40, 24, 32))


def pixels(data):
    return np.asarray(Image.open(io.BytesIO(data)))


def picture_in(text):
    import base64

    return pixels(base64.b64decode(re.search(r'src="data:image/png;base64,([^"]+)"', text)[1]))


def test_render_has_the_signature_and_the_text_of_the_function():
    from gsplat_edu.render.api import render

    assert inspect.signature(gsplat_edu.render) == inspect.signature(render)
    assert list(inspect.signature(gsplat_edu.render).parameters)[:2] == ["gaussians", "camera"]
    text = pydoc.render_doc(gsplat_edu.render, renderer=pydoc.plaintext)
    assert "background: (3,) background, as a tensor" in text and "render(gaussians: " in text


def test_help_knows_the_names_that_are_imported_on_first_use():
    text = pydoc.render_doc(gsplat_edu, renderer=pydoc.plaintext)
    for name in gsplat_edu.LAZY:
        assert re.search(rf"\b{name}\b", text), name
        assert "arguments" not in inspect.signature(getattr(gsplat_edu, name)).parameters, name


def test_a_render_is_shown_and_saved_as_its_image(output, tmp_path):
    shown = pixels(output._repr_png_())
    expected = np.floor(255 * output.image.double().clamp(0, 1).numpy() + 0.5)
    assert np.array_equal(shown, expected) and shown.any()
    output.save(tmp_path / "new" / "render.png")
    assert np.array_equal(pixels((tmp_path / "new" / "render.png").read_bytes()), expected)
    assert [path.name for path in (tmp_path / "new").iterdir()] == ["render.png"]
    with pytest.raises(ArgumentError, match=r"^path: is .*render.jpg, but has to end in .png$"):
        output.save(tmp_path / "render.jpg")


def test_a_render_with_a_bad_pixel_leaves_the_file_as_it_was(ball, output, tmp_path):
    output.save(tmp_path / "a.png")
    before = (tmp_path / "a.png").read_bytes()
    output.image[0, 0, 0] = float("nan")
    with pytest.raises(ArgumentError, match="image"):
        output.save(tmp_path / "a.png")
    assert (tmp_path / "a.png").read_bytes() == before and len(list(tmp_path.iterdir())) == 1


def test_without_a_screen_show_says_what_to_do(output, monkeypatch, capsys):
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    if sys.platform not in ("win32", "darwin"):
        output.show()
        assert 'output.save("render.png")' in capsys.readouterr().out


SHOWS = """
import torch, gsplat_edu
from gsplat_edu.train.initialize import random_ball
ball = random_ball(300, torch.Generator().manual_seed(0))
gsplat_edu.render(ball, gsplat_edu.Camera.looking_at((0, 0, -3), (0, 0, 0), 40, 40, 24, 32)).show()
"""


@pytest.mark.own_process
@pytest.mark.skipif(sys.platform in ("win32", "darwin"), reason="these have viewers of their own")
def test_show_opens_the_picture(output, tmp_path, monkeypatch):
    opener, opened = tmp_path / "xdg-open", tmp_path / "opened.png"
    opener.write_text(f'#!/bin/sh\ncp "$1" {tmp_path / "part"} && mv {tmp_path / "part"} {opened}\n')
    opener.chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}:{os.environ['PATH']}")
    monkeypatch.setenv("DISPLAY", ":99")
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    subprocess.run([sys.executable, "-c", SHOWS], check=True)
    until(opened.is_file)
    assert np.array_equal(pixels(opened.read_bytes()), pixels(output._repr_png_()))


def test_a_scene_is_a_small_picture_with_its_facts(ball):
    for shown in (ball, Scene(ball, up=(0.0, -1.0, 0.0)), ball.trainable()):
        text = shown._repr_html_()
        picture = picture_in(text)
        assert picture.shape == (256, 256, 3) and picture.std() > 5
        assert html.escape(repr(shown)) in text and "world units" in text


def test_a_scene_without_usable_gaussians_has_facts_only(ball):
    assert ball[:0]._repr_html_() == "<div><code>Gaussians(0, SH degree 0, float32 on cpu)</code></div>"
    broken = ball.map(lambda tensor: tensor.clone())
    broken.means[0, 0] = float("nan")
    assert picture_in(broken._repr_html_()).any()


def test_a_trainer_is_its_loss_curve_in_one_call_or_several(tmp_path):
    write_colmap(tmp_path, *procedural_capture(24, 9, splats=60))
    dataset = load_dataset(tmp_path)
    trainer = training(recipe(8, strategy="none"), dataset, load_backend())
    count = len(trainer.gaussians)
    assert "polyline" not in trainer._repr_html_()
    assert repr(trainer) == f"Trainer(iteration 0 of 8, {count} Gaussians)"
    losses = trainer.run(stop=lambda: trainer.iteration == 3).losses

    def interrupt(trainer, event):
        if trainer.iteration == 5:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        trainer.run(callbacks=[interrupt])
    losses += [0, 0, *trainer.run().losses]
    points = re.search(r'points="([^"]+)"', trainer._repr_html_())[1].split()
    assert len(points) == len(losses) == 8
    heights = [float(point.split(",")[1]) for point in points]
    order = np.argsort(losses[:3])
    assert heights[order[0]] >= heights[order[2]], "a larger loss is drawn higher"
    assert repr(trainer) == f"Trainer(iteration 8 of 8, {count} Gaussians, loss {losses[-1]:.4g})"
    assert len(repr(dataset).splitlines()) == 1
    assert repr(dataset).startswith("Dataset(COLMAP, ") and "7 training and 2 test views" in repr(dataset)
    assert repr(dataset.train[0]) == f"View({dataset.train[0].name!r}, 24x18 px, on disk)"


def test_every_value_is_one_short_line(ball, output):
    camera = Camera.looking_at((0, 0, -3), (0, 0, 0), 40, 40, 24, 32)
    assert repr(camera) == "Camera(32x24 px, pinhole, fx=40, fy=40, cx=16, cy=12, eye=(0, 0, -3))"
    rolling = camera.through(shutter=RollingShutter((0, 0.01, 0), (0, 0, 0)))
    assert "perspective read down" in repr(rolling)
    assert repr(output) == f"RenderOutput(32x24 px, {len(output.visible)} Gaussians, float32 on cpu)"
    scene = Scene(ball, unit="m")
    assert repr(scene) == "Scene(Gaussians(300, SH degree 0, float32 on cpu), unit='m')"


def test_the_page_of_a_scene_can_be_saved(ball, tmp_path):
    page = Scene(ball).view(height=300)
    page.save(tmp_path / "a" / "scene.html")
    assert (tmp_path / "a" / "scene.html").read_bytes() == page.content
    assert repr(page).startswith("ScenePage(") and "page.save(path)" in repr(page)
    with pytest.raises(ArgumentError, match="height"):
        ball.view(height=3)


def test_the_page_draws_in_a_notebooks_frame(browser, ball):
    tab = browser.new_page()
    tab.set_content(f"<h1>Notebook</h1>{ball.view()._repr_html_()}")
    (frame,) = (each for each in tab.frames if each.parent_frame)
    frame.wait_for_selector("#message", state="hidden")
    until_in(tab, frame, RESTS)
    assert frame.evaluate("viewer.facts.count") == len(ball)


@pytest.mark.parametrize("hidden", ["display: none", "width: 0", "height: 0; overflow: hidden"])
def test_a_page_whose_frame_is_hidden_at_first_draws_when_it_is_shown(browser, ball, hidden):
    """No input, and no picture before: that of a canvas without a size would be a single pixel."""
    tab = browser.new_page()
    tab.set_content(f'<div style="{hidden}">{ball.view()._repr_html_()}</div>')
    (frame,) = (each for each in tab.frames if each.parent_frame)
    until_in(tab, frame, "document.readyState === 'complete'")
    pixels_before = frame.evaluate("document.getElementById('canvas').width")
    tab.evaluate("document.querySelector('div').style = ''")
    until_in(tab, frame, RESTS)
    until_in(tab, frame, "viewer.canvas.width === innerWidth && viewer.canvas.height === innerHeight")
    frame.wait_for_selector("#message", state="hidden")
    shown = pixels(tab.locator("iframe").screenshot())
    middle = shown[shown.shape[0] // 4 : -shown.shape[0] // 4, shown.shape[1] // 4 : -shown.shape[1] // 4]
    assert middle.std() > 5 and pixels_before != 1
