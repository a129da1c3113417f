"""`gsplat-edu view CAPTURE`: a real server in its own process, which the doctor's work does not keep from ending."""

import json
import re
import signal
import subprocess
import sys
import urllib.request

import pytest

import gsplat_edu.cli.main as command_line
from viewer.captures import ring
from waiting import PATIENCE, until

COMMAND = [sys.executable, "-c", "import sys; from gsplat_edu.cli.main import main; sys.exit(main())", "view"]


@pytest.mark.own_process
def test_a_capture_is_served_with_its_photos_and_findings(tmp_path):
    views = ring(tmp_path / "egg", skipped=(4, 5, 6))
    words = [*COMMAND, str(tmp_path / "egg"), "--port", "0", "--no-open"]
    process = subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    try:
        lines = [process.stdout.readline() for _ in range(3)]
        assert lines[0] == f"{tmp_path / 'egg'}: {len(views)} photos, 200 points\n"
        assert "an arc of 120 degrees" in lines[1]
        url, token = re.fullmatch(
            r"(http://\S+/)(\?token=\S+)   \(press Ctrl-C to stop\)\n", lines[2]
        ).groups()
        visitor = urllib.request.build_opener(urllib.request.HTTPCookieProcessor())
        page = visitor.open(f"{url}{token}", timeout=PATIENCE)
        assert "script-src 'sha256-" in page.headers["Content-Security-Policy"]
        assert b"view_003.png" in page.read()
        photo = visitor.open(f"{url}thumbs/images/view_003.png?side=128", timeout=PATIENCE).read()
        assert photo[:2] == b"\xff\xd8"
        until(lambda: json.load(visitor.open(f"{url}findings", timeout=PATIENCE))["done"])
        process.send_signal(signal.SIGINT)
        rest, complaints = process.communicate(timeout=PATIENCE)
        assert (process.returncode, rest, complaints) == (0, "ended\n", "")
    finally:
        process.kill()


@pytest.mark.parametrize(
    "words", [["--budget", "5"], ["--edit"], ["--path", "a.json"], ["--surface", "a.glb"]]
)
def test_options_of_scenes_are_refused(tmp_path, capsys, words):
    ring(tmp_path / "egg", count=4)
    assert command_line.main(["view", str(tmp_path / "egg"), "--port", "0", "--no-open", *words]) == 2
    assert f"{words[0]}: {tmp_path / 'egg'} is a capture" in capsys.readouterr().err.replace("\n", " ")


def test_a_folder_without_poses_says_how_to_find_them(tmp_path, capsys):
    ring(tmp_path / "egg", count=4)
    assert command_line.main(["view", str(tmp_path / "egg" / "images"), "--port", "0", "--no-open"]) == 2
    assert "gsplat-edu sfm" in capsys.readouterr().err.replace("\n", " ")
