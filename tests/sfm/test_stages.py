"""The record of completed stages may come from somebody else, so a resumed run checks its facts before using them."""

import json

import pytest

from gsplat_edu.base.errors import DatasetError
from gsplat_edu.sfm.stages import Stages

GOOD = {
    "faces": {
        "summary": "",
        "panoramas": [{"name": "a.jpg", "faces": ["a_0.jpg", "a_1.jpg"], "place": None}],
    },
    "photos": {"summary": "", "names": ["a.jpg", "b/c.jpg"]},
    "features": {"summary": "", "few": ["a.jpg"]},
    "more features": {"summary": ""},
    "matches": {"summary": "", "connected": 3, "matched": 2, "kind": "likely"},
    "more matches": {"summary": "", "connected": 3, "matched": 2},
    "mapping": {"summary": "", "folder": "models/1/0", "names": ["a"], "doubtful": [], "unclear": []},
}


def stored(tmp_path, name, facts):
    path = tmp_path / "stages.json"
    path.write_text(json.dumps({"stages": {name: {"options": {}, "facts": facts}}}))
    return Stages(path, print)


@pytest.mark.parametrize("name", GOOD)
def test_facts_of_a_completed_stage_are_read(tmp_path, name):
    assert stored(tmp_path, name, GOOD[name]).finished(name, {}) == GOOD[name]


@pytest.mark.parametrize(
    ("name", "change"),
    [
        ("mapping", {"folder": "../../elsewhere"}),
        ("mapping", {"folder": "/etc"}),
        ("mapping", {"folder": "models/1/.."}),
        ("mapping", {"names": [3]}),
        ("mapping", {"summary": None}),
        ("faces", {"panoramas": [{"name": "a", "faces": ["../a.jpg"], "place": None}]}),
        ("faces", {"panoramas": [{"name": "a", "faces": ["b\\a.jpg"], "place": None}]}),
        ("faces", {"panoramas": [{"name": "a", "faces": [".."], "place": None}]}),
        ("faces", {"panoramas": [{"name": "a", "faces": ["\ud800.jpg"], "place": None}]}),
        ("faces", {"panoramas": [{"name": "a", "faces": [], "place": None}]}),
        ("faces", {"panoramas": [{"name": "a", "faces": ["a.jpg"], "place": [1.0, 2.0]}]}),
        ("photos", {"names": {"a": 1}}),
        ("features", {"few": 3}),
        ("matches", {"connected": "3"}),
        ("matches", {"connected": True}),
        ("matches", {"matched": -1}),
        ("more matches", {"matched": "3"}),
    ],
)
def test_facts_that_lead_elsewhere_or_have_another_type_are_refused(tmp_path, name, change):
    with pytest.raises(DatasetError, match=rf"stages\.{name}\.facts\b.+; remove"):
        stored(tmp_path, name, GOOD[name] | change).finished(name, {})


def test_photos_are_described_by_their_files_and_not_by_the_record(done):
    """The record has no paths of photos or masks, so a resumed run opens only files of the source."""
    stages = json.loads((done.out / "sfm" / "stages.json").read_text())["stages"]
    assert set(stages["photos"]["facts"]) == {"summary", "names", "unreadable", "seconds"}
