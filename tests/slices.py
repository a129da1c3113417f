"""The slice of the long tests that one run takes.

A test marked `sliced(n)` has more cases than a change should wait for. Each case belongs to one of eight shards, and
the number of commits up to HEAD, modulo eight, chooses the shard that runs: over eight consecutive counts every case
runs. A test keeps at least n cases in every run, those of the next shards if its own has fewer. `sliced(n,
by="is_named")` keeps n for each value of that parameter, and tests marked `sliced(n, group="name")` share their n. With
`together=True`, the tests of a file that are marked for a group are one case, because they share a fixture. `sliced(0)`
runs in soaks and when a change touches it, and `sliced` without a number always: those tests choose their own inputs.

All cases run in the test files that a change touches (touched.py says what that is), and of a test that the command
line names with `::`. A case's shard depends on its own test only, and a change to that test's file runs all of it. So
no case waits longer than eight commits, as long as each commit is tested and SECONDS stays the same.

In a shallow clone and outside git, the count and the change are unknown. Then shard 0 runs, and the header says why.

    GSPLAT_EDU_SLICE   the count, instead of that of HEAD; the seeds of the fuzzers follow from it too
    GSPLAT_EDU_SHARD   0 to 7: this shard alone; none: only what the change touches
    GSPLAT_EDU_BASE    the commit with which the working tree is compared (touched.py)
    GSPLAT_EDU_SOAK    1: the soak's sizes and, without GSPLAT_EDU_SHARD, every case (`make soak`)
    GSPLAT_EDU_SPLIT   all: the shard of GSPLAT_EDU_SHARD takes an eighth of every test's cases, sliced or not

conftest.py imports the hooks from here. `python tests/slices.py` prints the shard of this commit.
"""

import os
import zlib
from collections import defaultdict
from collections.abc import Generator, Iterable, Mapping
from pathlib import Path

import pytest

import touched

SHARDS = 8
NAMES = [str(shard) for shard in range(SHARDS)]
ROOT = Path(__file__).parents[1]

SOAK = os.environ.get("GSPLAT_EDU_SOAK", "") not in ("", "0")
CHOSEN = os.environ.get("GSPLAT_EDU_SHARD", "")
if CHOSEN not in ("", "none", *NAMES):
    raise pytest.UsageError(f"GSPLAT_EDU_SHARD is {CHOSEN!r}; give a number from 0 to {SHARDS - 1}, or none")
EVERY_TEST = CHOSEN in NAMES and os.environ.get("GSPLAT_EDU_SPLIT", "") == "all"

HISTORY = touched.history(ROOT)
# Stored in the environment, so that the workers of pytest-xdist choose the same cases even if files change meanwhile.
COUNT = int(os.environ.setdefault("GSPLAT_EDU_SLICE", str(HISTORY.count)))
os.environ.setdefault("GSPLAT_EDU_TOUCHED", "\n".join(sorted(touched.tests_of(ROOT, HISTORY.changed))))
TOUCHED = frozenset(os.environ["GSPLAT_EDU_TOUCHED"].split("\n")) - {""}

SHARD = int(CHOSEN) if CHOSEN in NAMES else COUNT % SHARDS
SEED = COUNT * 100_000
"""The seed of a fuzzer's first damaged file. The seeds of two counts do not overlap."""

HOW_TO_REPEAT = (
    "name the test with :: to run it again; "
    f"GSPLAT_EDU_SLICE={COUNT} repeats the slice and its seeds on any commit"
)

SECONDS: Mapping[str, tuple[int, int]] = {
    "tests/golden/test_chapter_trajectory.py::test_the_first_iterations_give_the_numbers_of_the_chapter": (
        40,
        1,
    ),
    "tests/cli/test_train_3d.py::test_the_default_budget_trains_end_to_end": (51, 1),
    "tests/repo/test_site.py": (38, 1),
    "tests/engine/test_training.py::test_the_sphere_reaches_the_course_s_quality": (35, 1),
    "tests/sfm/test_panoramas.py": (37, 1),
    "tests/studio/test_page.py::test_from_dropped_photos_to_a_downloaded_scene": (26, 1),
    "tests/studio/test_page_intake.py::test_a_dropped_video_becomes_a_capture": (22, 1),
    "tests/repo/test_wheels.py": (22, 1),
    "tests/runs/test_processes.py::test_torchrun_trains_to_the_same_bytes_although_a_rank_is_killed": (16, 4),
    "tests/sfm/test_video.py::test_frames_become_a_capture": (14, 1),
    "tests/train/test_vignetting.py::test_dark_corners_are_corrected_and_held_out_quality_with_them": (14, 1),
    "tests/repo/test_notebooks.py::test_chapters_execute_on_a_reduced_budget": (14, 14),
    "tests/train/test_transients.py::test_found_masks_recover_most_of_the_quality_of_true_masks": (13, 1),
    "tests/train/test_poses.py::test_wrong_poses_are_corrected_and_held_out_quality_with_them": (12, 1),
    "tests/runs/test_pilot.py::test_a_lens_is_learned_if_it_is_wrong": (46, 2),
    "tests/runs/test_pilot.py::test_a_shutter_is_learned_if_photos_have_one": (24, 2),
    "tests/runs/test_pilot.py::test_poses_are_refined_if_they_are_wrong": (11, 2),
    "tests/sfm/test_training.py::test_one_command": (10, 2),
    "tests/studio/test_page_pictures.py::test_a_training_is_drawn_while_it_runs": (9, 1),
    "tests/sfm/test_reconstruct.py::test_an_interrupted_run_resumes_after_the_last_completed_stage": (9, 1),
    "tests/cli/test_view.py::test_the_browser_opens_only_on_a_terminal_with_a_screen": (7, 1),
    "tests/gpu/test_training.py::test_a_training_is_reproducible": (7, 1),
    "tests/train/test_exposure.py::test_exposures_are_recovered_and_held_out_quality_with_them": (7, 1),
    "tests/train/test_exposure_alpha.py::test_exposures_of_transparent_photos_are_recovered": (7, 1),
    "tests/sfm/test_wrong_poses.py": (7, 1),
    "tests/sfm/test_phone_photos.py::test_photos_of_a_phone_become_an_upright_capture_in_srgb": (6, 1),
    "tests/blocks/test_cluster.py::test_the_bytes_survive_a_killed_worker_and_a_killed_scheduler": (6, 1),
    "tests/compat/test_rasterization.py::test_finite_differences": (6, 2),
    "tests/sfm/test_lenses.py": (5, 1),
    "tests/clean/test_judge.py::test_the_same_bits_on_any_number_of_threads": (5, 2),
    "tests/runs/test_lod_refinement.py::test_refined_levels_match_the_photos_better": (5, 1),
    "tests/budget/test_plan.py::test_a_training_stays_below_its_memory_limit_as_the_system_counts_it": (5, 1),
    "tests/sfm/test_scale.py::test_gps_gives_scale_and_up_end_to_end": (5, 1),
    "tests/runs/test_processes.py::test_a_mistake_is_reported_once": (5, 5),
    "tests/train/test_trainer.py::test_two_runs_give_the_same_bits": (5, 2),
    "tests/native/test_robustness.py::test_memory_does_not_grow": (5, 1),
    "tests/cli/test_sky.py::test_a_killed_run_ends_with_the_same_bytes": (5, 1),
    "tests/blocks/test_runs.py::test_a_command_for_each_block_gives_the_bytes_of_one_command_for_all": (5, 1),
    "tests/gpu/test_training.py::test_checkpoints_resume_on_either_backend": (5, 2),
    "tests/sfm/test_reconstruct.py::test_focal_lengths_from_exif_separate_two_cameras": (4, 1),
    "tests/gpu/test_compile.py::test_every_kernel_compiles_with_few_spills": (4, 12),
    "tests/runs/test_transients.py::test_a_killed_and_resumed_run_writes_the_same_bytes": (4, 1),
}
"""Processor time of a case in seconds, and the number of cases, of the longest tests. A file that runs together
counts as a case. These tests are spread over the shards by this time; the shards of other tests follow from their
names.
"""

FIRST = (
    "tests/repo/test_site.py",
    "tests/repo/test_notebooks.py",
    "tests/studio/test_page.py",
    "tests/studio/test_server.py",
    "tests/viewer/test_edit_page.py",
    "tests/viewer/test_page_drawing.py",
    "tests/viewer/test_live_browser.py",
    "tests/sfm/test_panoramas.py",
    "tests/runs/test_training.py",
    "tests/runs/test_processes.py",
    "tests/repo/test_wheels.py",
    "tests/train/test_batches.py",
    "tests/gpu/test_training.py",
    "tests/blocks/test_cluster.py",
    "tests/blocks/test_runs.py",
    "tests/sfm/test_training.py",
    "tests/viewer/test_page_controls.py",
    "tests/viewer/test_edit_page.py",
    "tests/viewer/test_edit_by_hand.py",
    "tests/repo/test_scripts.py",
    "tests/gpu/test_compile.py",
    "tests/sfm/test_reconstruct.py",
    "tests/native/test_gradients.py",
    "tests/golden/test_chapter_trajectory.py",
    "tests/budget/test_plan.py",
    "tests/cli/test_train_3d.py",
    "tests/native/test_robustness.py",
    "tests/viewer/test_live.py",
    "tests/sfm/test_video.py",
    "tests/doctor/test_cameras.py",
    "tests/doctor/test_appearance.py",
    "tests/cli/test_doctor.py",
    "tests/gpu/test_render.py",
    "tests/runs/test_extension.py",
    "tests/cli/test_view.py",
)
"""The slowest files. A file runs in one process, so slow files start first, while others are left for the other
processes."""


def count(name: str, sliced: int, soak: int) -> int:
    """Return how many damaged files a fuzzer reads.

    Args:
        name: The environment's variable that overrides the number.
        sliced: The number in `make test`.
        soak: The number in all of `make soak`. One shard reads an eighth.
    """
    whole = soak if CHOSEN not in NAMES else soak // SHARDS
    return int(os.environ.get(name, whole if SOAK else sliced))


def balanced(seconds: Mapping[str, tuple[float, int]]) -> dict[str, int]:
    """Choose the shard of the first case of each test so that the shards take nearly equal times.

    Args:
        seconds: By test, the processor time of a case and the number of cases.
    """
    loads, starts = [0.0] * SHARDS, {}
    for name, (cost, cases) in sorted(seconds.items(), key=lambda entry: (-entry[1][0], entry[0])):
        windows = [[(start + i) % SHARDS for i in range(cases)] for start in range(SHARDS)]
        window = min(windows, key=lambda window: sum(loads[shard] for shard in window))
        starts[name] = window[0]
        for shard in window:
            loads[shard] += cost
    return starts


STARTS = balanced(SECONDS)


def numbered(items: Iterable[pytest.Item]) -> dict[pytest.Item, int]:
    """Return the shard of each test that has one. The cases of a test take consecutive shards, from that of the first
    case."""
    shards, sizes, together = {}, defaultdict(int), {}
    for item in items:
        marker = item.get_closest_marker("sliced")
        if marker is None and not EVERY_TEST:
            continue
        name = item.nodeid.partition("[")[0]
        if marker is not None and marker.kwargs.get("together"):
            name = item.nodeid.partition("::")[0]
            shards[item] = together.setdefault(name, STARTS.get(name, zlib.crc32(name.encode()) % SHARDS))
            continue
        start = STARTS.get(name, zlib.crc32(name.encode()) % SHARDS)
        shards[item] = (start + sizes[name]) % SHARDS
        sizes[name] += 1
    return shards


def split(
    items: list[pytest.Item], shards: Mapping[pytest.Item, int], shard: int | None, soak: bool = False
) -> tuple[list[pytest.Item], list[pytest.Item]]:
    """Split the tests into those to run and the cases that this run leaves out.

    Args:
        items: The collected tests.
        shards: The shard of each test that has one, from `numbered`.
        shard: The shard to run; None: no sliced case.
        soak: Whether a shard holds the cases of `sliced(0)`, and no case of other shards fills it up.

    Returns:
        The tests to run, in their original order, and the others.
    """
    groups: dict[str, dict[str, list[pytest.Item]]] = {}
    sizes: dict[str, int] = {}
    for item in items:
        marker = item.get_closest_marker("sliced")
        if item not in shards or (marker and not marker.args):
            continue
        words = marker.kwargs if marker else {}
        kind = item.callspec.params[words["by"]] if "by" in words else ""
        name = f"{words.get('group', item.nodeid.partition('[')[0])} {kind}"
        case = item.nodeid.partition("::")[0] if words.get("together") else item.nodeid
        groups.setdefault(name, {}).setdefault(case, []).append(item)
        sizes[name] = 0 if soak or not marker else marker.args[0]
    left_out: set[pytest.Item] = set()
    for name, cases in groups.items():
        if shard is None or (sizes[name] == 0 and not soak):
            left_out.update(*cases.values())
            continue
        # Cases by the number of commits until their turn; sorting keeps the order of equal ones.
        waits = [((shards[tests[0]] - shard) % SHARDS, tests) for tests in cases.values()]
        for i, (wait, tests) in enumerate(sorted(waits, key=lambda entry: entry[0])):
            if wait > 0 and i >= sizes[name]:
                left_out.update(tests)
    return [item for item in items if item not in left_out], [item for item in items if item in left_out]


def pytest_report_header() -> str:
    """Report which slice of the long tests runs."""
    repeat = f"GSPLAT_EDU_SLICE={COUNT}"
    if SOAK:
        return f"sliced tests: {f'shard {SHARD}' if CHOSEN in NAMES else 'every case'} of the soak, {repeat}"
    shard = "no shard" if CHOSEN == "none" else f"shard {SHARD} of 0 to {SHARDS - 1}"
    missing = f"; {HISTORY.missing}" if HISTORY.missing else ""
    return (
        f"sliced tests: {shard}, {repeat}; all cases of {len(TOUCHED)} files that the change touches{missing}"
    )


def wanted(config: pytest.Config, item: pytest.Item) -> bool:
    """Return whether the change touches a test or the command line names it."""
    path, _, name = item.nodeid.partition("::")
    if path in TOUCHED or f"[{name.partition('[')[2]}" in TOUCHED:
        return True
    for argument in config.args:
        file, found, asked = argument.partition("::")
        there = os.path.relpath(config.invocation_params.dir / file, config.rootpath)
        if found and there == path and (name == asked or name.startswith((f"{asked}[", f"{asked}::"))):
            return True
    return False


# assigns shards before -k and -m select tests, and leaves cases out afterwards
@pytest.hookimpl(wrapper=True, tryfirst=True)
def pytest_collection_modifyitems(
    config: pytest.Config, items: list[pytest.Item]
) -> Generator[None, object, object]:
    """Leave out the cases outside this slice, and put the slowest files first."""
    shards = numbered(items)
    result = yield
    if not SOAK:
        shards = {item: shard for item, shard in shards.items() if not wanted(config, item)}
    left_out = []
    if not (SOAK and CHOSEN == ""):
        items[:], left_out = split(items, shards, None if CHOSEN == "none" else SHARD, SOAK or EVERY_TEST)
    if left_out:
        config.hook.pytest_deselected(items=left_out)
    ranks = {name: i for i, name in enumerate(FIRST)}
    items.sort(key=lambda item: ranks.get(item.nodeid.partition("::")[0], len(FIRST)))
    return result


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(
    item: pytest.Item,
) -> Generator[None, pytest.TestReport, pytest.TestReport]:
    """Add instructions for repeating the slice to the report of a failed sliced test."""
    report = yield
    if report.failed and item.get_closest_marker("sliced"):
        report.sections.append(("slice", HOW_TO_REPEAT))
    return report


if __name__ == "__main__":
    print(SHARD)
