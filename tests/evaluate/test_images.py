import cv2
import numpy as np
import pytest
from PIL import Image

from gsplat_edu.errors import ArgumentError, ShapeError
from gsplat_edu.evaluate.images import save_png, side_by_side, write_frames


def colour(height, width, rgb):
    return np.broadcast_to(np.array(rgb, dtype=np.uint8), (height, width, 3))


def test_a_png_holds_the_bytes(tmp_path):
    image = np.random.default_rng(0).integers(0, 256, (5, 7, 3)).astype(np.uint8)
    save_png(tmp_path / "new" / "a.png", image)
    np.testing.assert_array_equal(np.array(Image.open(tmp_path / "new" / "a.png")), image)
    save_png(tmp_path / "b.png", image / 255.0)
    np.testing.assert_array_equal(np.array(Image.open(tmp_path / "b.png")), image)


def test_side_by_side_puts_a_line_between():
    row = side_by_side([colour(6, 5, (255, 0, 0)), np.zeros((6, 3, 3))])
    assert row.shape == (6, 5 + 4 + 3, 3)
    assert (row[:, :5] == (255, 0, 0)).all() and (row[:, 5:9] == 128).all() and (row[:, 9:] == 0).all()


@pytest.mark.usefixtures("as_shipped")
def test_side_by_side_refuses_other_heights():
    with pytest.raises(ShapeError, match="images"):
        side_by_side([colour(6, 5, (0, 0, 0)), colour(5, 5, (0, 0, 0))])
    with pytest.raises(ArgumentError, match="images: is empty"):
        side_by_side([])


def test_frames_go_into_a_folder_numbered_or_named(tmp_path):
    frames = [colour(4, 4, (i, i, i)) for i in range(3)]
    assert [p.name for p in write_frames(tmp_path / "f", iter(frames))] == [
        "frame_0000.png",
        "frame_0001.png",
        "frame_0002.png",
    ]
    (path,) = write_frames(tmp_path / "g", frames[2:], names=["left.png"])
    assert path == tmp_path / "g" / "left.png" and np.array(Image.open(path))[0, 0, 0] == 2


def test_a_video_has_the_frames_at_an_even_size(tmp_path):
    colours = [(220, 30, 30), (30, 220, 30), (30, 30, 220)]
    path = tmp_path / "v.mp4"
    assert write_frames(path, [colour(33, 47, rgb) for rgb in colours], fps=10) == [path]
    video = cv2.VideoCapture(str(path))
    assert (video.get(cv2.CAP_PROP_FRAME_WIDTH), video.get(cv2.CAP_PROP_FRAME_HEIGHT)) == (46, 32)
    assert video.get(cv2.CAP_PROP_FPS) == pytest.approx(10)
    for rgb in colours:
        read, frame = video.read()
        # lossy, and in 16..235: but no colour is taken for another, nor red for blue
        assert read and np.abs(frame[..., ::-1].mean(axis=(0, 1)) - rgb).max() < 25
    assert not video.read()[0]
    assert list(tmp_path.iterdir()) == [path], "and nothing beside it"


@pytest.mark.parametrize(
    ("frames", "says"),
    [
        ([], "frames: is empty"),
        ([(4, 4), (4, 6)], "frame 1 is 6x4, but the first is 4x4; write a folder"),
        ([(1, 9)], "too small for a video"),
    ],
)
def test_a_video_that_cannot_be_leaves_nothing(tmp_path, frames, says):
    with pytest.raises(ArgumentError, match=says):
        write_frames(tmp_path / "v.mp4", [colour(*size, (0, 0, 0)) for size in frames])
    assert list(tmp_path.iterdir()) == []


def test_a_file_is_no_folder(tmp_path):
    (tmp_path / "taken").write_text("")
    with pytest.raises(ArgumentError, match=r"taken: is a file; give a folder, or a name that ends in \.mp4"):
        write_frames(tmp_path / "taken", [colour(4, 4, (0, 0, 0))])
    with pytest.raises(ArgumentError, match="frames: is empty"):
        write_frames(tmp_path / "none", [])


def test_an_encoder_that_does_not_open_is_said(tmp_path, monkeypatch):
    class Closed:
        fourcc = staticmethod(lambda *_: 0)

        def __init__(self, *_):
            pass

        def isOpened(self):
            return False

        def release(self):
            pass

    monkeypatch.setattr(cv2, "VideoWriter", Closed)
    with pytest.raises(ArgumentError, match="OpenCV cannot encode mp4 at 4x4, 30 fps, here; write a folder"):
        write_frames(tmp_path / "v.mp4", [colour(4, 4, (0, 0, 0))])
