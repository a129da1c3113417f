"""Command line, report, doctor and studio say the same about a run, whatever is wrong with it."""

import html
import shutil

import pytest

from gsplat_edu.cli.main import main
from gsplat_edu.data.procedural import procedural_capture
from gsplat_edu.data.writers import write_colmap
from gsplat_edu.evaluate.report import Report, write_report
from gsplat_edu.evaluate.verdict import RANKED, verdict
from gsplat_edu.runs.folder import RunFolder
from gsplat_edu.studio.library import Library
from gsplat_edu.studio.listing import summary
from gsplat_edu.survey.order import CAUSES

SHORT = ("--iterations", "40", "--backend", "cpu", "--set", "densify_start=5", "--set", "densify_every=10")


@pytest.fixture(scope="module")
def library(tmp_path_factory):
    """A library with one short run of 16 photos, beside which lie 4 that have no pose."""
    made = Library(tmp_path_factory.mktemp("studio"))
    capture = made.root / "captures" / "egg"
    write_colmap(capture, *procedural_capture(48, 16))
    photo = sorted((capture / "images").iterdir())[0]
    for number in range(4):
        shutil.copy(photo, photo.with_name(f"unplaced_{number}{photo.suffix}"))
    return made


@pytest.fixture(scope="module")
def run(library):
    folder = RunFolder(library.root / "runs" / "egg")
    assert main(["train", str(library.root / "captures" / "egg"), "--out", str(folder.path), *SHORT]) == 0
    return folder


def last_line(capsys):
    return capsys.readouterr().out.strip().splitlines()[-1]


def said_of(library, folder, capsys):
    """Return what studio, doctor and report say about a run, and its figures in the studio."""
    listed = summary(library, "runs", folder.path)["verdict"]
    capsys.readouterr()
    assert main(["doctor", str(folder.path), "--backend", "cpu"]) == 0
    (row,) = [line for line in capsys.readouterr().out.splitlines() if line.startswith("verdict ")]
    text = html.unescape(folder.report.read_text())
    assert listed["details"] in text
    (shown,) = [line for line in text.splitlines() if line.startswith('<p class="verdict')]
    assert f"verdict {listed['grade'].lower()}" in shown
    return (
        listed["sentence"],
        row.removeprefix("verdict").strip(),
        shown.split(">", 1)[1].removesuffix("</p>"),
    )


def test_a_training_ends_with_the_verdict_that_all_others_show(library, tmp_path, capsys):
    folder = RunFolder(library.root / "runs" / "told")
    assert main(["train", str(library.root / "captures" / "egg"), "--out", str(folder.path), *SHORT]) == 0
    told = last_line(capsys)
    assert main(["eval", str(folder.path), "--backend", "cpu"]) == 0
    assert {told, last_line(capsys)} == set(said_of(library, folder, capsys))
    assert "4 of 20 photos could not be placed" in told and " dB" not in told


MEANS = {
    "test": {"psnr": 20.0, "num_images": 4},
    "train": {"psnr": 24.5, "psnr_fitted": 24.6, "num_images": 44},
}
MOVED = {"transients": {"photos": [{"name": str(i), "share": 0.1} for i in range(20)]}}


@pytest.mark.parametrize(
    ("metrics", "photos", "judged", "says"),
    [
        ({}, {"unposed": 20}, ("Fair", "no pose"), "20 of 68 photos could not be placed"),
        (MOVED, {}, ("Fair", "moving subject"), "things moved in 45 % of the training photos"),
        (
            {"train": {"psnr": 21.0, "num_images": 44}},
            {},
            ("Fair", "poor fit"),
            "poses may be wrong. Train again with",
        ),
        ({"blurred": ["b.jpg"] * 6}, {}, ("Fair", "blurred"), "6 photos are blurred. Leave out or retake"),
        (
            {
                "train": {"psnr": 24.5, "psnr_fitted": 32.0, "num_images": 44},
                "test": {"psnr": 20.0, "psnr_fitted": 25.0, "num_images": 4},
            },
            {},
            ("Fair", "exposure"),
            "the photos differ in brightness",
        ),
        (
            {"test": {"psnr": 18.7, "num_images": 2}, "train": {"psnr": 33.0, "num_images": 12}},
            {"gap": ["left.jpg", "right.jpg"]},
            ("Fair", "few photos"),
            "Fair: new views are soft, because there are only 14 photos. "
            "Take more photos between the places of left.jpg and right.jpg.",
        ),
        ({}, {"gap": ["a", "b"], "hole": True}, ("Fair", "hole"), "no photo was taken between a and b"),
        ({"usual": {"gaussians": 9000}}, {}, ("Fair", "few splats"), "only 2,000 of the usual 9,000 splats"),
        ({"train": {"psnr": 33.0, "num_images": 44}}, {}, ("Fair", "overfitted"), "has learned its photos"),
        ({"usual": {"iterations": 3000}}, {}, ("Fair", "short training"), "only 40 of 3,000 iterations"),
        ({"iterations": 3, "full_length": 40}, {}, ("Poor", "short training"), "only 3 of 40 iterations"),
        ({}, {}, ("Fair", ""), "Compare worst.jpg with its render."),
        (
            {"test": {"psnr": 14.0, "num_images": 4}},
            {},
            ("Poor", "overfitted"),
            "Poor: new views are wrong in places",
        ),
        (
            {"test": {"psnr": 27.0, "num_images": 4}},
            {},
            ("Good", ""),
            "Good: new views look like the photos.",
        ),
        ({"test": {"psnr": 31.0}, "train": {"psnr": 40.0}}, {}, ("Good", ""), "Good: new views look like"),
        (
            {"test": {"psnr": 27.0, "num_images": 4}},
            {"unposed": 9},
            ("Good", "no pose"),
            "but 9 of 57 photos",
        ),
        ({"test": {"psnr": None, "num_images": 0}}, {}, ("Unknown", ""), "no photo was held out"),
        (
            {"test": {}, "train": {}, "not_scored": {"test": 4, "train": 44}},
            {},
            ("Unknown", ""),
            "Score the run.",
        ),
    ],
)
def test_each_cause_is_told_alike(library, run, tmp_path, capsys, metrics, photos, judged, says):
    folder = RunFolder(library.root / "runs" / tmp_path.name)
    shutil.copytree(run.path, folder.path)
    config = run.read_config() | {"photos": photos}
    config["train"]["max_gaussians"] = 2000
    views = [{"name": "worst.jpg", "psnr": 12.5}, {"name": "other.jpg", "psnr": 21.0}]
    written = {"iterations": 40, "test_views": views, **MEANS, **metrics}
    folder.write_config(config)
    folder.write_metrics(written)
    write_report(folder.report, Report("run", written, config=config))
    found = verdict(written, config)
    assert (found.grade, found.cause) == judged
    assert says in str(found) and " dB" not in str(found)
    assert set(said_of(library, folder, capsys)) == {str(found)}


def test_the_doctor_ranks_the_causes_of_a_run_as_the_verdict_does():
    assert [name for name in CAUSES if name in RANKED] == list(RANKED) and RANKED[-1] == "short training"


def test_the_cause_comes_before_a_longer_training(library, run, tmp_path, capsys):
    folder = RunFolder(library.root / "runs" / tmp_path.name)
    shutil.copytree(run.path, folder.path)
    means = {"test": {"psnr": 18.7, "num_images": 2}, "train": {"psnr": 33.0, "num_images": 12}}
    folder.write_metrics({"iterations": 40, "usual": {"iterations": 3000}, **means})
    folder.write_config(run.read_config() | {"photos": {"unposed": 6}})
    assert main(["doctor", str(folder.path), "--backend", "cpu"]) == 0
    advice = capsys.readouterr().out.split("what to do:")[1]
    assert "not placed" in advice.splitlines()[1] and "longer" not in advice
