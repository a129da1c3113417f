"""The search for the best file within a budget, with the formats' own encoders."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.io import compressed_ply, spz
from gsplat_edu.io.sized import FEWEST, Choices, Ranked, Setting, best_file, fitted
from gsplat_edu.io.sog import codec as sog
from scene_files import random_scene

SCENE = random_scene(4000)
PRECISIONS = (spz.FULL, spz.Precision(1 / 32, (5, 4)))


def as_spz(part, setting):
    return spz.packed(replace(SCENE, gaussians=part.gaussians), PRECISIONS[setting.precision])


def as_sog(part, setting):
    return sog.bundled(replace(SCENE, gaussians=part.gaussians), 1024 + part.finer)


def as_compressed_ply(part, setting):
    return compressed_ply.packed(replace(SCENE, gaussians=part.gaussians))


@pytest.fixture(scope="module")
def ranked():
    importance = np.random.default_rng(0).permutation(4000).astype(np.float64)
    return Ranked(SCENE.gaussians, importance)


def test_a_part_has_the_most_important_splats_in_the_order_of_the_scene():
    gaussians = SCENE.gaussians[:6]
    ranked = Ranked(gaussians, np.array([1.0, 5.0, 1.0, 3.0, 5.0, 1.0]))
    for step, rows in ((1, [1]), (2, [1, 4]), (3, [1, 3, 4]), (4, [0, 1, 3, 4]), (6, [0, 1, 2, 3, 4, 5])):
        part = ranked.part(Setting(3), step)
        assert part.rows.tolist() == rows and part.with_harmonics == step
        torch.testing.assert_close(part.gaussians.sh_rest, gaussians.sh_rest[rows], rtol=0, atol=0)
    assert ranked.part(Setting(1), 6).gaussians.sh_degree == 1
    assert ranked.part(Setting(0, 0.5), 6).with_harmonics == 0


def test_splats_whose_harmonics_matter_least_lose_them_and_get_them_back():
    gaussians = SCENE.gaussians[:6]
    scales = torch.tensor([1.0, 6.0, 3.0, 4.0, 2.0, 5.0])[:, None, None]
    gaussians = replace(gaussians, sh_rest=scales * torch.ones(6, 15, 3))
    ranked = Ranked(gaussians, np.array([1.0, 1.0, 9.0, 1.0, 1.0, 1.0]))
    setting = Setting(2, share=0.5)

    def shiny(step):
        return torch.nonzero(ranked.part(setting, step).gaussians.sh_rest.any(dim=(1, 2)).int())[
            :, 0
        ].tolist()

    assert shiny(2) == [1] and shiny(6) == [1, 2, 5]
    assert shiny(7) == [1, 2, 3, 5] and shiny(ranked.steps(setting)) == [0, 1, 2, 3, 4, 5]
    assert ranked.steps(setting) == 9


@pytest.mark.parametrize("encode", [as_spz, as_sog, as_compressed_ply])
@pytest.mark.parametrize("most", [30_000, 50_000, 90_000])
def test_a_fitted_file_takes_at_least_99_per_cent_of_its_budget(ranked, encode, most):
    for degree in (1, 3):
        file = fitted(ranked, Setting(degree), encode, most)
        assert len(file.data) <= most
        assert len(file.data) >= 0.99 * most or len(file.part.rows) == 4000


def test_a_setting_whose_splats_all_fit_gets_harmonics_back(ranked):
    few, all_of_them = (
        len(as_spz(ranked.part(Setting(3, share), 4000), Setting(3, share))) for share in (0.25, 1.0)
    )
    most = (few + all_of_them) // 2
    file = fitted(ranked, Setting(3, 0.25), as_spz, most)
    assert len(file.part.rows) == 4000 and 1000 < file.part.with_harmonics < 4000
    assert 0.99 * most <= len(file.data) <= most


def test_a_palette_grows_when_everything_fits(ranked):
    least = len(as_sog(ranked.part(Setting(3), 4000), Setting(3)))
    file = fitted(ranked, Setting(3), as_sog, least + 20_000, Choices(finer=65_536))
    assert file.part.finer > 100 and 0.99 * (least + 20_000) <= len(file.data) <= least + 20_000


def test_the_best_score_wins_among_files_that_use_the_budget(ranked):
    most, judged = 60_000, {}

    def judge(data):
        judged[data] = -abs(data[12] - 2.0)  # byte 12 of an SPZ is its SH degree
        return judged[data]

    file = best_file(ranked, as_spz, judge, most, Choices(len(PRECISIONS), (1.0, 0.5)))
    assert file.setting.sh_degree == 2 and file.score == 0.0 and not file.whole
    assert 0.99 * most <= len(file.data) <= most
    assert max(judged.values()) == 0.0 and len(judged) > 4


def test_a_scene_that_fits_is_written_whole(ranked):
    whole = as_spz(ranked.part(Setting(3), 4000), Setting(3))

    def never(data):
        raise AssertionError("nothing to compare")

    file = best_file(ranked, as_spz, never, len(whole), Choices(2))
    assert file.whole and file.data == whole
    np.testing.assert_array_equal(file.part.rows, np.arange(4000))


def test_a_budget_below_the_smallest_file_is_refused_with_its_size(ranked):
    setting = Setting(0, precision=1)
    smallest = len(as_spz(ranked.part(setting, FEWEST), setting))
    with pytest.raises(ArgumentError, match=f"256 splats, has {smallest:,} bytes; allow at least as many"):
        best_file(ranked, as_spz, lambda data: 0.0, smallest - 1, Choices(2))
    assert len(best_file(ranked, as_spz, lambda data: 0.0, smallest, Choices(2)).data) == smallest
