"""Depth maps of every format have the same values; damaged, huge and foreign files end in one line."""

import importlib
import struct
import zipfile

import numpy as np
import pytest
from PIL import Image

from gsplat_edu.base.errors import DatasetError
from gsplat_edu.data.depth_files import read_depth
from gsplat_edu.data.depth_folder import depth_files, read_map

DEPTH = np.arange(1, 13, dtype=np.float32).reshape(3, 4) * 100


def save(path, values):
    """Write values in the format of the suffix."""
    name = path.name.lower()
    if name.endswith((".png", ".tif", ".tiff")):
        Image.fromarray(values if name.startswith("float") else values.astype(np.uint16)).save(path)
    elif name.endswith(".npy"):
        np.save(path, values[..., None])
    elif name.endswith(".npz"):
        np.savez_compressed(path, depth=values, other=np.zeros(3))
    elif name.endswith(".exr"):
        exr = pytest.importorskip("OpenEXR", reason="OpenEXR is not installed (extra depth)")
        exr.File({"compression": exr.ZIP_COMPRESSION, "type": exr.scanlineimage}, {"Z": values}).write(
            str(path)
        )
    else:
        h, w = values.shape
        path.write_bytes(f"{w}&{h}&1&".encode() + values.astype("<f4").tobytes())


@pytest.mark.parametrize(
    "name", ["a.png", "a.PNG", "a.tif", "float.tiff", "a.npy", "a.npz", "a.exr", "a.jpg.geometric.bin"]
)
def test_every_format_reads_the_same_values(tmp_path, name):
    save(tmp_path / name, DEPTH)
    found = read_depth(tmp_path / name)
    assert found.dtype == np.float32 and np.array_equal(found, DEPTH)


def test_maps_of_record3d(tmp_path):
    lzfse = pytest.importorskip("liblzfse", reason="pyliblzfse is not installed")
    values = np.random.default_rng(0).uniform(0.2, 5, (192, 256)).astype("<f4")
    (tmp_path / "0.depth").write_bytes(lzfse.compress(values.tobytes()))
    assert np.array_equal(read_depth(tmp_path / "0.depth"), values)
    (tmp_path / "1.depth").write_bytes(lzfse.compress(values[:-1].tobytes()))
    (tmp_path / "2.depth").write_bytes(b"bvx2" + bytes(200))
    for name, reason in (("1.depth", "are no map of"), ("2.depth", "is no depth map")):
        with pytest.raises(DatasetError, match=reason):
            read_depth(tmp_path / name)


def test_nan_zero_infinity_and_negative_are_no_depth(tmp_path):
    values = DEPTH.copy()
    values[0] = np.nan, 0.0, np.inf, -1.0
    save(tmp_path / "a.npy", values)
    found = read_depth(tmp_path / "a.npy")
    assert np.isnan(found[0]).all() and np.array_equal(found[1:], DEPTH[1:])


def npy_header(shape, dtype="<f4"):
    text = f"{{'descr': '{dtype}', 'fortran_order': False, 'shape': {shape}, }}\n".encode()
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text


def zipped(path, **members):
    with zipfile.ZipFile(path, "w") as archive:
        for name, data in members.items():
            archive.writestr(f"{name}.npy", data)


BAD = {
    "text.png": lambda path: path.write_text("no image"),
    "picture.png": lambda path: Image.new("RGB", (4, 3)).save(path),
    "empty.npy": lambda path: path.write_bytes(b""),
    "huge.npy": lambda path: path.write_bytes(npy_header((10**6, 10**6))),
    "short.npy": lambda path: path.write_bytes(npy_header((40, 30)) + bytes(100)),
    "objects.npy": lambda path: path.write_bytes(npy_header((3, 4), "|O")),
    "colour.npy": lambda path: np.save(path, np.ones((3, 4, 3))),
    "long.npy": lambda path: path.write_bytes(b"\x93NUMPY\x02\x00\xff\xff\xff\x7f"),
    "several.npz": lambda path: np.savez(path, a=DEPTH, b=DEPTH),
    "huge.npz": lambda path: zipped(path, depth=npy_header((10**5, 10**5))),
    "text.npz": lambda path: path.write_text("PK"),
    "text.exr": lambda path: path.write_text("no image"),
    "huge.geometric.bin": lambda path: path.write_bytes(b"900000&900000&1&" + bytes(100)),
    "short.geometric.bin": lambda path: path.write_bytes(b"40&30&1&" + bytes(100)),
    "normals.geometric.bin": lambda path: path.write_bytes(b"2&2&3&" + bytes(48)),
    "text.geometric.bin": lambda path: path.write_text("depth"),
    "zeros.npy": lambda path: np.save(path, np.zeros((3, 4))),
    "unknown.xyz": lambda path: path.write_bytes(b"1 2 3"),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_files_end_in_one_line_that_names_them(tmp_path, name):
    if name.endswith(".exr"):
        pytest.importorskip("OpenEXR", reason="OpenEXR is not installed (extra depth)")
    BAD[name](tmp_path / name)
    with pytest.raises(DatasetError) as caught:
        read_depth(tmp_path / name)
    assert name in str(caught.value) and "\n" not in str(caught.value) and len(str(caught.value)) < 500


@pytest.mark.parametrize("cut", [0.1, 0.5, 0.9])
@pytest.mark.parametrize("name", ["a.png", "a.tif", "a.npz", "a.exr", "a.npy"])
def test_truncated_files_end_in_one_line(tmp_path, name, cut):
    save(tmp_path / name, np.random.default_rng(0).uniform(1, 60_000, (40, 50)).astype(np.float32))
    data = (tmp_path / name).read_bytes()
    (tmp_path / name).write_bytes(data[: int(cut * len(data))])
    with pytest.raises(DatasetError, match=name):
        read_depth(tmp_path / name)


def test_a_missing_package_is_named(tmp_path, monkeypatch):
    for name, module, package in (("a.exr", "OpenEXR", "OpenEXR"), ("a.depth", "liblzfse", "pyliblzfse")):
        (tmp_path / name).write_bytes(b"1")
        monkeypatch.setitem(importlib.import_module("sys").modules, module, None)
        with pytest.raises(DatasetError, match=f"need.? {package}: pip install"):
            read_depth(tmp_path / name)


def test_maps_are_found_by_the_photos_names(tmp_path):
    for name in ("left/a.png", "right/a.npy", "b.JPG.geometric.bin", "b.JPG.photometric.bin", "c.png"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        save(tmp_path / name, DEPTH)
    names = ["images/left/a.JPG", "right/a.heic", "b.JPG", "deep/c.png", "other/d.png"]
    found = {
        name: file.path.relative_to(tmp_path).as_posix()
        for name, file in depth_files(tmp_path, names).items()
    }
    assert found == dict(
        zip(names[:4], ["left/a.png", "right/a.npy", "b.JPG.geometric.bin", "c.png"], strict=True)
    )


def test_two_maps_of_a_photo_and_foreign_names_are_refused(tmp_path):
    save(tmp_path / "a.png", DEPTH)
    with pytest.raises(
        DatasetError, match="the first of its maps is a.png, and none is named like a photo such as b"
    ):
        depth_files(tmp_path, ["b.jpg"])
    save(tmp_path / "a.npy", DEPTH)
    with pytest.raises(
        DatasetError, match="a.npy and a.png are both named like depth maps of the photo a.jpg"
    ):
        depth_files(tmp_path, ["a.jpg"])
    with pytest.raises(DatasetError, match="is no folder"):
        depth_files(tmp_path / "a.png", ["a.jpg"])


@pytest.mark.parametrize("largest", [2, 255])
def test_confidence_beside_the_maps_becomes_weights(tmp_path, largest):
    """Phones write 0, 1, 2 or 0 to 255."""
    (tmp_path / "depth").mkdir()
    (tmp_path / "confidence").mkdir()
    save(tmp_path / "depth" / "a.png", DEPTH * (DEPTH != 200))
    levels = np.full((3, 4), largest, np.uint8)
    levels[0, 0], levels[2] = 0, round(largest / 2)
    Image.fromarray(levels).save(tmp_path / "confidence" / "a.png")
    file = depth_files(tmp_path / "depth", ["a.jpg"])["a.jpg"]
    _, weights = read_map(file)
    assert weights[0].tolist() == [0, 0, 1, 1] and weights[1].tolist() == [1] * 4
    assert np.allclose(weights[2], 0.5, atol=0.01)
    Image.fromarray(levels[:-1]).save(tmp_path / "confidence" / "a.png")
    with pytest.raises(DatasetError, match="is 4x2 but its depth map 4x3"):
        read_map(file)


def test_an_exr_whose_first_part_is_damaged_is_no_depth(tmp_path, capsys):
    """OpenEXR prints that a part is damaged, and leaves it out, so that the second part would be read as the first."""
    exr = pytest.importorskip("OpenEXR", reason="OpenEXR is not installed (extra depth)")
    values = np.round(np.random.default_rng(0).uniform(1, 50, (40, 50))).astype(np.float32)
    how = {"compression": exr.ZIP_COMPRESSION, "type": exr.scanlineimage}
    path = tmp_path / "a.exr"
    exr.File([exr.Part(how | {"name": n}, {"Z": v}) for n, v in (("a", values), ("b", 2 * values))]).write(
        str(path)
    )
    assert np.array_equal(read_depth(path), values)
    packed = path.read_bytes()
    at = len(packed) // 2 - 300  # the parts have equal sizes: in the first one's last block
    path.write_bytes(packed[:at] + bytes(64) + packed[at + 64 :])
    with pytest.raises(DatasetError, match="its pixels are damaged; export it again"):
        read_depth(path)
    assert capsys.readouterr().out == ""
