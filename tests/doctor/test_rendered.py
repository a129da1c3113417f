"""For a rendered RGBA benchmark, the doctor names the background and accepts equal photos."""

import numpy as np
import pytest

from gsplat_edu.data.dataset import DataSettings, load_dataset
from gsplat_edu.data.procedural import procedural_capture
from gsplat_edu.data.reader import CaptureReader
from gsplat_edu.data.writers import write_blender, write_colmap
from gsplat_edu.doctor.before import examine
from gsplat_edu.scene.views import View
from gsplat_edu.survey.capture import prepare
from gsplat_edu.survey.finding import Severity

WHITE = (1.0, 1.0, 1.0)


@pytest.fixture
def cut_out():
    """Views whose black pixels are transparent; the last view has the photo of the first."""
    views, points, colors = procedural_capture(24, 6, splats=60)
    images = [view.image for view in views[:-1]] + [views[0].image]
    clear = [
        View(
            view.camera,
            image,
            alpha=np.where(image.max(axis=2) > 20, 255, 0).astype(np.uint8),
            name=view.name,
        )
        for view, image in zip(views, images, strict=True)
    ]
    return clear, points, colors


def test_the_chosen_and_the_usual_background_are_named(tmp_path, cut_out):
    views, points, colors = cut_out
    write_blender(tmp_path / "blender", views[:4], views[4:])
    write_colmap(tmp_path / "colmap", views, points, colors)

    def said(layout, color):
        notes = [str(note) for note in load_dataset(tmp_path / layout, DataSettings(background=color)).notes]
        return next(note for note in notes if "alpha channel" in note)

    black = said("blender", (0.0, 0.0, 0.0))
    assert black.startswith(
        "6 of 6 photos have an alpha channel: their background is black, which the scene learns"
    )
    assert "on white, as with --white-background" in black
    assert said("blender", WHITE).endswith(
        "their background is white, which the scene learns as if it were there"
    )
    kept = "trained over changing colours, and scored over black and white"
    assert said("colmap", None).endswith(kept)
    usual = said("blender", None)
    assert kept in usual and usual.endswith("on white, as with --white-background")
    facts = dict.fromkeys(value for _, value in examine(prepare(CaptureReader(tmp_path / "blender"))).facts)
    assert usual in facts


def test_equal_photos_are_only_a_note_for_rendered_captures(tmp_path, cut_out):
    views, points, colors = cut_out
    write_blender(tmp_path / "blender", views[:4], views[4:])
    write_colmap(tmp_path / "colmap", views, points, colors)
    found = examine(prepare(CaptureReader(tmp_path / "blender")))
    alike = [finding for finding in found.findings if finding.name in ("duplicates", "same photo")]
    assert [finding.severity for finding in alike] == [Severity.NOTE]
    assert not any("remove one photo" in advice for advice in found.advice)
    assert any(
        "remove one photo" in advice for advice in examine(prepare(CaptureReader(tmp_path / "colmap"))).advice
    )
