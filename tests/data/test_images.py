"""Decoding, downscaling, alpha, masks, and files whose sizes differ from those of their cameras."""

import json
import threading
import tracemalloc

import numpy as np
import pytest
from PIL import Image

from gsplat_edu.base.errors import DatasetError
from gsplat_edu.data.dataset import DataSettings, load_dataset
from gsplat_edu.data.writers import write_transforms
from gsplat_edu.photos.decoding import decode, decode_mask, image_size
from gsplat_edu.photos.image_files import PIXELS_PER_BYTE
from gsplat_edu.scene.camera import Camera
from gsplat_edu.scene.views import View
from photos import blank_png

RNG = np.random.default_rng(11)
NOISE = RNG.integers(0, 256, (12, 16, 3), dtype=np.uint8)


def saved(tmp_path, image, name="a.png", **how):
    image.save(tmp_path / name, **how)
    return tmp_path / name


def test_every_kind_of_pixel_becomes_rgb(tmp_path):
    gray = NOISE[..., 0]
    rgb, alpha = decode(saved(tmp_path, Image.fromarray(gray)))
    np.testing.assert_array_equal(rgb, np.repeat(gray[..., None], 3, axis=2))
    assert alpha is None
    deep = gray.astype(np.uint16) * 257
    rgb, _ = decode(saved(tmp_path, Image.fromarray(deep)))
    np.testing.assert_array_equal(rgb[..., 1], gray)
    palette = Image.fromarray(NOISE // 128 * 255).quantize(8)
    rgb, alpha = decode(saved(tmp_path, palette))
    np.testing.assert_array_equal(rgb, NOISE // 128 * 255)
    assert alpha is None
    rgb, _ = decode(saved(tmp_path, Image.fromarray(NOISE).convert("CMYK"), "a.jpg", quality=95))
    assert rgb.shape == NOISE.shape and rgb.dtype == np.uint8
    rgb, _ = decode(saved(tmp_path, Image.fromarray(gray > 128)))
    np.testing.assert_array_equal(rgb[..., 2], np.where(gray > 128, 255, 0))
    with pytest.raises(DatasetError, match=r"a\.tiff: cannot be decoded \(its pixels are floats\)"):
        decode(saved(tmp_path, Image.fromarray(gray.astype(np.float32)), "a.tiff"))


def test_alpha_is_returned_separately(tmp_path):
    alpha = RNG.integers(0, 256, (12, 16), dtype=np.uint8)
    rgb, found = decode(saved(tmp_path, Image.fromarray(np.dstack([NOISE, alpha]))))
    np.testing.assert_array_equal(rgb, NOISE)
    np.testing.assert_array_equal(found, alpha)
    _, found = decode(saved(tmp_path, Image.fromarray(np.dstack([NOISE, np.full_like(alpha, 255)]))))
    assert found is None
    rgb, found = decode(saved(tmp_path, Image.fromarray(np.dstack([NOISE[..., 0], alpha]))))
    np.testing.assert_array_equal(found, alpha)
    cut_out = Image.fromarray(np.where(alpha > 128, 1, 0).astype(np.uint8), "P")
    cut_out.putpalette([10, 20, 30, 40, 50, 60])
    rgb, found = decode(saved(tmp_path, cut_out, transparency=0))
    np.testing.assert_array_equal(found, np.where(alpha > 128, 255, 0))
    np.testing.assert_array_equal(rgb[alpha > 128], [[40, 50, 60]] * np.count_nonzero(alpha > 128))


def test_exif_orientation_is_ignored(tmp_path):
    """COLMAP uses the stored pixels, so the poses refer to them."""
    exif = Image.Exif()
    exif[0x0112] = 6  # rotate by 90 degrees for display
    path = saved(tmp_path, Image.fromarray(NOISE), "a.png", exif=exif)
    assert image_size(path) == (16, 12)
    np.testing.assert_array_equal(decode(path)[0], NOISE)


@pytest.mark.parametrize("name", ["a.jpg", "a.png", "a.webp"])
def test_cut_short_files_are_named(tmp_path, name):
    path = saved(tmp_path, Image.fromarray(np.kron(NOISE, np.ones((8, 8, 1), np.uint8))), name)
    data = path.read_bytes()
    for share in (0.0, 0.3, 0.6, 0.9):
        path.write_bytes(data[: int(share * len(data))])
        with pytest.raises(DatasetError, match=rf"{name}: cannot be decoded") as caught:
            decode(path)
        assert "\n" not in str(caught.value)
    path.write_bytes(b"version https://git-lfs.github.com/spec/v1\n")
    with pytest.raises(DatasetError, match="not a JPEG, PNG"):
        image_size(path)
    path.unlink()
    with pytest.raises(FileNotFoundError) as missing:
        path.stat()  # the reason in the system's words
    with pytest.raises(DatasetError, match=rf"cannot be decoded \({missing.value.strerror}\)"):
        decode(path)


def test_masks_of_every_kind(tmp_path):
    truth = NOISE[..., 0] > 128
    for pixels in (
        truth,
        truth.astype(np.uint8),
        truth.astype(np.uint16),
        np.dstack([truth * np.uint8(9)] * 3),
    ):
        np.testing.assert_array_equal(decode_mask(saved(tmp_path, Image.fromarray(pixels))), truth)


def test_a_broken_photo_among_good_ones(written):
    folder = written("transforms")
    (folder / "images" / "view_003.png").write_bytes(b"")
    with pytest.raises(DatasetError, match=r"view_003\.png: cannot be decoded"):
        load_dataset(folder)


def test_downscaling_keeps_the_pixel_convention(one_photo):
    """The photo is a linear ramp, I = column + row, of which each new pixel has the value at its ray. The mean of a
    cell of a ramp is the ramp's value at the cell's centre, where the scaled camera's ray meets the full image. It is
    rounded to 8 bits, by at most half a step.
    """
    y, x = np.mgrid[:48, :72]
    ramp = np.repeat((x + y).astype(np.uint8)[..., None], 3, axis=2)
    folder = one_photo(ramp, fl_x=50.0, fl_y=48.0, cx=30.0, cy=26.0)
    full = load_dataset(folder).train[0].camera
    for resolution in (2.0, 3.0, 36.0, 4.8, 100.0):
        view = load_dataset(folder, DataSettings(resolution=resolution)).train[0]
        camera, image = view.camera, view.image
        factor = max(1.0, 72 / resolution) if resolution >= 32 else resolution
        assert image.shape == (round(48 / factor), round(72 / factor), 3) == (camera.H, camera.W, 3)
        b, a = np.mgrid[: camera.H, : camera.W]
        column = (a - camera.cx) / camera.fx * full.fx + full.cx
        row = (b - camera.cy) / camera.fy * full.fy + full.cy
        np.testing.assert_allclose(image[..., 1], column + row, rtol=0, atol=0.5 + 1e-3)


def test_an_impulse_lands_where_its_ray_does(one_photo):
    photo = np.zeros((40, 60, 3), np.uint8)
    photo[24:28, 36:40] = 255
    view = load_dataset(one_photo(photo), DataSettings(resolution=4.0)).train[0]
    expected = np.zeros((10, 15, 3), np.uint8)
    expected[6, 9] = 255
    np.testing.assert_array_equal(view.image, expected)


@pytest.mark.parametrize("resolution", [2, 4, 8])
def test_ready_made_sizes_are_used(one_photo, resolution):
    """The size of the file counts: images_4/a.png is 17x13, although 64/4 x 48/4 is 16x12."""
    folder = one_photo(np.zeros((48, 64, 3), np.uint8), cx=30.0, cy=20.0)
    W, H = {2: (32, 24), 4: (17, 13), 8: (8, 6)}[resolution]
    pixels = RNG.integers(0, 256, (H, W, 3), dtype=np.uint8)
    (folder / f"images_{resolution}").mkdir()
    Image.fromarray(pixels).save(folder / f"images_{resolution}" / "a.png")
    view = load_dataset(folder, DataSettings(resolution=float(resolution))).train[0]
    np.testing.assert_array_equal(view.image, pixels)
    camera = view.camera
    np.testing.assert_allclose((camera.fx, camera.fy), (W, 64 * H / 48), rtol=1e-12)
    np.testing.assert_allclose((camera.cx, camera.cy), (30 * W / 64 - 0.5, 20 * H / 48 - 0.5), rtol=1e-12)
    np.testing.assert_array_equal(load_dataset(folder).train[0].image, 0)
    Image.new("RGB", (H, W)).save(folder / f"images_{resolution}" / "a.png")
    with pytest.raises(DatasetError, match=rf"images_{resolution}.*another aspect ratio"):
        load_dataset(folder, DataSettings(resolution=float(resolution)))


def test_a_photo_of_another_size_rescales_its_camera(one_photo):
    folder = one_photo(np.zeros((25, 33, 3), np.uint8), w=64, h=48, fl_x=60.0, fl_y=58.0, cx=30.0, cy=22.0)
    dataset = load_dataset(folder)
    camera = dataset.train[0].camera
    assert (camera.W, camera.H) == (33, 25)
    np.testing.assert_allclose((camera.fx, camera.fy), (60 * 33 / 64, 58 * 25 / 48))
    np.testing.assert_allclose((camera.cx, camera.cy), (30 * 33 / 64 - 0.5, 22 * 25 / 48 - 0.5))
    assert any(
        "1 of 1 photos differ in size" in note and "rescaled" in note for note in map(str, dataset.notes)
    )
    folder = one_photo(np.zeros((64, 48, 3), np.uint8), w=64, h=48)
    with pytest.raises(
        DatasetError, match=r"images/a\.png is 48x64 but its camera 64x48, another aspect ratio"
    ):
        load_dataset(folder)


@pytest.mark.parametrize("photo", [(1920, 1088), (1920, 1072), (1900, 1080), (960, 544)])
def test_a_cropped_photo_is_refused(one_photo, photo):
    """An encoder may pad a 1920x1080 video to 1088 rows, which its camera does not have."""
    folder = one_photo(np.zeros((photo[1], photo[0], 3), np.uint8), w=1920, h=1080)
    with pytest.raises(DatasetError, match="another aspect ratio"):
        load_dataset(folder)


@pytest.mark.parametrize(
    ("camera", "photo"),
    [
        ((1333, 1000), (333, 250)),
        ((333, 250), (1333, 1000)),
        ((1957, 1091), (979, 546)),
        ((1957, 1091), (978, 545)),
    ],
)
def test_sizes_that_differ_by_rounding_are_accepted(one_photo, camera, photo):
    folder = one_photo(np.zeros((photo[1], photo[0], 3), np.uint8), w=camera[0], h=camera[1])
    found = load_dataset(folder).train[0].camera
    assert photo == (found.W, found.H)


@pytest.mark.parametrize("limit", [150, 50])
@pytest.mark.parametrize("name", ["a.png", "a.tif", "a.webp"])
def test_large_photos_are_read_and_pillows_limit_is_not_changed(tmp_path, name, limit, monkeypatch):
    """Pillow warns above its limit and refuses above twice the limit, which reading must not change."""
    path = saved(tmp_path, Image.fromarray(NOISE), name, **({"lossless": True} if "webp" in name else {}))
    monkeypatch.setattr(Image, "MAX_IMAGE_PIXELS", limit)
    found = []

    def read():
        for _ in range(20):
            found.append(decode(path)[0])
            decode_mask(path)

    threads = [threading.Thread(target=read) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert image_size(path) == (16, 12) and len(found) == 80
    for image in found:
        np.testing.assert_array_equal(image, NOISE)
    assert limit == Image.MAX_IMAGE_PIXELS


@pytest.mark.parametrize(
    ("W", "H", "says"),
    [
        (32, 6_094_852, "32x6094852 px is too large for a photo: at most 65,535 px a side"),
        (30_000, 30_000, "30000x30000 px is too large for a photo: .* 400 megapixels"),
        (17_290, 17_290, r"17290x17290 px in \d+ bytes is too much for a photo"),
        (8_001, 8_000, "8001x8000 px in .* is too much for a photo"),
    ],
)
def test_a_size_that_no_photo_has_is_refused_before_decoding(tmp_path, W, H, says):
    path = tmp_path / "a.png"
    path.write_bytes(blank_png(W, H))
    for read in (image_size, decode, decode_mask):
        with pytest.raises(DatasetError, match=rf"a\.png: .*{says}"):
            read(path)


def test_photos_of_usual_compression_are_accepted_at_any_size(tmp_path):
    path = tmp_path / "a.png"
    content = blank_png(16_000, 12_500)  # 200 megapixels, the largest of today's cameras
    path.write_bytes(content + bytes(16_000 * 12_500 // PIXELS_PER_BYTE - len(content)))
    assert image_size(path) == (16_000, 12_500)
    path.write_bytes(blank_png(8_000, 8_000))
    assert image_size(path) == (8_000, 8_000), "a blank mask of 64 megapixels"


def test_photos_of_different_sizes(tmp_path):
    sizes = [(20, 30), (31, 17), (8, 8)]
    views = [
        View(
            Camera(np.eye(3), (i, 0, 0), 20, 20, (W - 1) / 2, (H - 1) / 2, H, W),
            RNG.integers(0, 256, (H, W, 3), dtype=np.uint8),
            name=f"{i}.png",
        )
        for i, (W, H) in enumerate(sizes)
    ]
    write_transforms(tmp_path, views)
    for view, (W, H) in zip(load_dataset(tmp_path, DataSettings(test_every=0)).train, sizes, strict=True):
        assert view.image.shape == (H, W, 3) == (view.camera.H, view.camera.W, 3)


@pytest.mark.parametrize("background", [(0.0, 0.0, 0.0), (1.0, 1.0, 1.0), (0.2, 0.5, 0.9)])
def test_alpha_goes_over_the_background_when_read(one_photo, background):
    alpha = RNG.integers(0, 256, (12, 16, 1), dtype=np.uint8)
    folder = one_photo(np.dstack([NOISE, alpha]))
    photo = load_dataset(folder, DataSettings(background=background)).train[0].read()
    expected = NOISE * (alpha / 255.0) + 255.0 * np.array(background) * (1 - alpha / 255.0)
    # The result is rounded once, and float32 may round a half in the other direction.
    np.testing.assert_allclose(photo.image, expected, rtol=0, atol=0.5 + 1e-4)
    assert photo.alpha is None


@pytest.mark.parametrize("values", [{}, {"k1": -0.1}])
def test_kept_alpha_downscales_like_the_composite(one_photo, values):
    """Colour is averaged with alpha as weight, so a background may be chosen before or after downscaling. Over any
    background, the averages of C alpha and of alpha give the average of the composites. Alpha, colour, their
    composite and the source composites are each rounded by half a step, at most 2 steps together.
    """
    alpha = np.kron(RNG.integers(0, 2, (6, 8)), np.ones((4, 4))).astype(np.uint8) * 255
    alpha[3::7] = 90
    pixels = RNG.integers(0, 256, (24, 32, 3), dtype=np.uint8)
    folder = one_photo(np.dstack([pixels, alpha]), **values)
    kept = load_dataset(folder, DataSettings(resolution=3.0, background=None)).train[0].read()
    assert kept.alpha is not None and np.unique(kept.alpha).size > 1
    for background in ((1.0, 1.0, 1.0), (0.0, 0.3, 0.8)):
        over = load_dataset(folder, DataSettings(resolution=3.0, background=background)).train[0].read()
        np.testing.assert_allclose(kept.over(background).astype(int), over.image.astype(int), rtol=0, atol=2)


def with_mask(folder, mask):
    Image.fromarray(mask).save(folder / "mask.png")
    path = folder / "transforms.json"
    contents = json.loads(path.read_text())
    contents["frames"][0]["mask_path"] = "mask.png"
    path.write_text(json.dumps(contents))
    return folder


def test_a_downscaled_mask_keeps_only_cells_that_count_entirely(one_photo):
    mask = np.full((24, 32), 255, np.uint8)
    mask[5, 9] = 0  # one masked pixel in a cell of 16
    folder = with_mask(one_photo(np.zeros((24, 32, 3), np.uint8)), mask)
    found = load_dataset(folder, DataSettings(resolution=4.0)).train[0].read().mask
    expected = np.ones((6, 8), bool)
    expected[1, 2] = False
    np.testing.assert_array_equal(found, expected)
    found = load_dataset(folder).train[0].read().mask
    np.testing.assert_array_equal(found, mask > 0)


def test_a_masked_photo_does_not_use_a_ready_made_size(one_photo):
    """The mask has the size of the full photo, so a copy in images_2 is not used."""
    folder = with_mask(one_photo(np.zeros((24, 32, 3), np.uint8)), np.full((24, 32), 255, np.uint8))
    (folder / "images_2").mkdir()
    Image.new("RGB", (16, 12), (9, 9, 9)).save(folder / "images_2" / "a.png")
    photo = load_dataset(folder, DataSettings(resolution=2.0)).train[0].read()
    np.testing.assert_array_equal(photo.image, 0)
    assert photo.mask is not None and photo.mask.shape == (12, 16) and photo.mask.all()


def test_a_mask_is_undistorted_with_its_photo(one_photo):
    """Photo and mask are the same picture, so the mask agrees wherever the photo is clearly black or white."""
    disk = np.where(np.hypot(*(np.mgrid[:48, :64] - np.array([20, 40])[:, None, None])) < 11, 255, 0).astype(
        np.uint8
    )
    folder = with_mask(one_photo(np.dstack([disk] * 3), k1=-0.2, p1=0.02), disk)
    photo = load_dataset(folder).train[0].read()
    clear = (photo.image[..., 0] == 255) | (photo.image[..., 0] == 0)
    np.testing.assert_array_equal(photo.mask[clear], photo.image[clear][:, 0] == 255)
    assert 200 < np.count_nonzero(photo.mask) < 700


def test_a_mask_of_another_size_names_both(one_photo):
    folder = with_mask(one_photo(np.zeros((24, 32, 3), np.uint8)), np.zeros((12, 16), np.uint8))
    with pytest.raises(DatasetError, match=r"mask\.png: the mask is 16x12 but its photo 32x24"):
        load_dataset(folder)


def test_a_photo_whose_size_changes_later_is_refused(one_photo):
    folder = one_photo(np.zeros((24, 32, 3), np.uint8))
    view = load_dataset(folder).train[0]
    Image.new("RGB", (30, 24)).save(folder / "images" / "a.png")
    with pytest.raises(DatasetError, match="its size changed"):
        view.read()


@pytest.mark.parametrize(
    "distortion", [{}, {"k1": -0.2, "p1": 0.01}, {"camera_model": "OPENCV_FISHEYE", "k1": 1.0}]
)
def test_many_threads_read_the_same_pixels(tmp_path, distortion):
    """A prefetcher reads in one thread while the trainer reads in another, with any memory budget. Every frame has
    its own focal length, so undistortion maps cannot be reused.
    """
    camera = Camera(np.eye(3), (0, 0, 0), 60, 60, 31.5, 75, 150, 64)
    pixels = RNG.integers(0, 256, (6, 150, 64, 3), dtype=np.uint8)
    write_transforms(tmp_path, [View(camera, image, name=f"{i}.png") for i, image in enumerate(pixels)])
    path = tmp_path / "transforms.json"
    contents = {**json.loads(path.read_text()), **distortion}
    for i, frame in enumerate(contents["frames"]):
        frame.update(fl_x=130.0 + i, fl_y=130.0 + i)
    path.write_text(json.dumps(contents))
    roomy = load_dataset(tmp_path, DataSettings(test_every=0))
    tight, found = load_dataset(tmp_path, DataSettings(test_every=0, image_memory=64 * 150 * 4)), {}

    def read(worker):
        found[worker] = [view.read() for view in tight.train]

    threads = [threading.Thread(target=read, args=(i,)) for i in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    expected = [view.read() for view in roomy.train]
    assert len(roomy.images) == 6 and len(tight.images) == 1
    for photos in found.values():
        for photo, other in zip(photos, expected, strict=True):
            np.testing.assert_array_equal(photo.image, other.image)
            np.testing.assert_array_equal(photo.mask, other.mask)
    assert all((photo.mask is not None) == (distortion.get("k1") == 1.0) for photo in expected)


@pytest.mark.parametrize("distortion", [{"k1": -0.2}, {"camera_model": "OPENCV_FISHEYE", "k1": 0.1}])
def test_undistorting_takes_little_memory_and_keeps_none(one_photo, distortion):
    """Maps of a whole photo would take 8 bytes per pixel, 96 MB for 12 megapixels, outside the memory budget. The
    photo, the undistorted photo and the mask take 7 bytes per pixel, and the maps of 128 of 1500 rows a little more.
    """
    folder = one_photo(np.zeros((1500, 2000, 3), np.uint8), **distortion)
    view = load_dataset(folder, DataSettings(image_memory=0)).train[0]
    tracemalloc.start()
    try:
        photo = view.read()
        kept, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert photo.image.nbytes == 3 * 2000 * 1500
    assert peak < 10 * 2000 * 1500 and kept < 4.1 * 2000 * 1500
