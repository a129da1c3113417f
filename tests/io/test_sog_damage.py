import contextlib
import io
import json
import tracemalloc
import zipfile
import zlib

import numpy as np
import pytest
from PIL import Image

from gsplat_edu.base.errors import SceneFormatError
from gsplat_edu.io.sog import codec as sog
from scene_files import random_scene, refused

COUNT = 40


@pytest.fixture(scope="module")
def contents(tmp_path_factory):
    """Return the files of a small scene by name."""
    path = tmp_path_factory.mktemp("sog") / "meta.json"
    sog.write(path, random_scene(COUNT, 3))
    return {file.name: file.read_bytes() for file in sorted(path.parent.iterdir())}


def peak_of(read, path):
    tracemalloc.start()
    try:
        read(path)
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


def zipped(path, contents, method=zipfile.ZIP_STORED):
    with zipfile.ZipFile(path, "w", method) as bundle:
        for name, data in contents.items():
            bundle.writestr(name, data)
    return path


def in_folder(folder, contents):
    folder.mkdir(exist_ok=True)
    for name, data in contents.items():
        (folder / name).write_bytes(data)
    return folder / "meta.json"


def with_meta(contents, change):
    """Return the same files with a changed meta.json."""
    meta = json.loads(contents["meta.json"])
    change(meta)
    return contents | {"meta.json": json.dumps(meta).encode()}


def pixels_of(data):
    return np.asarray(Image.open(io.BytesIO(data)).convert("RGBA")).copy()


def webp(pixels, **options):
    file = io.BytesIO()
    Image.fromarray(pixels).save(file, "WEBP", **({"lossless": True, "exact": True} | options))
    return file.getvalue()


def test_truncated_files_in_a_folder_are_refused(tmp_path, contents):
    path = in_folder(tmp_path / "a", contents)
    for name, data in contents.items():
        for length in range(0, len(data), 64):
            (path.parent / name).write_bytes(data[:length])
            refused(path)
        (path.parent / name).write_bytes(data)
    sog.read(path)


def test_deflated_zips_are_read(tmp_path, contents):
    a = sog.read(zipped(tmp_path / "a.sog", contents, zipfile.ZIP_DEFLATED)).gaussians
    b = sog.read(in_folder(tmp_path / "b", contents)).gaussians
    assert all(bool((t == b.tensors()[name]).all()) for name, t in a.tensors().items())


@pytest.mark.parametrize("method", [zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA])
def test_other_zip_methods_are_refused(tmp_path, contents, method):
    message = refused(zipped(tmp_path / "a.sog", contents, method))
    assert "meta.json is neither stored nor deflated; zip it again" in message


def test_zip_bombs_are_not_unpacked(tmp_path, contents):
    """300 kB unpack to 300 MB of zeros, of which both headers of the zip declare all, then only 100 bytes."""
    path = zipped(tmp_path / "a.sog", contents | {"quats.webp": bytes(300 << 20)}, zipfile.ZIP_DEFLATED)
    bomb = path.read_bytes()

    def said(path):
        messages.append(refused(path))

    messages = []
    assert peak_of(said, path) < 16 << 20
    assert "claims to hold 314,572,800 bytes in a file of" in messages[0]

    path.write_bytes(bomb.replace((300 << 20).to_bytes(4, "little"), (100).to_bytes(4, "little")))
    assert peak_of(said, path) < 16 << 20
    assert "quats.webp in it is damaged" in messages[1]


def test_the_last_of_two_files_with_the_same_name_is_read(tmp_path, contents):
    path = zipped(tmp_path / "a.sog", contents | {"quats.webp": b"not an image"})
    with zipfile.ZipFile(path, "a") as bundle, pytest.warns(UserWarning, match="Duplicate name"):
        bundle.writestr("quats.webp", contents["quats.webp"])
    assert len(sog.read(path).gaussians) == COUNT


def test_odd_fields_of_a_zip_directory_cause_no_warning(tmp_path, contents):
    """The field is an empty Unicode path, of which newer versions of Python warn."""
    path = tmp_path / "a.sog"
    with zipfile.ZipFile(path, "w") as bundle:
        for name, data in contents.items():
            entry = zipfile.ZipInfo(name)
            entry.extra = b"\x75\x70\x05\x00\x01" + zlib.crc32(name.encode()).to_bytes(4, "little")
            bundle.writestr(entry, data)
    with contextlib.suppress(SceneFormatError):  # some versions of Python refuse it
        assert len(sog.read(path).gaussians) == COUNT


@pytest.mark.parametrize(
    "name", ["meta.json", "means_u.webp", "sh0.webp", "shN_centroids.webp", "shN_labels.webp"]
)
def test_missing_files_are_named(tmp_path, contents, name):
    rest = {other: data for other, data in contents.items() if other != name}
    assert f"{name} is missing" in refused(zipped(tmp_path / "a.sog", rest))
    path = in_folder(tmp_path / "a", rest)
    if name == "meta.json":
        with pytest.raises(FileNotFoundError, match=r"meta\.json"):
            sog.read(path)
    else:
        assert f"{name} is missing" in refused(path)


def test_other_files_are_refused_by_kind(tmp_path, contents):
    path = tmp_path / "a.sog"
    for data in (b"", b"ply\nformat", bytes(100), contents["sh0.webp"]):
        path.write_bytes(data)
        assert "it is not a zip" in refused(path)
    pointer = b"version https://git-lfs.github.com/spec/v1\noid sha256:0\n"
    path.write_bytes(pointer)
    assert "git lfs pull" in refused(path)
    folder = in_folder(tmp_path / "a", contents | {"quats.webp": pointer})
    message = refused(folder)
    assert "quats.webp: is a Git LFS pointer" in message


def _set(dotted, value):
    def change(meta):
        *path, last = dotted.split(".")
        for key in path:
            meta = meta[int(key)] if isinstance(meta, list) else meta[key]
        if isinstance(meta, list):
            meta[int(last)] = value
        else:
            meta[last] = value

    return change


NUMBERS = ["scales.codebook", "sh0.codebook", "shN.codebook", "means.mins", "means.maxs"]


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        *((_set(key, [0.0] * 255), f"{key}: is [0.0, 0.0, ") for key in NUMBERS),
        *((_set(key, None), f"{key}: is null, but has to be a list") for key in NUMBERS),
        *(
            (_set(f"{key}.2", value), f"{key}[2]: is ")
            for key in NUMBERS
            for value in (1e39, None, "1", True, 10**400)
        ),
        (_set("means.mins.0", 88.8), "means.mins[0]: is "),  # e^88.8 overflows float32
        (_set("means", [1, 2]), "means: is [1, 2], but has to be an object"),
        (_set("version", 3), "is SOG of version 3, but only version 2 is supported"),
        (_set("version", "2"), "is SOG of no version"),
        (_set("version", True), "is SOG of no version"),
        (_set("version", 10**4000), "is SOG of no version"),
        (lambda meta: (meta.pop("version"), meta["means"].update(shape=[40, 3])), "is SOG of version 1, but"),
        *((_set("count", value), "count: is ") for value in (-1, 1.5, True, None, 2**26 + 1, 10**99)),
        (_set("count", 2**26), "claims to hold 6,174,015,488 bytes in a file of"),
        (_set("count", COUNT * 10), "has 8x8 pixels for 400 splats"),
        (_set("shN.count", 0), "but has to be a whole number, at least 1 and at most 65,536"),
        (_set("shN.count", 65537), "but has to be a whole number, at least 1 and at most 65,536"),
        (_set("shN.count", COUNT - 1), "its label 39 exceeds the palette of 39"),
        (_set("shN.count", 65), "has 192x1 pixels, but 65 entries of degree 1 take 192x2"),
        (_set("shN.bands", 4), "shN.bands: is 4, but has to be a whole number, at least 1 and at most 3"),
        (_set("shN.bands", 2), "has 192x1 pixels, but 40 entries of degree 2 take 512x1"),
        (_set("shN", 7), "shN: is 7, but has to be an object or null"),
        (_set("antialias", "yes"), 'antialias: is "yes", but has to be true or false'),
        (_set("quats.files", []), "quats.files: is [], but has to have 1 entries"),
        (_set("means.files", "means_l.webp"), 'means.files: is "means_l.webp", but has to be a list'),
        (_set("quats.files.0", "meta.json"), "meta.json is not a WebP image"),
    ],
)
def test_invalid_metadata_is_named(tmp_path, contents, change, expected):
    assert expected in refused(zipped(tmp_path / "a.sog", with_meta(contents, change)))


@pytest.mark.parametrize(
    "name",
    [
        "../quats.webp",
        "/etc/passwd",
        "a/quats.webp",
        "..",
        ".",
        "",
        "C:quats.webp",
        "a\\b",
        "a\0b",
        "\ud800",
        7,
        "q" * 999,
    ],
)
def test_file_names_outside_the_folder_are_refused(tmp_path, contents, name):
    changed = with_meta(contents, _set("quats.files.0", name))
    for path in (zipped(tmp_path / "a.sog", changed), in_folder(tmp_path / "a", changed)):
        assert f"but has to be {'text' if name == 7 else 'a plain file name'}" in refused(path)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (b"", "is not JSON"),
        (b"\xff\xfe\x00", "is not JSON"),
        (b'{"count": NaN}', "is not JSON (NaN is not valid JSON)"),
        (b'{"count": -Infinity}', "is not JSON (-Infinity is not valid JSON)"),
        (b'{"a":' * 200_000, "is not JSON (nested too deeply)"),
        (b"9" * 5000, "is not JSON"),
        (b"[]", "is SOG of no version"),
        (b"{}", "is SOG of no version"),
        (b'{"version": 2}', "lacks 'count'"),
        (b" " * (1 << 21) + b"{}", "its metadata has 2,097,154 bytes"),
    ],
)
def test_unreadable_metadata_is_refused(tmp_path, contents, text, expected):
    assert expected in refused(zipped(tmp_path / "a.sog", contents | {"meta.json": text}))


def test_a_json_number_beyond_float_range_is_refused(tmp_path, contents):
    text = contents["meta.json"].replace(b'"mins":[', b'"mins":[1e999,')
    start, rest = text.split(b'"mins":[')
    first, second, *others = rest.split(b",")
    changed = start + b'"mins":[' + b",".join([first, *others])
    assert b"1e999" in changed and second
    assert "means.mins[0]: is " in refused(zipped(tmp_path / "a.sog", contents | {"meta.json": changed}))


def test_codebooks_that_start_with_null_are_read(tmp_path, contents):
    """Codebooks of scenes with infinite values start with null, which is extrapolated downwards by the mean step."""
    entries = np.array(json.loads(contents["meta.json"])["sh0"]["codebook"])
    pixels = pixels_of(contents["sh0.webp"])
    pixels[0, 0, 0] = 0
    changed = with_meta(contents, _set("sh0.codebook.0", None)) | {"sh0.webp": webp(pixels)}
    read = sog.read(zipped(tmp_path / "a.sog", changed)).gaussians
    expected = entries[1] - (entries[255] - entries[1]) / 255
    assert float(read.sh0[0, 0, 0]) == pytest.approx(expected, rel=1e-6)


def test_invalid_extras_of_other_programs_are_ignored(tmp_path, contents):
    for value in ("y", [0, 1], [0, 0, 0], [0, "1", 0], [1e39, 0, 0], None, {"x": 1}):
        changed = with_meta(contents, _set("asset.extras.up", value))
        assert sog.read(zipped(tmp_path / "a.sog", changed)).up is None
    longer = with_meta(contents, _set("asset.extras.up", [0, -3, 4]))
    assert sog.read(zipped(tmp_path / "a.sog", longer)).up == (0.0, -0.6, 0.8)


def test_unknown_rotation_encodings_are_refused(tmp_path, contents):
    pixels = pixels_of(contents["quats.webp"])
    assert (pixels.reshape(-1, 4)[COUNT:] == 0).all(), "pixels beyond the last splat are zero"
    pixels[1, 2, 3] = 251
    message = refused(zipped(tmp_path / "a.sog", contents | {"quats.webp": webp(pixels)}))
    assert f"splat {pixels.shape[1] + 2}: its rotation has an unknown encoding" in message


def test_images_of_other_sizes_are_refused(tmp_path, contents):
    pixels = pixels_of(contents["scales.webp"])
    twice = webp(np.concatenate([pixels, pixels]))
    message = refused(zipped(tmp_path / "a.sog", contents | {"scales.webp": twice}))
    assert "its images differ in size" in message
    huge = webp(np.zeros((300, 300, 3), dtype=np.uint8))
    assert "has 300x300 pixels for 40 splats" in refused(
        zipped(tmp_path / "b.sog", contents | {"scales.webp": huge})
    )
    tall = webp(np.zeros((1025, 192, 3), dtype=np.uint8))
    message = refused(zipped(tmp_path / "c.sog", contents | {"shN_centroids.webp": tall}))
    assert "has 192x1025 pixels, but 40 entries" in message


@pytest.mark.parametrize("kind", ["lossless", "extended", "lossy"])
def test_absurd_sizes_are_refused_before_anything_is_decoded(tmp_path, contents, kind):
    """Each of the three kinds of WebP header declares the largest size it can."""
    if kind == "lossless":
        data = bytearray(contents["scales.webp"])
        assert data[12:16] == b"VP8L"
        data[21:25] = (2**28 - 1 | int.from_bytes(data[21:25], "little")).to_bytes(4, "little")
        size = "16384x16384"
    elif kind == "extended":
        data = bytearray(webp(pixels_of(contents["quats.webp"]), lossless=False))
        assert data[12:16] == b"VP8X"
        data[24:30] = b"\xff" * 6
        size = "16777216x16777216"
    else:
        data = bytearray(webp(pixels_of(contents["scales.webp"])[:, :, :3], lossless=False))
        assert data[12:16] == b"VP8 "
        data[26:30] = b"\xff" * 4
        size = "16383x16383"
    path = zipped(tmp_path / "a.sog", contents | {"scales.webp": bytes(data)})

    def said(path):
        assert f"scales.webp has {size} pixels for 40 splats" in refused(path)

    assert peak_of(said, path) < 4 << 20


def test_other_images_are_refused(tmp_path, contents):
    png = io.BytesIO()
    Image.fromarray(pixels_of(contents["scales.webp"])).save(png, "PNG")
    message = refused(zipped(tmp_path / "a.sog", contents | {"scales.webp": png.getvalue()}))
    assert "scales.webp is not a WebP image" in message
    broken = contents["scales.webp"][:30] + bytes(len(contents["scales.webp"]) - 30)
    message = refused(zipped(tmp_path / "a.sog", contents | {"scales.webp": broken}))
    assert "scales.webp is a damaged WebP image" in message


def test_lossy_images_are_read(tmp_path, contents):
    """Images are lossy, rotations with lossy colour but exact alpha, so all three WebP headers are read."""
    lossy = {
        "means_u.webp": webp(pixels_of(contents["means_u.webp"])[:, :, :3], lossless=False),
        "quats.webp": webp(pixels_of(contents["quats.webp"]), lossless=False, alpha_quality=100),
    }
    exact = sog.read(zipped(tmp_path / "a.sog", contents)).gaussians
    read = sog.read(zipped(tmp_path / "b.sog", contents | lossy)).gaussians
    assert not bool((exact.means == read.means).all()) and not bool((exact.quats == read.quats).all())
    np.testing.assert_array_equal(exact.sh0.numpy(), read.sh0.numpy())
    assert (exact.quats.argmax(dim=1) == read.quats.abs().argmax(dim=1)).float().mean() > 0.5


def test_images_may_be_larger_than_the_scene(tmp_path, contents):
    """Some writers use squares whose side is a power of two, in which splats are stored row by row."""
    wide = {}
    for name, data in contents.items():
        if name.endswith(".webp") and name != "shN_centroids.webp":
            flat = pixels_of(data).reshape(-1, 4)[:COUNT]
            pixels = np.zeros((64 * 64, 4), dtype=np.uint8)
            pixels[:COUNT] = flat
            wide[name] = webp(pixels.reshape(64, 64, 4))
    a = sog.read(zipped(tmp_path / "a.sog", contents)).gaussians
    b = sog.read(zipped(tmp_path / "b.sog", contents | wide)).gaussians
    assert all(bool((t == b.tensors()[name]).all()) for name, t in a.tensors().items())
