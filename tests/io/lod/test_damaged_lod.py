"""Each damaged streamed SOG is refused in one clear line."""

import json
import shutil

import pytest

from gsplat_edu.base.errors import SceneFormatError
from gsplat_edu.io.formats import read_scene
from gsplat_edu.io.lod import codec
from gsplat_edu.io.lod.levels import LodOptions
from scene_files import random_scene


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    path = tmp_path_factory.mktemp("lod") / "whole" / "lod-meta.json"
    codec.write(path, random_scene(120, 0), LodOptions(smallest=40, chunk=60, leaf=30))
    return path


@pytest.fixture
def copy(whole, tmp_path):
    shutil.copytree(whole.parent, tmp_path / "copy")
    return tmp_path / "copy" / "lod-meta.json"


def refused(path):
    with pytest.raises(SceneFormatError) as caught:
        read_scene(path)
    message = str(caught.value)
    assert message.startswith(str(path)) and "\n" not in message and len(message) < 400
    return message


def first_leaf(meta):
    node = meta["tree"]
    while "children" in node:
        node = node["children"][0]
    return node


def _leaf(change):
    return lambda meta: change(first_leaf(meta))


def _deep(meta):
    for _ in range(70):
        meta["tree"] = {"bound": meta["tree"]["bound"], "children": [meta["tree"], meta["tree"]]}
        meta["tree"]["children"][1] = first_leaf(meta)


def _set(key, value):
    return lambda meta: meta.update({key: value})


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        (_set("version", 2), "of another version than 1"),
        (_set("version", True), "of another version than 1"),
        (_set("lodLevels", 0), "but has to be a whole number, at least 1 and at most 64"),
        (_set("lodLevels", 10**9), "but has to be a whole number, at least 1 and at most 64"),
        (_set("lodLevels", 1), "a level outside 0 to 0"),
        (_set("filenames", "0_0/meta.json"), 'filenames: is "0_0/meta.json", but has to be a list'),
        (lambda meta: meta["filenames"].append(meta["filenames"][0]), "names a file twice"),
        *(
            (_set("filenames", [name]), "but has to be FOLDER/meta.json below its own folder")
            for name in (
                "meta.json",
                "../meta.json",
                "a/../b/meta.json",
                "/etc/meta.json",
                "C:/meta.json",
                "a\\b/meta.json",
                "//meta.json",
                "a/passwd",
                "http://x/meta.json",
                "x/" * 9 + "meta.json",
                ".a/meta.json",
            )
        ),
        (_set("filenames", [7]), "filenames[0]: is 7, but has to be text"),
        (_set("environment", "../meta.json"), "below its own folder"),
        (_set("tree", None), "node: is null, but has to be an object"),
        (_set("tree", {"bound": {}}), "neither or both of children and lods"),
        (_set("tree", {"children": [{}, {}], "lods": {}}), "neither or both"),
        (_set("tree", {"children": [{}]}), "but has to have 2 entries"),
        (_set("tree", {"children": [{}, {}, {}]}), "but has to have 2 entries"),
        (_deep, "more than 64 nodes deep"),
        (_leaf(lambda leaf: leaf.pop("bound")), "node.bound: is null, but has to be an object"),
        (_leaf(lambda leaf: leaf["bound"].update(min=[0, 0])), "min: is [0, 0], but has to have 3 entries"),
        (_leaf(lambda leaf: leaf["bound"].update(min=[0, 1e400, 0])), "is not JSON"),
        (
            _leaf(lambda leaf: leaf["bound"].update(min=[0, True, 0])),
            "min[1]: is true, but has to be a number",
        ),
        (_leaf(lambda leaf: leaf["bound"].update(min=[99, 0, 0])), "inside out"),
        (_leaf(lambda leaf: leaf["lods"].update({"01": leaf["lods"]["0"]})), "a level outside"),
        (_leaf(lambda leaf: leaf["lods"]["0"].update(file=99)), "lods.0.file: is 99, but there are "),
        (_leaf(lambda leaf: leaf["lods"]["0"].update(file=-1)), "node.lods.0.file: is -1, but"),
        (_leaf(lambda leaf: leaf["lods"]["0"].update(offset=-1)), "lods.0.offset: is -1, but"),
        (_leaf(lambda leaf: leaf["lods"]["0"].update(count=10**18)), "lods.0.count: is "),
        (_leaf(lambda leaf: leaf["lods"]["0"].update(count=1)), "overlap or leave a gap"),
        (_leaf(lambda leaf: leaf["lods"]["0"].update(offset=1)), "overlap or leave a gap"),
        (_leaf(lambda leaf: leaf["lods"].update({"1": leaf["lods"]["0"]})), "splats of two levels in 0_0"),
        (_set("counts", [1, 2]), "counts: differ"),
        (_set("count", 5), "counts: differ"),
    ],
)
def test_an_invalid_index_is_named(copy, change, expected):
    meta = json.loads(copy.read_bytes())
    change(meta)
    copy.write_text(json.dumps(meta), encoding="utf-8")
    assert expected in refused(copy)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (b"", "is not JSON"),
        (b"[1]", "is [1], but has to be an object"),
        (b"{}", "lodLevels"),
        (b'{"tree":' * 100_000, "nested too deeply"),
        (b" " * ((32 << 20) + 1), "too many for the index"),
        (b"version https://git-lfs.github.com/spec/v1\n", "git lfs pull"),
    ],
)
def test_an_unreadable_index_is_refused(copy, text, expected):
    copy.write_bytes(text)
    assert expected in refused(copy)


def test_missing_and_changed_files_are_named(copy):
    file = copy.parent / "0_1" / "meta.json"
    meta = file.read_bytes()
    file.unlink()
    assert "0_1/meta.json is missing" in refused(copy)
    file.write_bytes(meta.replace(b'"count":60', b'"count":59'))
    assert "0_1/meta.json: holds 59 splats, where the index has 60" in refused(copy)
    file.write_bytes(meta[:-5])
    assert "is not JSON" in refused(copy)
    file.write_bytes(meta)
    (copy.parent / "0_1" / "quats.webp").unlink()
    assert "quats.webp is missing" in refused(copy)


def test_coarser_levels_may_be_missing(copy):
    """Reading needs the finest level only."""
    shutil.rmtree(copy.parent / "1_0")
    assert len(read_scene(copy).gaussians) == 120


def test_errors_of_other_programs_are_optional(copy):
    for errors in (None, "x", [0], [0, -1, 2], [0, "1", 2]):
        meta = json.loads(copy.read_bytes())
        first_leaf(meta)["errors"] = errors
        copy.write_text(json.dumps(meta), encoding="utf-8")
        assert codec.read_index(copy).regions[0].errors == ()
