"""Videos contain the whole picture at any size, have reproducible bytes, and play in a browser in the right colours."""

import base64
import os
import struct

import cv2
import numpy as np
import pytest

from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.evaluate.images import write_frames
from gsplat_edu.evaluate.video import streamable

COLOURS = np.array([(220, 30, 30), (30, 220, 30), (30, 30, 220), (200, 200, 100)], dtype=np.uint8)

PLAY = """async ([kind, data, expected]) => {
  const video = document.querySelector("video");
  const on = (name) => new Promise((done, failed) => {
    video.addEventListener(name, done, { once: true });
    video.addEventListener("error", () => failed(new Error(video.error.message)), { once: true });
  });
  const ready = on("canplaythrough");
  video.src = `data:${kind};base64,${data}`;
  await ready;
  const shown = [];
  for (let i = 0; i < expected.length; i++) {
    const sought = on("seeked");
    video.currentTime = (i + 0.5) / 10;
    await sought;
    const canvas = document.createElement("canvas");
    canvas.width = video.videoWidth; canvas.height = video.videoHeight;
    const context = canvas.getContext("2d", { willReadFrequently: true });
    let found = [];
    // On a busy machine the frame may reach the canvas a little after `seeked`.
    for (let attempt = 0; attempt < 200; attempt++) {
      context.drawImage(video, 0, 0);
      found = [0.25, 0.75].flatMap((y) => [0.25, 0.75].map((x) =>
        [...context.getImageData(x * canvas.width, y * canvas.height, 1, 1).data].slice(0, 3)));
      if (Math.max(...found.flat().map((v, k) => Math.abs(v - expected[i].flat()[k]))) <= 8) break;
      await new Promise((done) => requestAnimationFrame(done));
    }
    shown.push(found);
  }
  video.currentTime = 0;
  const ended = on("ended");
  await video.play();
  await ended;
  return { size: [video.videoWidth, video.videoHeight], time: video.currentTime, duration: video.duration, shown };
}"""


def quarters(height, width, turn):
    """Return frames with a colour in each quarter of the picture, which each frame moves on by one quarter."""
    image = np.zeros((height, width, 3), dtype=np.uint8)
    for i, colour in enumerate(np.roll(COLOURS, turn, axis=0)):
        rows = slice(None, height // 2) if i < 2 else slice(height // 2, None)
        image[rows, slice(None, width // 2) if i % 2 == 0 else slice(width // 2, None)] = colour
    return image


def boxes(data):
    found, start = [], 0
    while start < len(data):
        length, kind = struct.unpack_from(">I4s", data, start)
        found.append(kind)
        start += length
    return found


@pytest.mark.parametrize(("height", "width"), [(33, 47), (48, 33), (33, 48), (32, 48), (1, 9)])
def test_the_video_contains_the_whole_picture(tmp_path, height, width):
    """Odd heights and widths used to lose a row or column. Here the last row and column are white."""
    frames = [np.zeros((height, width, 3), dtype=np.uint8) for _ in range(3)]
    for i, frame in enumerate(frames):
        frame[:] = 60 + 40 * i
        frame[-1], frame[:, -1] = 255, 255
    path = tmp_path / "v.mp4"
    assert write_frames(path, frames, fps=10) == [path] and list(tmp_path.iterdir()) == [path]
    video = cv2.VideoCapture(str(path))
    size = video.get(cv2.CAP_PROP_FRAME_HEIGHT), video.get(cv2.CAP_PROP_FRAME_WIDTH)
    assert size == (height + height % 2, width + width % 2)
    assert video.get(cv2.CAP_PROP_FPS) == pytest.approx(10)
    for frame in frames:
        read, shown = video.read()
        assert read
        assert (
            np.abs(shown[: height - 2, : width - 2, ::-1].astype(int) - frame[: height - 2, : width - 2]).max(
                initial=0
            )
            < 20
        )
        # The codec is lossy, with chroma of half resolution and the range 16..235. Values above 200 are nearer to white
        # than to the grey beside it.
        assert shown[height - 1 :].min() > 200 and shown[:, width - 1 :].min() > 200
    assert not video.read()[0]


def test_equal_frames_give_equal_bytes_and_the_index_is_in_front(tmp_path):
    rng = np.random.default_rng(0)
    noise = [
        cv2.GaussianBlur(rng.integers(0, 256, (96, 128, 3)).astype(np.uint8), (0, 0), 3) for _ in range(12)
    ]
    first, second = (write_frames(tmp_path / name, noise)[0].read_bytes() for name in ("a.mp4", "b.mp4"))
    assert first == second
    kinds = boxes(first)
    assert kinds.index(b"moov") < kinds.index(b"mdat")
    # profile 0 (8 bits, 4:2:0), limited range, BT.601 matrix
    entry = first[first.index(b"vpcC") + 4 :]
    assert entry[4] == 0 and entry[6] == 0x82 and tuple(entry[7:10]) == (1, 1, 6)
    assert streamable(first) == first, "the index is in front already"


def test_a_video_may_have_any_name(tmp_path):
    """OpenCV aborts the process if a name is not UTF-8."""
    frames = [quarters(16, 24, turn) for turn in range(3)]
    plain, odd = tmp_path / "plain.mp4", tmp_path / os.fsdecode(b"run\xfe") / os.fsdecode(b"raw\xff.mp4")
    for path in (plain, odd):
        write_frames(path, frames)
    assert odd.read_bytes() == plain.read_bytes() and list(odd.parent.iterdir()) == [odd]


def test_data_that_is_not_a_video_is_refused():
    for data in (b"", b"GIF89a", struct.pack(">I4s", 8, b"ftyp")):
        with pytest.raises(ArgumentError, match="is not an MP4 file with an index"):
            streamable(data)


@pytest.mark.parametrize(
    ("height", "width", "sphere"), [(63, 95, False), (720, 1280, False), (64, 128, True)]
)
def test_a_browser_plays_it_in_the_right_colours(browser, tmp_path, height, width, sphere):
    """Chromium does not play MPEG-4 Part 2, and assumes BT.709 for untagged videos of any size."""
    frames = [quarters(height, width, i) for i in range(4)]
    (path,) = write_frames(tmp_path / "v.mp4", frames, fps=10, sphere=sphere)
    tab = browser.new_page()
    tab.set_content("<video muted playsinline></video>")
    data = base64.b64encode(path.read_bytes()).decode()
    expected = [np.roll(COLOURS, i, axis=0).tolist() for i in range(len(frames))]
    played = tab.evaluate(PLAY, ["video/mp4", data, expected])
    assert played["size"] == [width + width % 2, height + height % 2]
    assert played["duration"] == pytest.approx(0.4, abs=0.01) and played["time"] == pytest.approx(
        0.4, abs=0.01
    )
    assert len(played["shown"]) == len(frames)
    for i, shown in enumerate(played["shown"]):
        # One step of limited-range YUV is up to 2.3 in RGB, and quantization adds a few; a wrong matrix is off by 30.
        assert np.abs(np.array(shown) - np.array(expected[i])).max() <= 8


@pytest.mark.parametrize("fps", [30.0, 23.976, 8.0])
def test_a_video_takes_half_a_bit_per_pixel_at_its_frame_rate(tmp_path, fps):
    """The frames show a moving texture with grain, which would take more than a bit per pixel without a limit."""
    rng = np.random.default_rng(0)
    large = cv2.GaussianBlur(rng.uniform(0, 255, (500, 700)).astype(np.float32), (0, 0), 1.5)
    large = np.clip(128 + 4 * (large - 128), 0, 255).astype(np.uint8)
    grain = rng.normal(0, 5, (12, 480, 640))
    moved = [large[i : i + 480, 2 * i : 2 * i + 640] for i in range(12)]
    frames = [
        np.repeat(np.clip(one + noise, 0, 255).astype(np.uint8)[..., None], 3, axis=2)
        for one, noise in zip(moved, grain, strict=True)
    ]
    (path,) = write_frames(tmp_path / "a.mp4", frames, fps=fps)
    assert path.stat().st_size < 1.5 * 0.5 / 8 * 12 * 480 * 640  # the first frame has no predecessor
    video = cv2.VideoCapture(str(path))
    assert video.get(cv2.CAP_PROP_FPS) == pytest.approx(fps, rel=1e-3)
    assert video.get(cv2.CAP_PROP_FRAME_COUNT) == 12
    decoded = [video.read()[1][..., ::-1] for _ in frames]
    errors = [np.mean((one.astype(float) - other) ** 2) for one, other in zip(decoded, frames, strict=True)]
    assert 10 * np.log10(255**2 / np.mean(errors)) > 25
