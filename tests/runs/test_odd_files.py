"""If a file of a run has a value of a wrong type, every command that reads it prints one line that names the field."""

import json

import pytest
import torch

from gsplat_edu.base.errors import CheckpointError
from gsplat_edu.cli.main import main
from gsplat_edu.data.procedural import procedural_capture
from gsplat_edu.data.writers import write_transforms
from gsplat_edu.runs.folder import RunFolder

ODD = ["text", -1.5, True, [], [1], {}, {"psnr": "x"}, 10**400, "\ud800\x1b"]
"""Values of types that are wrong for most fields."""

FIELDS = [
    "config.json:version",
    "config.json:backend",
    "config.json:origin",
    "config.json:train",
    "config.json:data",
    "config.json:render",
    "config.json:train.iterations",
    "config.json:train.strategy",
    "config.json:render.background",
    "config.json:render.sh_degree",
    "config.json:data.path",
    "config.json:data.resolution",
    "config.json:digests",
    "config.json:photos",
    "config.json:photos.unposed",
    "metrics.json:iterations",
    "metrics.json:seconds",
    "metrics.json:num_gaussians",
    "metrics.json:test",
    "metrics.json:test.psnr",
    "metrics.json:test.ssim",
    "metrics.json:test.num_images",
    "metrics.json:exports",
    "metrics.json:usual",
    "metrics.json:usual.gaussians",
    "metrics.json:blurred",
    "log.jsonl:iteration",
    "log.jsonl:loss",
    "log.jsonl:psnr",
    "log.jsonl:num_gaussians",
    "cameras.json:width",
    "cameras.json:position",
    "cameras.json:rotation",
    "cameras.json:fx",
    "cameras.json:img_name",
]


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A run of two iterations, shared by all tests of this file."""
    folder = tmp_path_factory.mktemp("odd")
    write_transforms(folder / "data", *procedural_capture(16, 9, splats=40))
    torch.set_num_threads(1)
    words = ["--iterations", "2", "--strategy", "none", "--backend", "cpu"]
    assert main(["train", str(folder / "data"), "--out", str(folder / "run"), *words]) == 0
    return folder


def changed(text: str, name: str, field: str, value: object) -> str:
    contents = json.loads(text.splitlines()[0] if name == "log.jsonl" else text) if text else {"iteration": 2}
    target = contents[0] if name == "cameras.json" else contents
    section, _, key = field.rpartition(".")
    (target.setdefault(section, {}) if section else target)[key] = value
    return json.dumps(contents) + "\n"


@pytest.mark.parametrize("field", FIELDS)
def test_a_field_of_the_wrong_type_prints_at_most_one_line(run, capsys, field):
    """Commands either succeed or print one line, and never send an escape code."""
    name, _, key = field.partition(":")
    path = run / "run" / name
    before = path.read_bytes() if path.exists() else None
    files = {p: p.read_bytes() for p in (run / "run").glob("*.*")}
    readers = (
        (["info"], ["eval", "--backend", "cpu"])
        if name != "cameras.json"
        else (["render", "--dataset", "--size", "8"],)
    )
    try:
        for value in ODD:
            path.write_text(changed((before or b"").decode(), name, key, value))
            for command, *options in readers:
                if command == "eval" and value not in ("text", True):
                    continue  # reads the same files as info, but takes longer
                assert main([command, str(run / "run"), *options]) in (0, 2)
                said = capsys.readouterr().err
                assert said.count("\n") <= 1 and "\x1b" not in said, (value, said)
    finally:
        for file, data in files.items():
            file.write_bytes(data)
        if before is None:
            path.unlink(missing_ok=True)


def test_the_message_names_the_field(run):
    folder = RunFolder(run / "run")
    before = folder.metrics.read_bytes()
    folder.metrics.write_text('{"test": {"psnr": "high"}}')
    with pytest.raises(
        CheckpointError,
        match=r"metrics\.json: test\.psnr: is .high., but has to be a number or null; fix or remove",
    ):
        folder.read_metrics()
    folder.metrics.write_text('{"iterations": ' + 100_000 * "[" + "}")
    with pytest.raises(CheckpointError, match=r"is not JSON \(nested too deeply\)"):
        folder.read_metrics()
    folder.metrics.write_bytes(before)
    log = folder.log_file.read_bytes() if folder.log_file.exists() else b""
    folder.log_file.write_text('{"iteration": 1}\n{"iteration": [2]}\n')
    with pytest.raises(
        CheckpointError, match=r"log\.jsonl: line 2: iteration: is \[2\], but has to be a whole number"
    ):
        folder.log()
    folder.log_file.write_bytes(log)
