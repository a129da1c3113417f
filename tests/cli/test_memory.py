"""Running out of memory, wherever it happens, prints one line that says what to do."""

import os
import re
import struct
import subprocess
import sys
import zlib
from pathlib import Path

import numpy as np
import pytest
import torch

from gsplat_edu.base import headroom
from gsplat_edu.base.errors import NotEnoughMemoryError
from gsplat_edu.base.headroom import available_memory, require_memory
from gsplat_edu.cli.running import run_command
from gsplat_edu.data.procedural import procedural_capture
from gsplat_edu.data.writers import write_transforms
from gsplat_edu.io.ply import save_ply
from gsplat_edu.photos.decoding import decode
from gsplat_edu.scene.gaussians import Gaussians

CHILD = """
import resource, sys
import torch
from gsplat_edu.cli.main import main
import gsplat_edu.cli.render, gsplat_edu.cli.doctor, gsplat_edu.cli.info
torch.set_num_threads(1)
pages = int(open("/proc/self/statm").read().split()[0])
limit = pages * resource.getpagesize() + 640 * 2**20
resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
photo, scene, capture, out = sys.argv[1:]
from gsplat_edu.photos.decoding import decode
from gsplat_edu.cli.running import run_command
print(run_command("photo", lambda: decode(__import__("pathlib").Path(photo)), False))
print(main(["render", scene, "--size", "200000", "--frames", "1", "--backend", "cpu", "--out", out]))
print(main(["render", scene, "--size", "1024", "--frames", "1", "--backend", "cpu", "--out", out]))
"""


def png(path: Path, W: int, H: int) -> Path:
    """Write a black PNG of one bit a pixel."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    row = bytes(1 + (W + 7) // 8)
    squeeze = zlib.compressobj(1)
    data = b"".join(squeeze.compress(row * 1000) for _ in range(-(-H // 1000))) + squeeze.flush()
    header = struct.pack(">IIBBBBB", W, H, 1, 0, 0, 0, 0)
    path.write_bytes(
        b"\x89PNG\r\n\x1a\n"
        + chunk(b"IHDR", header)
        + chunk(b"IDAT", data)
        + chunk(b"IEND", b"")
        # padding to the size that a compressed photo has
        + bytes(W * H // 200)
    )
    return path


def screens(path: Path, count: int) -> Path:
    """Write splats that each cover every tile of an image."""
    gaussians = Gaussians(
        means=torch.rand(count, 3),
        quats=torch.tensor([[1.0, 0.0, 0.0, 0.0]]).repeat(count, 1),
        log_scales=torch.full((count, 3), 3.0),
        sh0=torch.zeros(count, 1, 3),
        sh_rest=torch.zeros(count, 0, 3),
        logit_opacities=torch.zeros(count),
    )
    save_ply(path, gaussians)
    return path


@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="needs /proc/self/statm")
@pytest.mark.own_process
def test_a_process_with_little_memory_left(tmp_path):
    """A 20,000 x 15,000 PNG, an image 200,000 px wide and screen-filling splats, with 640 MiB left.

    20,000 splats in 64 x 64 tiles are 82 million pairs of at least 8 bytes. Buffers grow by a quarter, which makes
    that more than 640 MiB. The photo takes 2.8 GiB, and the image 600 GiB.
    """
    photo, scene = png(tmp_path / "large.png", 20_000, 15_000), screens(tmp_path / "screens.ply", 20_000)
    out = tmp_path / "out"
    words = [sys.executable, "-c", CHILD, photo, scene, tmp_path, out]
    ended = subprocess.run(words, capture_output=True, text=True, timeout=600, check=False)
    assert ended.returncode == 0, ended.stderr
    # render also prints its camera path
    codes = [line for line in ended.stdout.splitlines() if line.isdigit()]
    assert codes == ["2", "2", "2"], ended.stderr
    first, second, third = ended.stderr.splitlines()
    assert re.fullmatch(
        r"photo: .*large\.png: 20000x15000 px: needs 2\.79 GiB of memory, but only 0\.\d\d GiB are free; "
        r"close other programs, or make the photo smaller",
        first,
    )
    assert re.fullmatch(
        r"gsplat-edu render: an image of 200000x200000 px: needs [\d,.]+ GiB of memory, but only 0\.\d\d GiB are free; "
        r"close other programs, or render at a smaller --size",
        second,
    )
    assert re.fullmatch(
        r"gsplat-edu render: ran out of memory \(the renderer needs a block of 0\.\d\d GiB, but 0\.\d\d GiB are "
        r"free\); "
        r"close other programs, or reduce --size",
        third,
    )
    assert not out.exists() or not list(out.iterdir()), "no partial output is left"


def failing(allocate):
    def command():
        allocate()

    return command


HUGE = 2**62


@pytest.mark.parametrize(
    "allocate",
    [
        lambda: np.empty(HUGE // 8, np.uint8),
        lambda: torch.empty(HUGE // 16, dtype=torch.uint8),
        lambda: bytearray(HUGE),
        lambda: __import__("cv2").resize(np.zeros((1, 1), np.float64), (2**30, 2**30)),
        lambda: (_ for _ in ()).throw(OSError(12, os.strerror(12))),
        lambda: (_ for _ in ()).throw(RuntimeError("can't start new thread")),
    ],
    ids=["numpy", "torch", "python", "opencv", "system", "threads"],
)
def test_running_out_of_memory_in_any_library_is_one_line(capsys, allocate):
    assert run_command("gsplat-edu train", failing(allocate), False) == 2
    said = capsys.readouterr().err
    assert said.startswith("gsplat-edu train: ran out of memory (") and said.count("\n") == 1
    assert "--resolution" in said


def test_other_errors_are_not_reported_as_out_of_memory():
    with pytest.raises(RuntimeError, match="shapes differ"):
        run_command("x", failing(lambda: (_ for _ in ()).throw(RuntimeError("shapes differ"))), False)


def test_free_memory_is_the_minimum_over_the_machine_and_its_cgroups(tmp_path, monkeypatch):
    """Reads a container's limit from the files of cgroups v1 and v2, and counts its file cache as free."""
    monkeypatch.setattr(headroom, "PROC", tmp_path / "proc")
    monkeypatch.setattr(headroom, "CGROUPS", tmp_path / "groups")
    assert available_memory() is None, "this system does not report its free memory"
    (tmp_path / "proc" / "self").mkdir(parents=True)
    (tmp_path / "proc" / "meminfo").write_text("MemTotal: 9000 kB\nMemAvailable:    4000 kB\n")
    assert available_memory() == 4000 * 1024
    (tmp_path / "proc" / "self" / "cgroup").write_text("0::/a/b\n")
    for place, most in (("a/b", "max"), ("a", "3000000")):
        folder = tmp_path / "groups" / place
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "memory.max").write_text(f"{most}\n")
        (folder / "memory.current").write_text("2000000\n")
        (folder / "memory.stat").write_text("anon 5\ninactive_file 300\nactive_file 40\n")
    assert available_memory() == 3_000_000 - 2_000_000 + 340
    (tmp_path / "proc" / "self" / "cgroup").write_text("4:cpu,memory:/c\n")
    folder = tmp_path / "groups" / "memory" / "c"
    folder.mkdir(parents=True)
    (folder / "memory.limit_in_bytes").write_text("1000\n")
    (folder / "memory.usage_in_bytes").write_text("990\n")
    (folder / "memory.stat").write_text("total_inactive_file 7\n")
    assert available_memory() == 17
    with pytest.raises(
        NotEnoughMemoryError, match=r"the work: needs 0\.12 GiB of memory, but only 0\.00 GiB are free"
    ):
        require_memory("the work", 2**27, "rest")
    require_memory("little work", 2**20, "nothing to say")


def test_small_photos_are_decoded_without_checking_free_memory(tmp_path, monkeypatch):
    write_transforms(tmp_path, *procedural_capture(24, 3, splats=20))
    monkeypatch.setattr(headroom, "available_memory", lambda: 0)
    assert decode(next((tmp_path / "images").iterdir()))[0].shape == (18, 24, 3)
