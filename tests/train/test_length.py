"""The planned length is monotone in the photos, bounded, and the same on every machine."""

import pytest

from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.train.length import LONGEST, QUALITIES, planned_iterations, reasons, unit_iterations

PLANS = {
    1: (125, 370, 1_250),
    4: (500, 1_500, 5_000),
    9: (1_000, 3_000, 10_000),
    40: (1_000, 3_000, 10_000),
    85: (1_000, 3_000, 10_000),
    300: (3_500, 10_500, 35_000),
    1_500: (17_600, 52_000, 100_000),
    3_000: (35_000, 100_000, 100_000),
    100_000: (100_000, 100_000, 100_000),
}


@pytest.mark.parametrize("views", PLANS)
def test_the_planned_lengths_have_these_values(views):
    assert tuple(planned_iterations(name, views) for name in QUALITIES) == PLANS[views]


@pytest.mark.parametrize("measured", [True, False])
def test_more_photos_never_mean_fewer_iterations(measured):
    for quality in QUALITIES:
        lengths = [planned_iterations(quality, views, measured) for views in range(1, 5_000)]
        assert lengths == sorted(lengths) and lengths[0] >= 1 and lengths[-1] <= LONGEST


@pytest.mark.parametrize("views", [1, 9, 40, 300, 3_000])
def test_a_random_start_takes_longer_unless_the_photos_are_too_few(views):
    random, measured = (planned_iterations("standard", views, given) for given in (False, True))
    assert measured <= random <= 1.3 * measured
    assert ("random start points" in reasons(views, False)) and "random" not in reasons(views, True)


def test_a_length_is_a_multiple_of_the_batch():
    assert planned_iterations("draft", 60, batch=7) == 1_001


@pytest.mark.parametrize(("quality", "views", "named"), [("best", 9, "quality"), ("draft", 0, "views")])
def test_wrong_values_are_named(quality, views, named):
    with pytest.raises(ArgumentError, match=named):
        planned_iterations(quality, views)


def test_a_unit_is_a_third_of_standard_and_a_tenth_of_high():
    for views in (40, 300):
        draft, standard, high = (planned_iterations(name, views) for name in ("draft", "standard", "high"))
        assert standard / draft == pytest.approx(3, rel=0.05) and high / draft == pytest.approx(10, rel=0.05)
        assert draft == pytest.approx(unit_iterations(views), rel=0.05)
