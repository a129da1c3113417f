"""360-degree images and videos say what they are, in the places where players look, and stay readable."""

import struct
import xml.etree.ElementTree as ElementTree

import cv2
import numpy as np
import pytest
from PIL import Image

from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.evaluate.images import write_frames
from gsplat_edu.evaluate.spherical import as_sphere, photo_sphere, sphere_boxes
from gsplat_edu.evaluate.video import streamable
from gsplat_edu.sfm.panoramas import are_panoramas

HEADERS = {
    "moov": 0,
    "trak": 0,
    "mdia": 0,
    "minf": 0,
    "stbl": 0,
    "stsd": 8,
    "vp09": 78,
    "sv3d": 0,
    "proj": 0,
}
"""Boxes that contain boxes, and the bytes of their own fields."""


def tree(data):
    """Read an MP4 file box by box; the boxes of a container have to fill it to the byte."""
    found, at = [], 0
    while at < len(data):
        length, kind = struct.unpack_from(">I4s", data, at)
        assert 8 <= length <= len(data) - at
        content, name = data[at + 8 : at + length], kind.decode("latin1")
        found.append((name, tree(content[HEADERS[name] :]) if name in HEADERS else content))
        at += length
    assert at == len(data)
    return found


def child(boxes, *names):
    for name in names:
        (boxes,) = [content for kind, content in boxes if kind == name]
    return boxes


def frames(count=5):
    rng = np.random.default_rng(0)
    return [
        cv2.GaussianBlur(rng.uniform(0, 255, (32, 64, 3)), (0, 0), 2).astype(np.uint8) for _ in range(count)
    ]


def decoded(path):
    video, found = cv2.VideoCapture(str(path)), []
    while (read := video.read())[0]:
        found.append(read[1])
    return np.stack(found)


@pytest.fixture
def both(tmp_path):
    return [write_frames(tmp_path / f"{s}.mp4", frames(), sphere=s)[0] for s in (False, True)]


def test_the_sample_entry_of_a_video_has_the_boxes_of_spherical_video_v2(both):
    plain, sphere = both
    way = ("moov", "trak", "mdia", "minf", "stbl", "stsd", "vp09")
    before, entry = (child(tree(path.read_bytes()), *way) for path in (plain, sphere))
    assert [kind for kind, _ in entry] == [*(kind for kind, _ in before), "st3d", "sv3d"]
    assert child(entry, "st3d") == bytes(5), "version, flags, and 0: not stereoscopic"
    assert [kind for kind, _ in child(entry, "sv3d")] == ["svhd", "proj"]
    program = child(entry, "sv3d", "svhd")
    assert program[:4] == bytes(4) and program[4:] == b"gsplat_edu\0"
    assert [kind for kind, _ in child(entry, "sv3d", "proj")] == ["prhd", "equi"]
    assert child(entry, "sv3d", "proj", "prhd") == bytes(4 + 3 * 4), "yaw, pitch and roll are 0"
    assert child(entry, "sv3d", "proj", "equi") == bytes(4 + 4 * 4), "nothing is cut off at any side"


def test_the_frames_of_a_video_stay_what_they_are(both):
    plain, sphere = both
    data, marked = (path.read_bytes() for path in both)
    assert len(marked) == len(data) + len(sphere_boxes()) and b"st3d" not in data
    assert np.array_equal(decoded(plain), decoded(sphere)) and len(decoded(plain)) == 5
    # the index is in front already, so that its growth alone moves the frames
    later = streamable(data, sphere=True)
    assert later == marked
    stbl = child(tree(marked), "moov", "trak", "mdia", "minf", "stbl")
    (offset,) = struct.unpack_from(">I", child(stbl, "stco"), 8)
    start = marked.index(b"mdat") + 4
    assert offset == start


def test_an_index_without_a_sample_entry_is_refused():
    def box(kind, content=b""):
        return struct.pack(">I4s", 8 + len(content), kind) + content

    for index in (box(b"moov"), box(b"moov", box(b"trak")), box(b"moov", b"\0\0\0\1trak")):
        with pytest.raises(ArgumentError, match="^video: its index has no"):
            as_sphere(index)
    inside = box(b"stsd", bytes(8) + 2 * box(b"vp09", bytes(78)))
    for kind in (b"stbl", b"minf", b"mdia", b"trak", b"moov"):
        inside = box(kind, inside)
    with pytest.raises(ArgumentError, match="has no single sample entry"):
        as_sphere(inside)


def test_a_png_says_that_it_is_a_whole_sphere(tmp_path):
    (path,) = write_frames(tmp_path / "all", frames(1), sphere=True)
    picture = Image.open(path)
    packet = picture.text["XML:com.adobe.xmp"]
    assert packet == photo_sphere(64, 32)
    (description,) = ElementTree.fromstring(packet).iter(
        "{http://www.w3.org/1999/02/22-rdf-syntax-ns#}Description"
    )
    names = "{http://ns.google.com/photos/1.0/panorama/}"
    told = {
        key.removeprefix(names): value for key, value in description.attrib.items() if key.startswith(names)
    }
    assert told == {
        "ProjectionType": "equirectangular",
        "UsePanoramaViewer": "True",
        "FullPanoWidthPixels": "64",
        "FullPanoHeightPixels": "32",
        "CroppedAreaImageWidthPixels": "64",
        "CroppedAreaImageHeightPixels": "32",
        "CroppedAreaLeftPixels": "0",
        "CroppedAreaTopPixels": "0",
    }
    assert np.array_equal(np.array(picture), frames(1)[0])
    (plain,) = write_frames(tmp_path / "plain", frames(1))
    assert not Image.open(plain).text
    # our own sfm takes the one for a panorama, the other for a photo
    assert are_panoramas([path], "auto", print) and not are_panoramas([plain], "auto", print)
