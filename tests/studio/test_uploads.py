"""Limits of uploads are checked before and while bytes arrive, and incomplete files are never visible."""

import contextlib
import io
import random
import stat
import struct
import zipfile

import pytest

from gsplat_edu.base.zip_directory import TAIL, check_directory
from gsplat_edu.server.refusal import RefusedError
from gsplat_edu.studio import uploads
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
    assert page.put("/api/photos/b/files/a.png", content=noise).status_code == 507, (
        "the trash fills the disk too"
    )
    page.delete("/api/trash")
    assert page.put("/api/photos/b/files/a.png", content=noise).status_code == 201


@pytest.mark.parametrize("studio", [SMALL], indirect=True)
def test_files_that_are_sent_and_deleted_in_turn_end_at_the_limit(page, studio):
    noise = picture("PNG", (36, 36))
    statuses = []
    for index in range(6):
        statuses.append(page.put(f"/api/photos/a{index}/files/a.png", content=noise).status_code)
        page.delete(f"/api/photos/a{index}")
    assert statuses == [201, 201, 201, 507, 507, 507]
    assert "empty the trash" in page.put("/api/photos/b/files/a.png", content=noise).json()["error"]


def weight(folder):
    """Return the bytes of all files in a folder, hidden ones too."""
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file() and not path.is_symlink())


def test_the_used_space_is_that_of_the_whole_library(page, studio, tmp_path, jpeg):
    """What jobs write counts without an upload, and so do the trash, records and thumbnails; adopted places do not."""
    root = studio.library.root

    def used():
        return page.get("/api/library").json()["used_bytes"]

    page.put("/api/photos/a/files/a.jpg", content=jpeg)
    assert used() == weight(root)
    (root / "runs" / "box").mkdir()
    (root / "runs" / "box" / "scene.ply").write_bytes(bytes(50_000))  # as a training does
    page.get("/api/photos/a/thumbs/a.jpg")
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "elsewhere" / "b.jpg").write_bytes(bytes(70_000))
    page.post("/api/adopt", json={"kind": "photos", "path": str(tmp_path / "elsewhere"), "name": "b"})
    assert used() == weight(root) > 50_000
    page.delete("/api/runs/box")
    found = page.get("/api/library").json()
    assert found["used_bytes"] == weight(root) > 50_000 <= found["trash_bytes"] < 51_000
    page.delete("/api/trash")
    assert used() == weight(root) < 50_000 and page.get("/api/library").json()["trash_bytes"] == 0


@pytest.mark.parametrize("studio", [Limits(library=100_000, spare=0)], indirect=True)
def test_what_a_job_has_written_counts_for_uploads(page, studio, jpeg, monkeypatch):
    clock = [100.0]
    monkeypatch.setattr(uploads, "monotonic", lambda: clock[0])
    page.put("/api/photos/a/files/a.jpg", content=jpeg)
    (studio.library.root / "runs" / "box").mkdir()
    (studio.library.root / "runs" / "box" / "scene.ply").write_bytes(bytes(100_000))
    clock[0] += uploads.COUNTED_FOR
    assert page.put("/api/photos/a/files/b.jpg", content=jpeg).status_code == 507


@pytest.mark.parametrize("studio", [SMALL], indirect=True)
def test_uploads_without_a_length_count_as_they_arrive(page, studio):
    noise = picture("PNG", (36, 36))
    for name in "abc":
        assert page.put(f"/api/photos/{name}/files/a.png", content=in_pieces(noise)).status_code == 201
    assert page.put("/api/photos/d/files/a.png", content=in_pieces(noise)).status_code == 507
    assert nothing_left(studio)
    page.delete("/api/photos/a")
    page.delete("/api/trash")
    again = page.put("/api/photos/d/files/a.png", content=in_pieces(noise))
    assert again.status_code == 201, "a refused upload reserves no space"


@pytest.mark.parametrize("studio", [SMALL], indirect=True)
def test_uploads_in_progress_count(page, studio, jpeg):
    studio.uploads.reserve(5_000, begins=True)
    studio.uploads.reserve(5_000, begins=True)
    headers = {"Content-Length": "3000"}
    assert page.put("/api/photos/a/files/a.jpg", content=jpeg * 9, headers=headers).status_code == 507
    for _ in range(uploads.AT_ONCE - 2):
        studio.uploads.reserve(0, begins=True)
    assert page.put("/api/photos/a/files/a.jpg", content=jpeg).status_code == 503


@pytest.mark.parametrize("studio", [Limits(spare=1 << 60)], indirect=True)
def test_the_disk_is_not_filled(page, studio, jpeg):
    answer = page.put("/api/photos/a/files/a.jpg", content=jpeg)
    assert answer.status_code == 507 and "there is room for 0" in answer.json()["error"]


@pytest.mark.parametrize("studio", [SMALL], indirect=True)
def test_the_number_of_files_of_an_entry_is_limited(page, studio, jpeg):
    statuses = [page.put(f"/api/photos/a/files/{i}.jpg", content=jpeg).status_code for i in range(4)]
    assert statuses == [201, 201, 201, 413]


def test_an_incomplete_file_is_not_visible(page, studio, jpeg):
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
    """Return a zip file whose entry unpacks to more than it declares."""
    data = bytearray(zipped({"a.jpg": bytes(50_000)}))
    for at in (data.index(b"PK\x03\x04") + 22, data.index(b"PK\x01\x02") + 24):
        struct.pack_into("<I", data, at, 10)
    return bytes(data)


def many_claimed():
    """Return a zip file whose end record declares more entries than fit into memory."""
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


def wide(plain, *, fields=None, offset=None, extra=b"", end=None):
    """Add zip64 records to a zip file, with the fields of its end record or with others."""
    count, length, begin = struct.unpack_from("<HII", plain, len(plain) - 12)
    fields = (0, 0, count, count, length, begin) if fields is None else fields
    record = struct.pack("<IQHHIIQQQQ", 0x06064B50, 44 + len(extra), 45, 45, *fields) + extra
    locator = struct.pack("<IIQI", 0x07064B50, 0, len(plain) - 22 if offset is None else offset, 1)
    return plain[:-22] + record + locator + (plain[-22:] if end is None else end)


MAXIMAL = struct.pack("<IHHHHIIH", 0x06054B50, 0, 0, 0xFFFF, 0xFFFF, 0xFFFFFFFF, 0xFFFFFFFF, 0)
"""An end record that refers to the zip64 record for all fields."""


def test_a_zip64_file_is_unpacked(tmp_path):
    for end in (None, MAXIMAL):
        (tmp_path / "a.zip").write_bytes(wide(zipped({"a.jpg": b"x", "b.jpg": b"yz"}), end=end))
        assert unpack(tmp_path / "a.zip", tmp_path / f"into{end is None}", ZipLimits()) == (2, [])


def two_ends():
    """Return a zip file whose locator refers to a harmless end record at the start, with another directly before it."""
    many = zipped({f"{i}.jpg": b"" for i in range(300)})
    harmless = struct.pack("<IQHHIIQQQQ", 0x06064B50, 44, 45, 45, 0, 0, 1, 1, 50, 0)
    count, length, begin = struct.unpack_from("<HII", many, len(many) - 12)
    ordinary = struct.pack("<IHHHHIIH", 0x06054B50, 0, 0, 1, 1, 50, 0, 0)
    whole = (0, 0, count, count, length, begin + len(harmless))
    return harmless + wide(many, fields=whole, offset=0, end=ordinary)


def with_comment(plain, comment):
    return plain[:-2] + struct.pack("<H", len(comment)) + comment


def changed_end(plain, **values):
    names = ("signature", "disk", "first", "here", "count", "length", "begin", "comment")
    end = dict(zip(names, struct.unpack("<IHHHHIIH", plain[-22:]), strict=True)) | values
    return plain[:-22] + struct.pack("<IHHHHIIH", *end.values())


def nameless():
    """Return a zip file whose only entry has an empty name, which `zipfile` reads but does not write."""
    local = struct.pack("<4s5H3I2H", b"PK\x03\x04", 20, 0, 0, 0, 33, 0, 0, 0, 0, 0)
    entry = struct.pack("<4s6H3I5H2I", b"PK\x01\x02", 20, 20, 0, 0, 0, 33, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0)
    return local + entry + struct.pack("<4s4H2IH", b"PK\x05\x06", 0, 0, 1, 1, len(entry), len(local), 0)


PLAIN = zipped({"a.jpg": b"x", "b.jpg": b"y"})
BEGIN = struct.unpack_from("<I", PLAIN, len(PLAIN) - 6)[0]

AMBIGUOUS = {
    "two ends": two_ends(),
    "claims too much": wide(PLAIN, fields=(0, 0, 1 << 40, 1 << 40, 1 << 50, 0)),
    "ends that disagree": wide(PLAIN, fields=(0, 0, 1, 1, 50, 0)),
    "locator that leads elsewhere": wide(PLAIN, offset=0),
    "locator behind the file": wide(PLAIN, offset=1 << 60),
    "record with something behind": wide(PLAIN, extra=b"more"),
    "another disk": wide(PLAIN, fields=(1, 1, 2, 2, len(PLAIN) - 22 - BEGIN, BEGIN)),
    "end in a comment": with_comment(PLAIN, changed_end(PLAIN)[-22:]),
    "end in a longer comment": with_comment(PLAIN, b"x" + PLAIN[-22:] + b"y"),
    "something in front": b"in front" + PLAIN,
    "something behind": PLAIN + b"behind",
    "fewer entries claimed": changed_end(PLAIN, here=1, count=1),
    "more entries claimed": changed_end(PLAIN, here=3, count=3),
    "a part of the directory": changed_end(PLAIN, length=54),
    "directory elsewhere": changed_end(PLAIN, begin=BEGIN - 1),
    "one of several disks": changed_end(PLAIN, disk=1),
    "no name": nameless(),
    "name that begins with NUL": zipped({"zz.jpg": b"x"}).replace(b"zz.jpg", b"\0z.jpg"),
}


@pytest.mark.parametrize("name", AMBIGUOUS)
def test_an_ambiguous_zip_file_is_refused(page, tmp_path, name):
    (tmp_path / "a.zip").write_bytes(AMBIGUOUS[name])
    with pytest.raises(RefusedError, match=r"^zip: [^\n]*$"):
        unpack(tmp_path / "a.zip", tmp_path / "into", ZipLimits(entries=250))
    assert not (tmp_path / "into").exists()
    if "name" not in name:  # refused before `zipfile` reads the directory
        with (tmp_path / "a.zip").open("rb") as file, pytest.raises(ValueError, match=r"."):
            check_directory(file, 250)
    answer = page.put("/api/photos/x/zip", content=AMBIGUOUS[name])
    assert answer.status_code in (400, 413) and answer.json()["error"].startswith("zip: ")


def test_a_zip_file_may_have_a_comment(tmp_path):
    (tmp_path / "a.zip").write_bytes(with_comment(PLAIN, b"holidays"))
    assert unpack(tmp_path / "a.zip", tmp_path / "into", ZipLimits())[0] == 2


@pytest.mark.parametrize("seed", range(8))
def test_zipfile_reads_as_many_entries_as_were_counted(tmp_path, seed):
    """A zip file with damaged end records of both kinds is refused, or `zipfile` reads as many entries as were
    counted."""
    draw, passed = random.Random(seed), 0
    for number in range(150):
        data = bytearray(wide(PLAIN) if number % 2 else with_comment(PLAIN, b"PK\5\6" + bytes(30)))
        for _ in range(draw.randint(0, 2)):
            data[draw.randrange(BEGIN, len(data))] = draw.choice(
                [0, 1, 2, 3, 0xFF, 0x50, draw.randrange(256)]
            )
        path = tmp_path / "a.zip"
        path.write_bytes(data)
        try:
            with path.open("rb") as file:
                check_directory(file, 10)
        except ValueError:
            continue
        with (
            contextlib.suppress(zipfile.BadZipFile, NotImplementedError, UnicodeDecodeError),
            zipfile.ZipFile(path) as archive,
        ):
            passed += 1
            assert len(archive.infolist()) == 2
    assert passed


@pytest.mark.parametrize("seed", range(400))
def test_damaged_zip_files_end_in_one_line(tmp_path, seed):
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
    assert TAIL == 65_557


def test_a_count_that_is_forgotten_meanwhile_is_still_a_number(studio, monkeypatch):
    """An upload counts the library while another request empties the trash, after which the count is forgotten."""
    studio.uploads.used()

    def now():
        studio.uploads.recount()
        return 0.0

    monkeypatch.setattr(uploads, "monotonic", now)
    assert studio.uploads.used(fresh=False) >= 0
