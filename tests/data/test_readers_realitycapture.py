"""RealityCapture's tables and XMP files: both kinds of angles, columns in any order, lenses, and real files."""

import re

import numpy as np
import pytest

from data.pose_programs import RC_LENS, RC_NUMBERS, H, W, assert_reads, write_table, write_xmp
from gsplat_edu.base.errors import DatasetError
from gsplat_edu.data.dataset import load_dataset
from gsplat_edu.data.reader import layout_of, read_capture
from gsplat_edu.data.readers.realitycapture import read_xmp, table_of

OMEGA = ("name", "x", "y", "z", "omega", "phi", "kappa", *RC_LENS)


def seen(x, y):
    """The longer side is 36 mm long; principal points count from the middle, in longer sides."""
    q = x * x + y * y
    d = 1 - 0.1 * q + 0.02 * q**2 - 0.004 * q**3
    a = d * x + 2 * 0.003 * x * y - 0.002 * (q + 2 * x * x)
    b = d * y + 0.003 * (q + 2 * y * y) - 2 * 0.002 * x * y
    return W / 2 + W * (33 / 36 * a + 0.02), H / 2 + W * (33 / 36 * b - 0.03)


@pytest.mark.parametrize(
    "columns", [RC_NUMBERS, RC_NUMBERS[::-1], OMEGA, ("k1", *OMEGA[::-1][:9], *OMEGA[:7])]
)
@pytest.mark.parametrize("count", ["#cameras 6\n", ""])
def test_tables(tmp_path, columns, count):
    write_table(tmp_path, columns=tuple(dict.fromkeys(columns)), count=count)
    assert_reads(tmp_path, "RealityCapture", seen)


def test_xmp_files(tmp_path):
    write_xmp(tmp_path)
    (tmp_path / "images" / "other.xmp").write_text("<x:xmpmeta xmlns:x='adobe:ns:meta/'>rated 5</x:xmpmeta>")
    assert layout_of(tmp_path) == "RealityCapture"
    assert_reads(tmp_path, "RealityCapture", seen)


def test_a_table_without_focal_lengths_says_what_to_export(tmp_path):
    write_table(tmp_path, columns=OMEGA[:7])
    with pytest.raises(
        DatasetError, match=r"photo shot_0\.png: the table has no columns f, px and py; export Inter"
    ):
        read_capture(tmp_path)


def test_a_lens_without_a_model_is_named(tmp_path):
    write_table(tmp_path, lens={**RC_LENS, "k4": 0.01})
    with pytest.raises(
        DatasetError, match="a lens with k4 has no model here; align with the distortion model Brown3"
    ):
        read_capture(tmp_path)


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ('Model="brown3t2"', 'Model="division"', "the distortion model 'division' has no model here"),
        ('Skew="0"', 'Skew="0.01"', "a lens with skew has no model here"),
        ("xcr:Position", "xcr:Place", "lacks Position; export XMP files with camera parameters"),
        ("<xcr:Rotation>", "<xcr:Rotation>1 ", "but has to be 9 numbers"),
        ("<x:xmpmeta", "<!DOCTYPE x><x:xmpmeta", "has a document type, which is refused"),
        ("</x:xmpmeta>", "", "is not XML ("),
    ],
)
def test_xmp_files_that_cannot_be_used(tmp_path, old, new, says):
    write_xmp(tmp_path)
    for path in (tmp_path / "images").glob("*.xmp"):
        path.write_text(path.read_text().replace(old, new))
    with pytest.raises(DatasetError, match=re.escape(says)) as caught:
        read_capture(tmp_path)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        (",33.0,", ",", "line 3: has 15 entries for 16 columns"),
        (",33.0,", ",nan,", "line 3, column f: is 'nan', but has to be 1 numbers"),
        (",33.0,", ",far,", "line 3, column f: is 'far'"),
        ("shot_0.png,", '"shot_0.png,', "is not a table ("),
    ],
)
def test_damaged_tables_are_refused_in_one_line(tmp_path, old, new, says):
    write_table(tmp_path)
    path = tmp_path / "cameras.csv"
    path.write_text(path.read_text().replace(old, new, 1))
    with pytest.raises(DatasetError, match=re.escape(says)) as caught:
        read_capture(tmp_path)
    assert str(caught.value).startswith(str(path)) and "\n" not in str(caught.value)


def test_real_files_agree(real):
    """The table and the XMP files are two exports of one project."""
    folder = real("poses") / "realitycapture"
    table = {shot.name: shot for shot in table_of(folder / "parking.csv").shots}
    assert len(table) == 706
    files = read_xmp(folder / "IMG_8834.xmp").shots
    assert [shot.name for shot in files] == ["DJI_0085", "IMG_8834"]
    for shot in files:
        np.testing.assert_allclose(table[f"{shot.name}.JPG"].R, shot.R, rtol=0, atol=1e-12)
        np.testing.assert_allclose(table[f"{shot.name}.JPG"].eye, shot.eye, rtol=0, atol=1e-9)
    dataset = load_dataset(folder)
    assert str(dataset.notes[0]) == "poses of RealityCapture: 2 of 2 photos"
    assert "not read: parking.csv (the table has no columns f, px and py" in str(dataset.notes[1])
