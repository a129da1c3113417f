"""The contents of a page's file, and reading it."""

import base64
import gzip
import hashlib
import json
import re
from dataclasses import replace
from html.parser import HTMLParser

import numpy as np
import pytest
import torch

from gsplat_edu.base.errors import ArgumentError, SceneFormatError
from gsplat_edu.io.scene import Scene
from gsplat_edu.render.settings import RenderSettings
from gsplat_edu.scene.camera import Camera, look_at
from gsplat_edu.scene.gaussians import Gaussians
from gsplat_edu.viewer import page, page_data
from gsplat_edu.viewer.page_start import first_camera, pivot_of, start_of
from scene_files import random_scene

NASTY = 'a </script><script>alert(1)</script> {{facts}} "&" äöü 兎 🐕'


class Elements(HTMLParser):
    """Collects the elements of a page with their attributes and texts, like a browser."""

    def __init__(self, document):
        super().__init__()
        self.found = []
        self.inside = []  # the texts of the open elements
        self.feed(document.decode("utf-8"))
        self.close()

    def handle_starttag(self, tag, attrs):
        self.found.append((tag, dict(attrs), []))
        self.inside.append(self.found[-1][2])

    def handle_endtag(self, tag):
        self.inside.append([])

    def handle_data(self, data):
        if self.inside:
            self.inside[-1].append(data)

    def texts(self, tag, **attributes):
        return [
            "".join(text)
            for name, given, text in self.found
            if name == tag and all(given.get(key) == value for key, value in attributes.items())
        ]


def facts_of(document):
    (text,) = Elements(document).texts("script", id="facts")
    return json.loads(text)


def test_the_same_scene_gives_the_same_bytes(tmp_path, random_gaussians, three_views):
    scene = Scene(random_gaussians(50), True, (0.0, 0.0, 1.0))
    page.write(tmp_path / "new" / "a.html", scene, three_views)
    page.write(tmp_path / "a.html", Scene(random_gaussians(50), True, (0.0, 0.0, 1.0)), three_views)
    assert (tmp_path / "new" / "a.html").read_bytes() == (tmp_path / "a.html").read_bytes()
    assert page.html(scene, three_views) == page.html(scene, three_views)


@pytest.mark.parametrize("count", [0, 1, 9])
@pytest.mark.parametrize("rest", [0, 3, 8, 15])
def test_a_scene_is_read_back_within_its_quantization(tmp_path, random_gaussians, count, rest):
    gaussians = random_gaussians(count, rest)
    page.write(tmp_path / "a.html", Scene(gaussians, None, None))
    scene = page.read(tmp_path / "a.html")
    assert (scene.antialiased, scene.up) == (None, None)
    given, found = gaussians.tensors(), scene.gaussians.tensors()
    assert all(tensor.dtype == torch.float32 and tensor.is_contiguous() for tensor in found.values())
    for name in ("means", "log_scales"):
        assert torch.equal(given[name], found[name])
    unit = given["quats"] / given["quats"].norm(dim=1, keepdim=True)
    # half a step of 1/32767, plus the float32 rounding of numbers up to 1
    np.testing.assert_allclose(found["quats"], unit, rtol=0, atol=0.5 / 32767 + 2e-7)
    for name in ("sh0", "sh_rest", "logit_opacities"):
        # Half floats have 11 bits, so half a step is 2^-11 of the number, or 2^-25 below 2^-14.
        np.testing.assert_allclose(found[name], given[name], rtol=2**-11, atol=2**-25)


@pytest.mark.parametrize("antialiased", [None, False, True])
@pytest.mark.parametrize("up", [None, (0.6, 0.0, -0.8)])
def test_other_facts_of_the_scene_are_read_back(tmp_path, random_gaussians, antialiased, up):
    page.write(tmp_path / "a.html", Scene(random_gaussians(2), antialiased, up))
    scene = page.read(tmp_path / "a.html")
    assert (scene.antialiased, scene.up) == (antialiased, up)


def test_omitted_settings_are_those_of_a_scene_file(random_gaussians):
    facts = facts_of(page.html(Scene(random_gaussians(2), True)))
    assert facts["settings"] == {
        "background": [0, 0, 0],
        "sh_degree": 3,
        "antialiased": True,
        "jacobian_limit": 1.3,
        "beyond": None,
    }
    chosen = RenderSettings(background=(1.0, 0.5, 0.0), sh_degree=2, jacobian_limit=None)
    facts = facts_of(page.html(Scene(random_gaussians(2), True), settings=chosen))
    assert facts["settings"] == {
        "background": [1, 0.5, 0],
        "sh_degree": 2,
        "antialiased": False,
        "jacobian_limit": None,
        "beyond": None,
    }


def test_numbers_outside_the_range_of_16_bits(tmp_path):
    gaussians = Gaussians(
        means=torch.tensor([[1e39, -1e39, 0.0], [1.0, 2.0, 3.0]], dtype=torch.float64),
        quats=torch.tensor([[0.0, 0, 0, 0], [1e-300, 1e-300, 0, 0]], dtype=torch.float64),
        log_scales=torch.zeros(2, 3, dtype=torch.float64),
        sh0=torch.full((2, 1, 3), 1e6, dtype=torch.float64),
        sh_rest=torch.zeros(2, 0, 3, dtype=torch.float64),
        logit_opacities=torch.tensor([1e9, -1e9], dtype=torch.float64),
    ).trainable()
    page.write(tmp_path / "a.html", Scene(gaussians))
    found = page.read(tmp_path / "a.html").gaussians
    assert torch.equal(found.quats[0], torch.zeros(4)), (
        "the page does not draw a splat without a rotation, as the kernels do not"
    )
    # half a step of 1/32767 of a component
    np.testing.assert_allclose(found.quats[1], [0.5**0.5, 0.5**0.5, 0, 0], atol=0.5 / 32767 + 2e-7)
    assert found.logit_opacities.tolist() == [65504, -65504] and float(found.sh0.max()) == 65504
    assert float(found.means.abs().max()) == np.finfo(np.float32).max


def test_nonfinite_gaussians_are_refused(tmp_path, random_gaussians):
    gaussians = random_gaussians(3)
    gaussians.means[1, 2] = float("nan")
    with pytest.raises(ArgumentError, match="means"):
        page.write(tmp_path / "a.html", Scene(gaussians))
    assert list(tmp_path.iterdir()) == []


def test_names_are_only_text(tmp_path, random_gaussians, camera):
    document = page.html(Scene(random_gaussians(3)), [(NASTY, camera)], title=NASTY)
    elements = Elements(document)
    plain = Elements(page.html(Scene(random_gaussians(3)), [("a", camera)], title="a"))
    assert [tag for tag, *_ in elements.found] == [tag for tag, *_ in plain.found]
    assert elements.texts("title") == [NASTY]
    facts = facts_of(document)
    assert (facts["title"], facts["cameras"][0]["name"]) == (NASTY, NASTY)
    (tmp_path / "a.html").write_bytes(document)
    assert len(page.read(tmp_path / "a.html").gaussians) == 3


def test_a_title_with_undecodable_bytes(random_gaussians):
    # a file name with invalid bytes, as Python decodes it
    document = page.html(Scene(random_gaussians(3)), title="a\udcff")
    assert Elements(document).texts("title") == ["a?"]


def test_no_empty_controls_are_shown_while_the_scene_is_unpacked(random_gaussians):
    html = page.html(Scene(random_gaussians(3))).decode()
    assert '<div id="tools" hidden>' in html and '<button id="fold" aria-expanded="false"' in html


def test_nothing_is_fetched_from_elsewhere(random_gaussians, three_views):
    document = page.html(Scene(random_gaussians(3)), three_views)
    elements = Elements(document)
    for _, attributes, _ in elements.found:
        assert not {"src", "srcset", "action", "data"} & set(attributes)
        assert attributes.get("href", "#").startswith("#")  # an icon of the page
    text = document.decode().replace("http://www.w3.org/2000/svg", "")  # a name, no address
    assert not re.search(r"https?:|//[a-z]+\.|@import|url\(|import\(|fetch\(|eval\(|innerHTML", text)
    (policy,) = [
        attributes["content"]
        for tag, attributes, _ in elements.found
        if attributes.get("http-equiv") == "Content-Security-Policy"
    ]
    rules = dict(rule.strip().split(" ", 1) for rule in policy.split(";"))
    assert (rules["default-src"], rules["worker-src"]) == ("'none'", "blob:")

    def hashes(texts):
        digests = [hashlib.sha256(text.encode()).digest() for text in texts]
        return [f"'sha256-{base64.b64encode(digest).decode()}'" for digest in digests]

    assert rules["script-src"].split() == hashes(elements.texts("script", type=None))
    assert rules["style-src"].split() == hashes(elements.texts("style"))


def test_splats_are_split_into_pieces_that_read_joins(tmp_path, monkeypatch, random_gaussians):
    monkeypatch.setattr(page, "PIECE", 300)
    gaussians = random_gaussians(20)
    page.write(tmp_path / "a.html", Scene(gaussians))
    pieces = Elements((tmp_path / "a.html").read_bytes()).texts("script", **{"class": "splats"})
    assert len(pieces) > 5
    joined = gzip.decompress(b"".join(base64.b64decode(piece.strip()) for piece in pieces))
    assert len(joined) == page_data.size(20, 3)
    assert torch.equal(page.read(tmp_path / "a.html").gaussians.means, gaussians.means)


def refused(path):
    with pytest.raises(SceneFormatError) as caught:
        page.read(path)
    message = str(caught.value)
    assert message.startswith(f"{path}: ") and "\n" not in message
    return message


@pytest.fixture
def whole(random_gaussians):
    return page.html(Scene(random_gaussians(9)))


def test_every_truncation_is_reported(tmp_path, whole):
    path = tmp_path / "a.html"
    splats = whole.index(page.SPLATS_OPEN)
    last = whole.index(page.CLOSE, splats)
    for length in [*range(0, splats, 997), *range(splats, last, 41), last - 4, last - 1]:
        path.write_bytes(whole[:length])
        refused(path)


def test_every_changed_byte_of_the_splats_is_reported(tmp_path, whole):
    path = tmp_path / "a.html"
    begin = whole.index(page.SPLATS_OPEN) + len(page.SPLATS_OPEN)
    end = whole.index(page.CLOSE, begin)
    # only the first 4 of the 10 bytes of a gzip header affect the contents
    for at in [0, 3, *range(20, end - begin - 3, 13)]:
        changed = bytearray(whole)
        changed[begin + at] = ord("A") if changed[begin + at] != ord("A") else ord("B")
        path.write_bytes(changed)
        assert "splats are" in refused(path)


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        (b'<script type="application/json" id="facts">', b"<p>", "is not a page of this package"),
        (b'"format":"gsplat-edu page"', b'"format":"another page"', "the metadata is damaged"),
        (b'"format":"gsplat-edu page"', b'"format"', "the metadata is damaged"),
        (b'{"format"', b"[" * 100_000, "the metadata is damaged"),
        (b'"version":1', b'"version":7', "has page version 7"),
        (b'"count":9', b'"count":-9', "metadata 'count' is missing or invalid"),
        (b'"count":9', b'"count":true', "metadata 'count' is missing or invalid"),
        (b'"count":9', b'"number":9', "metadata 'count' is missing or invalid"),
        (b'"count":9', b'"count":8', "splats are truncated or damaged"),
        (b'"count":9', b'"count":10', "splats are truncated or damaged"),
        (b'"count":9', b'"count":9000000000', "claims to hold"),
        (b'"count":9', b'"count":' + b"9" * 5000, "the metadata is damaged"),
        (b'"sh_degree":3', b'"sh_degree":4', "metadata 'sh_degree' is missing or invalid"),
        (b'"antialiased":null', b'"antialiased":1', "metadata 'antialiased' is missing or invalid"),
        (b'"up":null', b'"up":[0,0,0]', "metadata 'up' is missing or invalid"),
        (b'"up":null', b'"up":[0,0,NaN]', "metadata 'up' is missing or invalid"),
        (b'"up":null', b'"up":[0,0,1' + b"0" * 400 + b"]", "metadata 'up' is missing or invalid"),
    ],
)
def test_damage_is_named(tmp_path, whole, old, new, says):
    path = tmp_path / "a.html"
    assert old in whole
    path.write_bytes(whole.replace(old, new, 1))
    assert says in refused(path)


def test_files_that_are_not_pages_are_refused(tmp_path):
    path = tmp_path / "a.html"
    for content in (b"", b"<!DOCTYPE html><p>hello</p>", bytes(range(256)) * 40):
        path.write_bytes(content)
        assert "is not a page of this package" in refused(path)
    path.write_bytes(b"version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 1\n")
    assert "is a Git LFS pointer" in refused(path)
    with pytest.raises(FileNotFoundError):
        page.read(tmp_path / "none.html")


def test_nonfinite_splats_are_counted(tmp_path, whole):
    begin = whole.index(page.SPLATS_OPEN) + len(page.SPLATS_OPEN)
    end = whole.index(page.CLOSE, begin)
    data = bytearray(gzip.decompress(base64.b64decode(whole[begin:end])))
    data[12:16] = np.float32(np.nan).tobytes()
    path = tmp_path / "a.html"
    path.write_bytes(whole[:begin] + base64.b64encode(gzip.compress(data)) + whole[end:])
    assert "1 splats have NaN or infinite values" in refused(path)


def test_a_decompression_bomb_is_refused(tmp_path, whole):
    begin = whole.index(page.SPLATS_OPEN) + len(page.SPLATS_OPEN)
    end = whole.index(page.CLOSE, begin)
    path = tmp_path / "a.html"
    path.write_bytes(whole[:begin] + base64.b64encode(gzip.compress(bytes(50_000_000))) + whole[end:])
    assert "splats are truncated or damaged" in refused(path)


@pytest.mark.parametrize("gaussians", [0, 1, 40])
@pytest.mark.parametrize("up", [None, (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)])
def test_the_start_view_faces_the_scene_with_up_upwards(random_gaussians, gaussians, up):
    start = facts_of(page.html(Scene(random_gaussians(gaussians), up=up)))["start"]
    assert start["up"] == list(up or (0, -1, 0))
    R, eye = np.array(start["camera"]["R"]), np.array(start["camera"]["eye"])
    if gaussians:
        assert -R[1] @ start["up"] > 0.9  # the orbit is 15 degrees above the horizon
    x, y, z = R @ (np.array(start["pivot"]) - eye)
    assert z > 0 and abs(x) < 1e-6 * z and abs(y) < 1e-6 * z


def test_the_start_is_the_first_camera(random_gaussians, three_views, camera):
    facts = facts_of(page.html(Scene(random_gaussians(30)), three_views))
    first = {k: v for k, v in facts["cameras"][0].items() if k not in ("name", "held_out")}
    assert facts["start"]["camera"] == first and facts["start"]["index"] == 0
    assert facts["start"]["camera"]["eye"] == camera.eye.tolist()
    assert [one["name"] for one in facts["cameras"]] == [name for name, _ in three_views]
    # the points that the cameras look at are at most 0.1 apart
    assert np.abs(facts["start"]["pivot"]).max() < 0.2


def test_the_start_is_the_first_camera_that_was_trained_on(random_gaussians, three_views):
    facts = facts_of(page.html(Scene(random_gaussians(3)), three_views, held_out={"first", "third <b>"}))
    assert [one["held_out"] for one in facts["cameras"]] == [True, False, True]
    assert facts["start"]["index"] == 1 and facts["start"]["camera"]["eye"] == facts["cameras"][1]["eye"]
    everything = {name for name, _ in three_views}
    assert (
        facts_of(page.html(Scene(random_gaussians(3)), three_views, held_out=everything))["start"]["index"]
        == 0
    )
    assert facts_of(page.html(Scene(random_gaussians(3))))["start"]["index"] == -1


def facing_one_way(turn):
    """Return cameras side by side, each rotated by `turn` relative to the last; their axes cross anywhere, or behind
    them."""
    cameras = []
    for i in range(-4, 5):
        eye = np.array([0.3 * i, 0.02 * (-1) ** i, 0.0])
        ahead = np.array([np.sin(turn * i), 0.0, np.cos(turn * i)])
        cameras.append(Camera(look_at(eye, eye + ahead), eye, 200.0, 200.0, 80.0, 60.0, 120, 160))
    return cameras


@pytest.mark.parametrize("turn", [0.0, 0.001, 0.05, -0.05, 0.2])
def test_if_cameras_face_one_way_the_pivot_is_on_a_visible_surface(turn):
    """The point where their axes cross, 6 ahead, behind them, or nowhere, is not a good pivot."""
    generator = np.random.default_rng(0)
    points = generator.uniform((-30, -30, 9.5), (30, 30, 10.5), (4000, 3))
    cameras = facing_one_way(turn)
    pivot = pivot_of(cameras, 4, points)
    np.testing.assert_allclose(pivot[:2], cameras[4].eye[:2], atol=1e-9)
    if turn == -0.05:  # their axes do meet 6 ahead, so both pivots are good
        assert 5 < pivot[2] < 10.6
    else:
        assert 9.5 < pivot[2] < 10.5


def test_if_cameras_surround_something_the_pivot_is_its_centre():
    angles = np.linspace(0, 2 * np.pi, 12, endpoint=False)
    eyes = [np.array([3 * np.cos(a), -1.0, 3 * np.sin(a)]) for a in angles]
    cameras = [Camera(look_at(eye, (0, 0, 0)), eye, 200.0, 200.0, 80.0, 60.0, 120, 160) for eye in eyes]
    cameras[3] = Camera(look_at(eyes[3], (9, 0, 9)), eyes[3], 200.0, 200.0, 80.0, 60.0, 120, 160)
    surface = np.random.default_rng(0).normal(size=(900, 3))
    surface /= np.linalg.norm(surface, axis=1, keepdims=True)
    # one camera looks away, and the surface is nearer than the centre
    np.testing.assert_allclose(pivot_of(cameras, 0, surface), 0, atol=1e-6)
    assert pivot_of(cameras[:1], 0, np.zeros((0, 3))) @ cameras[0].R[2] > cameras[0].eye @ cameras[0].R[2]


def test_a_flight_or_an_arc_starts_in_the_middle_and_a_ring_at_its_first_camera():
    """A page of 164 aerial photos used to start at a corner of the fields, with half an empty window."""
    down = np.diag([1.0, -1.0, -1.0])  # from z = 10 along -z
    flight = [
        Camera(down, np.array([x, y, 10.0]), 80, 80, 40, 30, 60, 80) for y in range(5) for x in range(7)
    ]
    everywhere = range(len(flight))
    assert first_camera(flight, everywhere) == 17, "camera in row 2 of 5, column 3 of 7"
    assert first_camera(flight, [i for i in everywhere if i != 17]) in (10, 16, 18, 24), (
        "camera 17 is held out"
    )
    assert first_camera(flight[17:] + flight[:17], everywhere) == 0, (
        "the first camera of a ring is as good as any"
    )
    assert first_camera(flight[:1], [0]) == 0
    for turn, chosen in ((np.radians(90), 5), (np.radians(330), 1)):
        around = [
            Camera.looking_at((4 * np.cos(a), -1, 4 * np.sin(a)), (0, 0, 0), 80, 80, 60, 80)
            for a in np.linspace(0, turn, 12)
        ]
        assert first_camera(around, range(1, 12)) in (chosen, 11 - chosen if chosen == 5 else chosen)


def test_a_page_opens_on_the_scene_and_not_on_its_sky():
    """Cameras face one way, to a wall of few splats under a sky of many."""
    cameras = [Camera.looking_at((x, 0.0, 0.0), (x, 0.0, 5.0), 50, 50, 60, 60) for x in (-0.2, 0.0, 0.2)]
    rng = np.random.default_rng(0)
    wall = np.c_[rng.uniform(-3, 3, (900, 2)), np.full(900, 5.0)]
    sky = rng.normal(size=(800, 3))
    sky = np.c_[0.2 * sky[:, :2], 1 + abs(sky[:, 2])]  # the wall is near the middle of the image
    sky = 300 * sky / np.linalg.norm(sky, axis=1, keepdims=True)
    starts = []
    for means in (wall, np.concatenate([wall, sky])):
        gaussians = random_scene(len(means), rest=0).gaussians
        gaussians = replace(
            gaussians,
            means=torch.tensor(means, dtype=torch.float32),
            logit_opacities=torch.ones(len(means)),
        )
        starts.append(start_of(Scene(gaussians, False, (0.0, -1.0, 0.0)), cameras, 1))
    np.testing.assert_allclose(starts[0].pivot, (0, 0, 5), atol=1e-6)
    np.testing.assert_allclose(starts[1].pivot, starts[0].pivot)
