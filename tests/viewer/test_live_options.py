"""Options of the live view: each mistake gives a one-line error, and nothing is written."""

import socket

import pytest

from gsplat_edu.cli.main import main
from gsplat_edu.data.procedural import procedural_capture
from gsplat_edu.data.writers import write_colmap

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    folder = tmp_path_factory.mktemp("captures") / "egg"
    write_colmap(folder, *procedural_capture(24, 6, splats=60))
    return folder


@pytest.mark.usefixtures("as_shipped")
@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["--view-port", "8080"], "--view-port: has an effect only with --view"),
        (["--view-host", "0.0.0.0"], "--view-host: has an effect only with --view"),
        (
            ["--view", "--view-port", "TAKEN"],
            "--view-port: TAKEN is in use on 127.0.0.1; choose another port, or 0 for",
        ),
        (
            ["--view", "--view-port", "70000"],
            "--view-port: is 70000, but has to be a whole number from 0 to 65535",
        ),
        (
            ["--view", "--view-port", "0", "--view-host", "no such host"],
            "--view-host: 'no such host' is not an address",
        ),
        (
            ["--view", "--view-port", "0", "--view-host", "203.0.113.1"],
            "--view-host: cannot listen on 203.0.113.1",
        ),
    ],
)
def test_an_impossible_view_is_a_one_line_error_and_nothing_is_started(
    capture, tmp_path, capsys, words, says
):
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen(1)
        port = str(taken.getsockname()[1])
        words = [port if word == "TAKEN" else word for word in words]
        assert main(["train", str(capture), "--out", str(tmp_path / "run"), *words]) == 2
    said = capsys.readouterr().err
    assert said.startswith(f"gsplat-edu train: {says.replace('TAKEN', port)}") and said.count("\n") == 1
    assert not (tmp_path / "run").exists()
