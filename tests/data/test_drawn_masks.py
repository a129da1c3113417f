"""Shapes drawn on a photo's mask exclude their pixels for every reader; undo restores each file to the byte."""

import errno
import json

import numpy as np
import pytest
from PIL import Image

from gsplat_edu import Camera
from gsplat_edu.base.errors import DatasetError
from gsplat_edu.cli.main import main
from gsplat_edu.data import drawn_masks
from gsplat_edu.data.dataset import DataSettings, load_dataset
from gsplat_edu.data.drawn_masks import DRAWN, draw_mask, read_drawings
from gsplat_edu.data.mask_shapes import BrushStroke, covered, parse_shape, shape_text
from gsplat_edu.data.writers import write_colmap, write_transforms
from gsplat_edu.scene.views import View

W, H = 24, 16


def views(names, w=W, h=W):
    rng = np.random.default_rng(1)
    for i, name in enumerate(names):
        camera = Camera.looking_at(eye=(0.3 * i, 0, -3), target=(0, 0, 0), fx=30, fy=30, H=h, W=w)
        yield View(camera, rng.integers(0, 255, (h, w, 3), np.uint8), name=name)


POINTS = np.random.default_rng(0).normal(size=(50, 3)) * 0.2


def colmap(folder, names, w=W, h=W):
    write_colmap(folder, list(views(names, w, h)), POINTS, np.full((50, 3), 0.5))
    return folder


def tree(folder):
    """Bytes of all files below a folder, and its folders."""
    return {str(p.relative_to(folder)): p.read_bytes() if p.is_file() else None for p in folder.rglob("*")}


def excluded(capture, name):
    """Pixels of a photo that do not count; None without a mask."""
    dataset = load_dataset(capture, DataSettings(test_every=0))
    view = next(view for view in dataset.train if view.name.endswith(name))
    mask = view.read().mask
    return None if mask is None else ~mask


@pytest.fixture
def capture(tmp_path):
    return colmap(tmp_path / "capture", [f"left/{i:02d}.png" for i in range(4)] + ["right/00.png"])


def test_a_rectangle_covers_its_pixels_and_a_polygon_its_inside():
    rectangle = covered([parse_shape("6,2,2,5")], W, H)
    assert rectangle.sum() == 12 and rectangle[2:5, 2:6].all()
    triangle = covered([parse_shape("0,0,20,0,0,15")], W, H)
    assert triangle[2, 2] and not triangle[14, 20] and 0.3 < triangle.mean() < 0.6
    assert covered([parse_shape("20,10,99,99")], W, H)[10:, 20:].all()


def near(stroke, w=W, h=H):
    """Pixels whose centres are within the radius of the stroke's way, by the distance to each part."""
    y, x = np.mgrid[:h, :w] + 0.5
    points = np.array(stroke.points, float).reshape(-1, 2)
    found = np.zeros((h, w), bool)
    for (ax, ay), (bx, by) in zip(points, [*points[1:], points[-1]], strict=True):
        dx, dy = bx - ax, by - ay
        t = np.clip(((x - ax) * dx + (y - ay) * dy) / max(dx * dx + dy * dy, 1.0), 0, 1)
        found |= (x - ax - t * dx) ** 2 + (y - ay - t * dy) ** 2 <= stroke.radius**2
    return found


@pytest.mark.parametrize(
    ("text", "pixels"),
    [
        ("brush:3,10,8", 32),  # a tap
        ("brush:2,3,3,20,12,4,13", None),
        ("brush:2,5,5,5,5,5,5", 12),  # without a length
        ("brush:4,-20,6,40,9", None),  # from one side of the photo to the other
        ("brush:5,-3,-3", None),
        ("brush:2,-50,-50,-40,-45", 0),
        ("brush:100000,10,8", W * H),
        ("brush:100000,100000,8", W * H),
        ("brush:1,100000,-99990,-100000,99995", None),
    ],
)
def test_a_stroke_covers_what_is_within_its_radius(text, pixels):
    stroke = parse_shape(text)
    assert isinstance(stroke, BrushStroke) and shape_text(stroke) == text
    found = covered([stroke], W, H)
    assert np.array_equal(found, near(stroke))
    assert pixels is None or found.sum() == pixels


def test_random_strokes_cover_what_is_within_their_radius():
    rng = np.random.default_rng(4)
    for _ in range(40):
        points = rng.integers(-20, 60, 2 * rng.integers(1, 8))
        stroke = BrushStroke(int(rng.integers(1, 15)), tuple(points.tolist()))
        assert np.array_equal(covered([stroke], 40, 30), near(stroke, 40, 30)), stroke


def test_a_long_stroke_is_one_shape_among_others():
    """2000 points, a radius larger than the photo, and a rectangle beside it that stays."""
    points = tuple(np.random.default_rng(2).integers(0, 200, 4000).tolist())
    assert covered([BrushStroke(50, points)], 200, 150).all()
    both = covered([(0, 0, 2, 2), BrushStroke(1, (10, 10))], W, H)
    assert both[:2, :2].all() and both.sum() == 4 + 4


def test_strokes_are_kept_and_taken_back_to_the_byte(capture, capsys):
    before = tree(capture)
    words = ["mask", str(capture), "01.png", "brush:3,-5,4,12,4", "0,20,4,24", "brush:2,20,20"]
    assert main(words) == 0
    assert capsys.readouterr().out.split("\n")[1:4] == words[3:]
    first = tree(capture)
    assert main(["mask", str(capture), "01.png"]) == 0
    assert capsys.readouterr().out.split("\n")[1:4] == words[3:]
    hidden = excluded(capture, "01.png")
    assert np.array_equal(hidden, covered([parse_shape(one) for one in words[3:]], W, W))
    assert main([*words[:3], "brush:1,2,2"]) == 0 and tree(capture) != first
    assert main(words) == 0
    assert tree(capture) == first  # the same shapes, the same bytes
    assert main([*words[:3], "--undo"]) == 0
    assert tree(capture) == before


def test_a_photo_without_a_mask_gets_one_and_loses_it_again(capture, capsys):
    before = tree(capture)
    assert main(["mask", str(capture), "images/left/00.png", "2,3,10,9"]) == 0
    assert "1 shape; mask" in capsys.readouterr().out
    assert (capture / "masks/left/00.png.png").is_file()
    hidden = excluded(capture, "left/00.png")
    assert hidden[3:9, 2:10].all() and hidden.sum() == 48
    assert excluded(capture, "right/00.png") is None and excluded(capture, "left/01.png") is None
    # further shapes replace those drawn before
    assert main(["mask", str(capture), "left/00.png", "0,0,2,2", "20,20,24,24"]) == 0
    assert excluded(capture, "left/00.png").sum() == 20
    capsys.readouterr()
    assert main(["mask", str(capture), "left/00.png"]) == 0
    assert capsys.readouterr().out.splitlines()[1:] == ["0,0,2,2", "20,20,24,24"]
    assert main(["mask", str(capture), "left/00.png", "--undo"]) == 0
    assert tree(capture) == before


@pytest.mark.parametrize(
    ("name", "save"),
    [
        ("left/00.png", {}),
        ("left/00.jpg", {"quality": 90}),
        ("left/00.bmp", {}),
        ("left/00.pgm", {}),
        ("left/00.png.png", {}),
    ],
)
def test_a_mask_that_is_there_is_combined_and_restored_to_the_byte(capture, name, save):
    own = np.full((W, W), 255, np.uint8)
    own[:, 16:] = 0
    path = capture / "masks" / name
    path.parent.mkdir(parents=True)
    Image.fromarray(own).save(path, **save)
    before, was = tree(capture), excluded(capture, "left/00.png")
    assert was.sum() == 8 * W
    for shapes, count in (([(0, 0, 4, 4)], 16), ([(2, 2, 6, 7), (0, 20, 4, 24)], 36)):
        facts = draw_mask(capture, "left/00.png", shapes)
        assert facts.has_own and facts.mask == path
        hidden = excluded(capture, "left/00.png")
        assert (hidden >= was).all() and hidden.sum() == was.sum() + count
    draw_mask(capture, "left/00.png", [])
    assert tree(capture) == before


STORED = {
    2: Image.Transpose.FLIP_LEFT_RIGHT,
    3: Image.Transpose.ROTATE_180,
    4: Image.Transpose.FLIP_TOP_BOTTOM,
    5: Image.Transpose.TRANSPOSE,
    6: Image.Transpose.ROTATE_90,
    7: Image.Transpose.TRANSVERSE,
    8: Image.Transpose.ROTATE_270,
}
"""How an upright picture is stored, by EXIF orientation."""


@pytest.mark.parametrize("orientation", range(1, 9))
@pytest.mark.parametrize("upright_lens", [False, True])
def test_shapes_lie_where_the_upright_photo_shows_them(tmp_path, orientation, upright_lens):
    """The photo is black but for a bright rectangle; the same rectangle as shape excludes exactly its pixels."""
    shown = np.zeros((20, 30, 3), np.uint8)
    shown[3:8, 5:20] = 255
    stored = Image.fromarray(shown)
    if orientation in STORED:
        stored = stored.transpose(STORED[orientation])
    exif = Image.Exif()
    exif[0x0112] = orientation
    names = ["0.png", "1.png", "2.png"]
    capture = colmap(tmp_path / "capture", names, *((30, 20) if upright_lens else stored.size))
    for name in names:
        stored.save(capture / "images" / name, exif=exif)
    facts = draw_mask(capture, "0.png", [(5, 3, 20, 8)])
    assert (facts.W, facts.H) == (30, 20)
    view = next(
        view for view in load_dataset(capture, DataSettings(test_every=0)).train if view.name == "0.png"
    )
    photo = view.read()
    assert photo.mask.shape == ((20, 30) if upright_lens else stored.size[::-1])
    np.testing.assert_array_equal(~photo.mask, photo.image[..., 0] == 255)


def test_masks_named_by_transforms_are_combined_and_shared_ones_refused(tmp_path):
    capture = tmp_path / "capture"
    write_transforms(capture, list(views([f"{i}.png" for i in range(4)])), POINTS, np.full((50, 3), 0.5))
    file = capture / "transforms.json"
    contents = json.loads(file.read_text())
    (capture / "hidden").mkdir()
    for i, frame in enumerate(contents["frames"]):
        own = np.full((W, W), 255, np.uint8)
        own[i] = 0
        Image.fromarray(own).save(capture / "hidden" / f"{min(i, 2)}.png")
        frame["mask_path"] = f"hidden/{min(i, 2)}.png"
    file.write_text(json.dumps(contents))
    before = tree(capture)
    draw_mask(capture, "0.png", [(0, 4, 2, 6)])
    assert excluded(capture, "0.png").sum() == W + 4
    draw_mask(file, "0.png", [])
    assert tree(capture) == before
    with pytest.raises(DatasetError, match="is the mask of 2 photos"):
        draw_mask(capture, "3.png", [(0, 4, 2, 6)])
    del contents["frames"][1]["mask_path"]
    file.write_text(json.dumps(contents))
    before = tree(capture)
    with pytest.raises(
        DatasetError, match="no mask can be added; the capture names the masks of its other photos"
    ):
        draw_mask(capture, "1.png", [(0, 4, 2, 6)])
    assert tree(capture) == before


def test_photos_elsewhere_get_masks_in_the_capture_and_masks_elsewhere_stay(tmp_path):
    capture, photos = tmp_path / "capture", tmp_path / "photos"
    write_transforms(capture, list(views([f"{i}.png" for i in range(4)])), POINTS, np.full((50, 3), 0.5))
    (capture / "images").rename(photos)
    file = capture / "transforms.json"
    contents = json.loads(file.read_text())
    for frame in contents["frames"]:
        frame["file_path"] = f"../photos/{frame['file_path'].rsplit('/', 1)[-1]}"
    file.write_text(json.dumps(contents))
    before, theirs = tree(capture), tree(photos)
    facts = draw_mask(capture, "2.png", [(0, 0, 3, 3)])
    assert facts.mask == capture / "masks" / "2.png.png" and excluded(capture, "2.png").sum() == 9
    draw_mask(capture, "2.png", [])
    assert (tree(capture), tree(photos)) == (before, theirs)
    Image.new("L", (W, W), 255).save(photos / "mask.png")
    contents["frames"][0]["mask_path"] = "../photos/mask.png"
    file.write_text(json.dumps(contents))
    with pytest.raises(DatasetError, match="lies outside the capture, and is not changed"):
        draw_mask(capture, "0.png", [(0, 0, 3, 3)])


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (["9.png", "0,0,2,2"], "has no photo 9.png"),
        (["00.png", "0,0,2,2"], "2 photos are called 00.png"),
        (["01.png", "0,0,2"], "has 3 numbers, but needs x and y of two corners"),
        (["01.png", "0,0,2,x"], "has to be whole numbers, as X0,Y0,X1,Y1"),
        (
            ["01.png", "0,0,2,999999999999"],
            "shape[3]: is 999999999, but has to be a whole number, at least 0 and at most 100,000",
        ),
        (["01.png", "5,5,5,9"], "covers no pixel of its 24x24"),
        (["01.png", "30,0,40,9"], "covers no pixel of its 24x24"),
        (["01.png", "0,0,24,24"], "nothing of it would count; leave the photo out instead"),
        (["01.png", "brush:nan,3,3"], "has to be whole numbers, as brush:RADIUS,X,Y,X,Y"),
        (["01.png", "brush:2,3,1e9"], "has to be whole numbers, as brush:RADIUS,X,Y,X,Y"),
        (["01.png", "brush:"], "has to be whole numbers, as brush:RADIUS,X,Y,X,Y"),
        (
            ["01.png", "brush:0,3,3"],
            "shape.brush: is 0, but has to be a whole number, at least 1 and at most 100,000",
        ),
        (["01.png", "brush:100001,3,3"], "brush: is 100001, but has to be a whole number, at least 1"),
        (
            ["01.png", "brush:2,3,-999999999999"],
            "points[1]: is -99999999, but has to be a whole number, at least -100,000",
        ),
        (["01.png", "brush:2"], "has 0 numbers, but a stroke needs x and y of each point"),
        (["01.png", "brush:2,3"], "has 1 numbers, but a stroke needs x and y of each point"),
        (["01.png", "brush:2,-9,-9"], "shape brush:2,-9,-9 covers no pixel of its 24x24"),
        (["01.png", "brush:50,9,9"], "nothing of it would count; leave the photo out instead"),
        (["01.png", "0,0,4,4", "--undo"], "takes all shapes back; give it without shapes"),
    ],
)
def test_mistakes_are_one_line_and_change_nothing(capture, capsys, words, line):
    before = tree(capture)
    assert main(["mask", str(capture), *words]) == 2
    said = capsys.readouterr().err
    assert line in said and said.count("\n") == 1
    assert tree(capture) == before


def test_a_mask_that_another_program_changed_is_kept(capture):
    draw_mask(capture, "01.png", [(0, 0, 4, 4)])
    other = Image.new("L", (W, W), 255)
    path = capture / "masks" / "left" / "01.png.png"
    other.save(path)
    before = tree(capture)
    for shapes in ([], [(1, 1, 3, 3)]):
        with pytest.raises(DatasetError, match="was changed by another program"):
            draw_mask(capture, "01.png", shapes)
    assert tree(capture) == before
    path.unlink()
    draw_mask(capture, "01.png", [])  # a mask that is gone leaves nothing to lose
    assert not (capture / DRAWN).exists()


def test_an_interrupted_drawing_is_drawn_again_or_taken_back(capture, monkeypatch):
    """The record is written, the mask is not."""
    path = capture / "masks" / "left" / "01.png"
    path.parent.mkdir(parents=True)
    Image.new("L", (W, W), 255).save(path)
    before = tree(capture)
    monkeypatch.setattr(drawn_masks, "_write_mask", _no_room)
    with pytest.raises(OSError, match="No space left"):
        draw_mask(capture, "01.png", [(0, 0, 4, 4)])
    monkeypatch.undo()
    assert read_drawings(capture)["images/left/01.png"].before == path.read_bytes()
    draw_mask(capture, "01.png", [(0, 0, 4, 4)])
    assert excluded(capture, "01.png").sum() == 16
    draw_mask(capture, "01.png", [])
    assert tree(capture) == before


def _no_room(path, data):
    raise OSError(errno.ENOSPC, "No space left on device", str(path))


@pytest.mark.parametrize(
    "change",
    [
        lambda facts: facts.update(mask="../outside.png"),
        lambda facts: facts.update(mask="images/left/01.png"),
        lambda facts: facts.update(before="%%"),
        lambda facts: facts.update(shapes=[[1, 2, 3]]),
        lambda facts: facts.update(shapes="all"),
        lambda facts: facts.update(shapes=[{"brush": float("nan"), "points": [1, 1]}]),
        lambda facts: facts.update(shapes=[{"brush": 1, "points": [1, 1], "more": 1}]),
        lambda facts: facts.pop("after"),
    ],
)
def test_a_record_from_elsewhere_writes_nowhere_else(capture, change):
    draw_mask(capture, "01.png", [(0, 0, 4, 4)])
    record = json.loads((capture / DRAWN).read_text())
    change(record["photos"]["images/left/01.png"])
    (capture / DRAWN).write_text(json.dumps(record))
    before = tree(capture.parent)
    with pytest.raises(DatasetError, match="is damaged; delete it|delete one of them"):
        draw_mask(capture, "01.png", [])
    assert tree(capture.parent) == before


def test_a_run_is_trained_again_with_the_mask(capture, tmp_path, capsys):
    draw_mask(capture, "01.png", [(0, 0, 24, 10)])
    words = ["train", str(capture), "--out", str(tmp_path / "run"), "--iterations", "20", "--eval-every", "0"]
    assert main(words) == 0
    digests = json.loads((tmp_path / "run" / "photos.json").read_text())
    assert "mask" in json.dumps(digests)
