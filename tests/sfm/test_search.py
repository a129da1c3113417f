"""Photos are searched for features as coarsely as still finds enough of them."""

import sqlite3
from contextlib import closing

import pytest

from gsplat_edu.sfm.colmap import COLMAP_SEED, call
from gsplat_edu.sfm.search import COARSE, FEWEST_PROBED, FINEST, POOR, PROBED, find_features

MANY = 2 * FEWEST_PROBED


class Detector:
    def __init__(self, database):
        self.database, self.calls = database, []

    def find(self, counts, *, photos=MANY, poor=()):
        """Find features in photos of two cameras.

        Args:
            counts: Features per photo that each search of `COARSE` finds; the finest finds 5000.
            photos: Number of photos.
            poor: Photos in which coarse searches find less than `POOR`.
        """
        groups = [
            {"names": [f"{i:03d}.jpg" for i in range(photos) if i % 2 == half], "width": 8 + half}
            for half in (0, 1)
        ]

        def found(groups, sift, into):
            names = [name for group in groups for name in group["names"]]
            self.calls.append((sift, len(names), into.name))
            into.touch()
            by_search = [one.sift for one in COARSE]
            count = 5000 if sift == FINEST else counts[by_search.index(sift)]
            return {name: POOR - 1 if name in poor and sift != FINEST else count for name in names}

        return find_features(found, groups, self.database)


def test_detailed_photos_are_searched_in_their_own_size(tmp_path):
    (tmp_path / "probe.db-wal").write_bytes(b"of a run that was interrupted")
    detector = Detector(tmp_path / "database.db")
    assert set(detector.find([COARSE[0].enough, 9000]).values()) == {COARSE[0].enough}
    assert detector.calls == [(COARSE[0].sift, PROBED, "probe.db"), (COARSE[0].sift, MANY, "database.db")]
    assert [path.name for path in tmp_path.iterdir()] == ["database.db"], "the trial's database is removed"


@pytest.mark.parametrize(
    ("counts", "chosen"),
    [
        ([COARSE[0].enough - 1, COARSE[1].enough], COARSE[1].sift),
        ([COARSE[0].enough - 1, COARSE[1].enough - 1], FINEST),
    ],
)
def test_photos_with_less_detail_are_searched_more_finely(tmp_path, counts, chosen):
    detector = Detector(tmp_path / "database.db")
    assert len(detector.find(counts)) == MANY
    assert detector.calls[-1] == (chosen, MANY, "database.db")
    assert [sift for sift, _, _ in detector.calls[:-1]] == [one.sift for one in COARSE]


def test_few_photos_are_searched_as_finely_as_possible(tmp_path):
    detector = Detector(tmp_path / "database.db")
    detector.find([9000, 9000], photos=FEWEST_PROBED - 1)
    assert detector.calls == [(FINEST, FEWEST_PROBED - 1, "database.db")]


def test_poor_photos_are_searched_again(tmp_path):
    """Only their features are removed, so that the detector, which skips photos with features, finds theirs anew."""
    database = tmp_path / "database.db"
    with closing(sqlite3.connect(database)) as writer, writer:
        writer.execute("CREATE TABLE images (image_id INTEGER, name TEXT)")
        for table in ("keypoints", "descriptors"):
            writer.execute(f"CREATE TABLE {table} (image_id INTEGER)")
            writer.executemany(f"INSERT INTO {table} VALUES (?)", [(i,) for i in range(MANY)])
        writer.executemany("INSERT INTO images VALUES (?, ?)", [(i, f"{i:03d}.jpg") for i in range(MANY)])
    detector = Detector(database)
    found = detector.find([9000, 9000], poor=("003.jpg", "010.jpg"))
    assert detector.calls[-1] == (FINEST, MANY, "database.db")
    assert found["003.jpg"] == 5000
    with closing(sqlite3.connect(database)) as reader:
        for table in ("keypoints", "descriptors"):
            left = {image for (image,) in reader.execute(f"SELECT image_id FROM {table}")}
            assert left == set(range(MANY)) - {3, 10}


def test_a_coarser_search_finds_fewer_features(done, tmp_path):
    photos = done.out / "sfm" / "photos"
    names = sorted(path.name for path in photos.iterdir())[:2]
    groups = [{"names": names, "width": 320, "height": 240, "focal": None}]
    found = [
        call(
            "features",
            tmp_path / "log.txt",
            database=str(tmp_path / f"{number}.db"),
            photos=str(photos),
            masks="",
            groups=groups,
            sift={"max_num_features": 8192, **sift},
            threads=1,
            seed=COLMAP_SEED,
        )["features"]
        for number, sift in enumerate((COARSE[0].sift, COARSE[1].sift, FINEST))
    ]
    assert all(0 < found[0][name] <= found[1][name] < found[2][name] for name in names), found
