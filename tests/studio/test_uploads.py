"""Uploads: limits hold before and while bytes come in, and nothing incomplete is ever seen."""

import io
import stat
import struct
import zipfile

import pytest

from gsplat_edu.studio import unpack as unpacking
from gsplat_edu.studio.refusal import RefusedError
from gsplat_edu.studio.unpack import ZipLimits, unpack
from gsplat_edu.studio.uploads import Limits
from studio.conftest import picture

SMALL = Limits(file=5_000, library=12_000, spare=0, entry_files=3, zipped=ZipLimits(entries=10, total=20_000))


def nothing_left(studio):
    return list(studio.library.hidden("uploads").iterdir()) == []


def in_pieces(data, size=1000):
    for begin in range(0, len(data), size):
        yield data[begin : begin + size]


@pytest.mark.parametrize("length", [10 << 30, 6_000])
@pytest.mark.parametrize("studio", [SMALL], indirect=True)
def test_a_large_upload_is_refused_by_its_announced_length(page, studio, length):
    def never():
        yield b"x"
        pytest.fail("the body was read")

    headers = {"Content-Length": str(length)}
    answer = page.put("/api/photos/a/files/a.jpg", content=never(), headers=headers)
    assert answer.status_code == 413 and answer.headers["connection"] == "close"
    assert nothing_left(studio) and not (studio.library.root / "photos" / "a").exists()


@pytest.mark.parametrize("studio", [SMALL], indirect=True)
def test_a_large_upload_without_a_length_is_stopped(page, studio):
    answer = page.put("/api/photos/a/files/a.jpg", content=in_pieces(bytes(9_000)))
    assert answer.status_code == 413 and nothing_left(studio)


@pytest.mark.parametrize("studio", [SMALL], indirect=True)
def test_the_library_has_a_limit(page, studio):
    noise = picture("PNG", (36, 36))
    statuses = [page.put(f"/api/photos/a{i}/files/a.png", content=noise).status_code for i in range(4)]
    assert 3_000 < len(noise) < 4_000 and statuses == [201, 201, 201, 507]
    page.delete("/api/photos/a0")
    assert page.put("/api/photos/b/files/a.png", content=noise).status_code == 201


@pytest.mark.parametrize("studio", [SMALL], indirect=True)
def test_uploads_without_a_length_count_as_they_come(page, studio):
    noise = picture("PNG", (36, 36))
    for name in "abc":
        assert page.put(f"/api/photos/{name}/files/a.png", content=in_pieces(noise)).status_code == 201
    assert page.put("/api/photos/d/files/a.png", content=in_pieces(noise)).status_code == 507
    assert nothing_left(studio) and studio.uploads._expected == studio.uploads._running == 0


@pytest.mark.parametrize("studio", [SMALL], indirect=True)
def test_uploads_that_are_on_their_way_count(page, studio, jpeg):
    studio.uploads._reserve(5_000, begins=True)
    studio.uploads._reserve(5_000, begins=True)
    headers = {"Content-Length": "3000"}
    assert page.put("/api/photos/a/files/a.jpg", content=jpeg * 9, headers=headers).status_code == 507
    studio.uploads._running = 16
    assert page.put("/api/photos/a/files/a.jpg", content=jpeg).status_code == 503


@pytest.mark.parametrize("studio", [Limits(spare=1 << 60)], indirect=True)
def test_the_disk_is_not_filled(page, studio, jpeg):
    answer = page.put("/api/photos/a/files/a.jpg", content=jpeg)
    assert answer.status_code == 507 and "there is room for 0" in answer.json()["error"]


@pytest.mark.parametrize("studio", [SMALL], indirect=True)
def test_an_entry_has_a_number_of_files(page, studio, jpeg):
    statuses = [page.put(f"/api/photos/a/files/{i}.jpg", content=jpeg).status_code for i in range(4)]
    assert statuses == [201, 201, 201, 413]


def test_a_file_is_whole_or_not_there(page, studio, jpeg):
    answer = page.put(
        "/api/photos/a/files/a.jpg", content=jpeg, headers={"Content-Length": str(len(jpeg) + 1)}
    )
    assert answer.status_code == 400 and "announced" in answer.json()["error"]
    assert page.put("/api/photos/a/files/a.jpg", content=b"").status_code == 400
    assert page.put("/api/photos/a/files/a.jpg", content=b"no photo").status_code == 400
    assert page.put("/api/photos/a/files/a.exe", content=jpeg).status_code == 400
    assert page.put("/api/runs/a/files/config.json", content=b"{}").status_code == 400
    assert page.put("/api/scenes/a/files/a.html", content=b"x").status_code == 400
    assert nothing_left(studio) and not (studio.library.root / "photos" / "a").exists()
    assert page.put("/api/photos/a/files/day 1/a.jpg", content=jpeg).status_code == 201
    assert (studio.library.root / "photos" / "a" / "day 1" / "a.jpg").read_bytes() == jpeg
    assert page.put("/api/photos/a/files/day 1/a.jpg", content=jpeg).status_code == 409
    assert page.put("/api/photos/a/files/day 1", content=jpeg).status_code in (400, 409)


def zipped(files, kind=zipfile.ZIP_DEFLATED):
    data = io.BytesIO()
    with zipfile.ZipFile(data, "w", kind) as archive:
        for name, content in files.items():
            archive.writestr(name, content)
    return data.getvalue()


def test_a_zip_of_photos_becomes_an_entry(page, studio, jpeg):
    names = ["trip/a.jpg", "trip/day 1/b.jpg", "trip/notes.txt", "__MACOSX/trip/._a.jpg", "trip/.DS_Store"]
    answer = page.put("/api/photos/trip/zip", content=zipped(dict.fromkeys(names, jpeg)))
    assert answer.json() == {"entry": "photos/trip", "files": 2, "left_out": ["notes.txt"], "num_left_out": 1}
    folder = studio.library.root / "photos" / "trip"
    assert sorted(str(path.relative_to(folder)) for path in folder.rglob("*.*")) == ["a.jpg", "day 1/b.jpg"]
    assert page.put("/api/photos/trip/zip", content=zipped({"a.jpg": jpeg})).status_code == 409
    assert page.put("/api/photos/none/zip", content=zipped({"a.txt": b"x"})).status_code == 400
    assert nothing_left(studio) and not (studio.library.root / "photos" / "none").exists()


def linked():
    data = io.BytesIO()
    with zipfile.ZipFile(data, "w") as archive:
        info = zipfile.ZipInfo("link.jpg")
        info.external_attr = (stat.S_IFLNK | 0o777) << 16
        archive.writestr(info, "/etc/passwd")
    return data.getvalue()


def lying():
    """A zip file whose entry unpacks to more than it claims."""
    data = bytearray(zipped({"a.jpg": bytes(50_000)}))
    for at in (data.index(b"PK\x03\x04") + 22, data.index(b"PK\x01\x02") + 24):
        struct.pack_into("<I", data, at, 10)
    return bytes(data)


def many_claimed():
    """A zip file whose end claims more entries than memory could hold."""
    data = bytearray(zipped({"a.jpg": b"x"}))
    struct.pack_into("<HHI", data, len(data) - 22 + 8, 0xFFFF, 0xFFFF, 0xFFFFFFF0)
    return bytes(data)


HOSTILE = {
    "no zip": b"no zip file",
    "cut": zipped({"a.jpg": bytes(5000)})[:-30],
    "up": zipped({"../a.jpg": b"x"}),
    "absolute": zipped({"/tmp/a.jpg": b"x"}),
    "backslash": zipped({"..\\a.jpg": b"x"}),
    "hidden": zipped({".ssh/authorized_keys": b"x"}),
    "deep": zipped({"x/" * 40 + "a.jpg": b"x"}),
    "control": zipped({"a\nb.jpg": b"x"}),
    "link": linked(),
    "too many": zipped({f"{i}.jpg": b"" for i in range(11)}),
    "too large": zipped({"a.jpg": bytes(21_000)}),
    "file and folder": zipped({"b/a": b"x", "b/a/c.jpg": b"x"}),
    "unusual": zipped({"a.jpg": b"x"}, zipfile.ZIP_LZMA),
    "lying": lying(),
    "many claimed": many_claimed(),
}


@pytest.mark.parametrize("name", HOSTILE)
def test_hostile_zip_files_are_refused(tmp_path, name):
    path, into = tmp_path / "hostile.zip", tmp_path / "a" / "b" / "into"
    into.parent.mkdir(parents=True)
    path.write_bytes(HOSTILE[name])
    with pytest.raises(RefusedError, match="^zip: ") as caught:
        unpack(path, into, ZipLimits(entries=10, total=20_000))
    assert "\n" not in str(caught.value)
    assert not [
        found
        for found in tmp_path.rglob("*")
        if found.is_file() and into not in found.parents and found != path
    ]


def test_a_bomb_is_refused_by_its_ratio(tmp_path):
    path = tmp_path / "bomb.zip"
    path.write_bytes(zipped({"a.jpg": bytes(3 << 20)}))
    with pytest.raises(RefusedError, match="times its size"):
        unpack(path, tmp_path / "into", ZipLimits(free=1 << 20))
    assert not (tmp_path / "into").exists()


def test_an_encrypted_entry_is_refused(tmp_path):
    data = bytearray(zipped({"a.jpg": b"x" * 50}))
    for at in (data.index(b"PK\x03\x04") + 6, data.index(b"PK\x01\x02") + 8):
        data[at] |= 1
    (tmp_path / "a.zip").write_bytes(data)
    with pytest.raises(RefusedError, match="encrypted"):
        unpack(tmp_path / "a.zip", tmp_path / "into", ZipLimits())


def test_the_directory_of_a_zip64_file_is_measured_too(tmp_path):
    """zipfile believes the zip64 record, however harmless the ordinary one looks."""
    plain = zipped({"a.jpg": b"x"})
    record = struct.pack("<IQHHIIQQQQ", 0x06064B50, 44, 45, 45, 0, 0, 1 << 40, 1 << 40, 1 << 50, 0)
    locator = struct.pack("<IIQI", 0x07064B50, 0, len(plain) - 22, 1)
    (tmp_path / "a.zip").write_bytes(plain[:-22] + record + locator + plain[-22:])
    with pytest.raises(RefusedError, match="entries may be in it"):
        unpack(tmp_path / "a.zip", tmp_path / "into", ZipLimits())


@pytest.mark.sliced(40)
@pytest.mark.parametrize("seed", range(400))
def test_damaged_zip_files_end_in_one_line(tmp_path, seed):
    import random

    draw = random.Random(seed)
    data = bytearray(zipped({"a.jpg": draw.randbytes(300), "b/c.jpg": bytes(1000)}))
    for _ in range(draw.randint(1, 4)):
        data[draw.randrange(len(data))] = draw.randrange(256)
    (tmp_path / "a.zip").write_bytes(data[: draw.randint(1, len(data))] if draw.random() < 0.3 else data)
    try:
        count, _ = unpack(tmp_path / "a.zip", tmp_path / "into", ZipLimits())
    except RefusedError as error:
        assert str(error).startswith("zip: ") and "\n" not in str(error)
    else:
        assert count <= 2
    assert unpacking.TAIL == 65_557
