"""The table of docs/RECIPE.md is generated from the settings' metadata and explains each setting."""

import dataclasses
from pathlib import Path

import build_recipe_table
from gsplat_edu.train.config import (
    MILESTONES,
    ONLY_FOR,
    SETTINGS,
    AdcConfig,
    FastConfig,
    McmcConfig,
    TrainConfig,
)

ROOT = Path(__file__).parents[2]
TEXT = (ROOT / "docs/RECIPE.md").read_text()


def test_the_table_is_current():
    assert build_recipe_table.with_table(TEXT) == TEXT, "run python tools/build_recipe_table.py"
    assert build_recipe_table.table() in TEXT


def test_a_changed_setting_makes_it_stale(monkeypatch):
    changed = [dataclasses.replace(SETTINGS[0], default=1), *SETTINGS[1:]]
    monkeypatch.setattr(build_recipe_table, "SETTINGS", changed)
    assert build_recipe_table.with_table(TEXT) != TEXT


def test_every_field_is_a_setting_with_a_meaning():
    """A field without metadata would have no option, no line in config.json and no row here."""
    for kind, strategy in (
        (TrainConfig, None),
        (AdcConfig, "adc"),
        (McmcConfig, "mcmc"),
        (FastConfig, "fast"),
    ):
        nested = {"adc", "mcmc", "fast", "plugged"} if strategy is None else set()
        names = {field.name for field in dataclasses.fields(kind)} - nested
        found = {setting.attribute for setting in SETTINGS if setting.strategy == strategy}
        assert found == names and all(f"    {name}: " in kind.__doc__ for name in names)
    assert all(setting.help.endswith(".") for setting in SETTINGS)
    assert len({setting.name for setting in SETTINGS}) == len(SETTINGS)


def test_milestones_and_settings_of_one_strategy():
    """Milestones are the settings given in iterations out of 30,000. Intervals are not milestones."""
    assert set(MILESTONES) == {
        "surface_start",
        *("means_rate_iterations", "sh_every", "densify_start", "densify_stop", "reset_every", "mcmc_stop"),
        *("fast_full_size", "fast_stop", "fast_decay_start"),
    }
    assert "mcmc_growth" in ONLY_FOR["mcmc"] and "densify_stop" in ONLY_FOR["adc"]
    assert not {"densify_start", "min_opacity"} & {name for names in ONLY_FOR.values() for name in names}
