"""Every reader handles files whose contents do not match their names."""

import tracemalloc

import pytest
import torch

from gsplat_edu.base.errors import ArgumentError, SceneFormatError
from gsplat_edu.io.formats import format_of, read_scene, write_scene
from scene_files import IN_A_PROCESS, random_scene, refused, small_file, suffixes

SLACK = 8 << 20
"""Bytes that a reader may use for any file, however small: imports, buffers and the minimum allowance."""

TIMES = 100
"""A reader may allocate this multiple of the file's size: 64 times for compressed contents, and a float32 copy."""

every_format = pytest.mark.parametrize("suffix", suffixes())


@every_format
def test_a_file_cut_anywhere_is_refused(tmp_path, suffix):
    path = small_file(tmp_path, suffix)
    data = path.read_bytes()
    # the format has no header, so a cut between two splats leaves a valid scene
    odd = 7 if suffix == ".splat" else 0
    for end in range(0, len(data), 1024 if suffix in IN_A_PROCESS else 64):
        at_row = suffix == ".csv" and data[:end].endswith(b"\n")  # a table of fewer rows, without a count
        if end + odd < len(data) and end + odd > 0 and not at_row:
            path.write_bytes(data[: end + odd])
            refused(path)


@every_format
def test_a_git_lfs_pointer_is_named_in_the_error(tmp_path, suffix):
    path = tmp_path / f"a{suffix}"
    path.write_text("version https://git-lfs.github.com/spec/v1\noid sha256:0123\nsize 123\n")
    assert "git lfs pull" in refused(path)


@every_format
def test_other_files_are_refused(tmp_path, suffix):
    path = tmp_path / f"a{suffix}"
    for content in (
        b"<!DOCTYPE html><html>not found</html>",
        b"\x89PNG\r\n\x1a\n" + bytes(99),
        b"\x00" * 33,
        b"x",
    ):
        path.write_bytes(content)
        refused(path)


@every_format
def test_files_of_other_formats_are_refused(tmp_path, suffix):
    path = tmp_path / f"a{suffix}"
    for other in suffixes():
        if other != suffix and {other, suffix} != {".ply", ".compressed.ply"}:
            content = small_file(tmp_path, other).read_bytes()
            path.write_bytes(content + b"\0" * (1 if suffix == ".splat" and len(content) % 32 == 0 else 0))
            refused(path)


@every_format
def test_a_missing_file_stays_an_oserror(tmp_path, suffix):
    with pytest.raises(FileNotFoundError):
        read_scene(tmp_path / f"gone{suffix}")


@pytest.mark.parametrize("suffix", [".ply", ".compressed.ply", ".splat", ".glb"])
def test_files_with_nan_or_infinity_are_refused(tmp_path, suffix):
    path = small_file(tmp_path, suffix)
    data = bytearray(path.read_bytes())
    before = {".splat": b"", ".glb": b"BIN\0"}.get(suffix, b"end_header\n")
    start = data.index(before) + len(before)
    for bits in (
        b"\x00\x00\xc0\x7f",
        b"\x01\x00\x80\x7f",
        b"\x00\x00\x80\xff",
    ):  # NaN, a signalling NaN, and -inf
        data[start : start + 4] = bits
        path.write_bytes(data)
        refused(path)


@every_format
def test_a_scene_that_is_not_finite_is_not_written(tmp_path, suffix):
    scene = random_scene(5)
    scene.gaussians.log_scales[3, 1] = torch.nan
    with pytest.raises(ArgumentError, match="log_scales"):
        write_scene(tmp_path / f"a{suffix}", scene)
    assert list(tmp_path.iterdir()) == []


def test_names_without_a_format_are_refused(tmp_path):
    for name in ("scene", "scene.obj", "scene.ply.gz", ".."):
        with pytest.raises(ArgumentError, match=r"known are \.compressed\.ply, \.ply"):
            format_of(tmp_path / name)
    assert format_of("A.Compressed.PLY").module == "gsplat_edu.io.compressed_ply"
    assert format_of("folder/meta.json").module == "gsplat_edu.io.sog.codec"


@pytest.mark.parametrize("suffix", [suffix for suffix in suffixes() if suffix not in IN_A_PROCESS])
def test_memory_stays_a_small_multiple_of_the_file(tmp_path, suffix):
    """Every count in the file, as text or as 32 bits, is raised to 2^31 - 1 in turn."""
    path = small_file(tmp_path, suffix)
    data, claims = path.read_bytes(), 0
    for count in (b"40", (40).to_bytes(4, "little")):
        most = b"2147483647" if count == b"40" else (2**31 - 1).to_bytes(4, "little")
        at = data.find(count)
        while at >= 0:
            claims += 1
            path.write_bytes(data[:at] + most + data[at + len(count) :])
            tracemalloc.start()
            try:
                read_scene(path)
            except SceneFormatError:
                pass
            finally:
                peak = tracemalloc.get_traced_memory()[1]
                tracemalloc.stop()
            assert peak < SLACK + TIMES * len(data)
            at = data.find(count, at + 1)
    assert claims or suffix == ".splat", "the file has to declare its number of splats"
