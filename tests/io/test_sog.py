import io
import json
import math
import zipfile
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.io.formats import read_scene, write_scene
from gsplat_edu.io.ply import load_ply
from gsplat_edu.io.scene import Scene
from gsplat_edu.io.sog import codec as sog
from gsplat_edu.io.sog.palette import codebook, nearest_in_codebook, palette, sampled_rows
from gsplat_edu.io.sog.values import positions_to_steps, quats_to_pixels
from gsplat_edu.scene.gaussians import Gaussians, quat_to_R_t
from gsplat_edu.scene.morton import morton_codes
from scene_files import kept_file, matched, random_scene

IMAGES = ["means_l.webp", "means_u.webp", "quats.webp", "scales.webp", "sh0.webp"]
SH_IMAGES = ["shN_centroids.webp", "shN_labels.webp"]


def unzipped(path):
    with zipfile.ZipFile(path) as bundle:
        return {name: bundle.read(name) for name in bundle.namelist()}


def arrays(gaussians):
    return {name: tensor.numpy() for name, tensor in gaussians.tensors().items()}


def assert_nearest(values, read, entries):
    """Check that each value was read as the codebook entry nearest to the written one."""
    entries = np.array(entries)
    distances = np.abs(values.astype(np.float64)[..., None] - entries.astype(np.float32))
    np.testing.assert_array_equal(np.abs(values.astype(np.float64) - read), distances.min(axis=-1))


def assert_close(original, read, meta):
    """Check that each attribute is off by at most half a step of its quantisation, for up to 1024 splats."""
    a, b = arrays(original), arrays(read)
    # Half of 1/65535 of the range of log(1 + |x|), converted to x by d/dv (e^v - 1) = 1 + |x|, plus float32 rounding.
    width = np.subtract(meta["means"]["maxs"], meta["means"]["mins"])
    margin = (1 + np.abs(a["means"])) * np.expm1(width / 65535 / 2) + 2**-23 * np.abs(a["means"])
    assert (np.abs(a["means"] - b["means"]) <= margin * (1 + 1e-6)).all()

    # Half a step of a component is e = 1 / (255 sqrt 2). Three of them are off by at most e; the fourth, d >= 1/2, by
    # (a da + b db + c dc) / d <= sqrt(3) e sqrt(1 - d^2) / d <= 3 e. The quaternion is off by sqrt(12) e, the rotation
    # by twice that. Allow 2 % for the higher orders.
    relative = quat_to_R_t(original.quats.double()).mT @ quat_to_R_t(read.quats.double())
    angles = torch.arccos(((torch.einsum("nii->n", relative) - 1) / 2).clamp(-1, 1))
    assert float(angles.max()) <= 2 * math.sqrt(12) / (255 * math.sqrt(2)) * 1.02

    opacities = original.opacities.double() - read.opacities.double()
    assert float(opacities.abs().max()) <= 0.5 / 255 + 1e-6
    assert_nearest(a["log_scales"], b["log_scales"], meta["scales"]["codebook"])
    assert_nearest(a["sh0"], b["sh0"], meta["sh0"]["codebook"])
    if "shN" in meta:  # up to 1024 vectors are all in the palette, so only the codebook rounds
        assert_nearest(a["sh_rest"], b["sh_rest"], meta["shN"]["codebook"])


@pytest.mark.parametrize("rest", [0, 3, 8, 15])
@pytest.mark.parametrize("count", [1, 2, 1000])
def test_a_round_trip_stays_within_half_a_step(tmp_path, count, rest):
    scene = random_scene(count, rest)
    scene.gaussians.means[:, 1] *= 30
    scene.gaussians.logit_opacities[:20] = -50.0  # WebP keeps the colours of transparent pixels
    sog.write(tmp_path / "new" / "a.sog", scene)
    back = sog.read(tmp_path / "new" / "a.sog")
    meta = json.loads(unzipped(tmp_path / "new" / "a.sog")["meta.json"])
    assert all(t.dtype == torch.float32 and t.is_contiguous() for t in back.gaussians.tensors().values())
    assert back.gaussians.sh_rest.shape == (count, rest, 3)
    original = matched(scene.gaussians, back.gaussians)
    assert_close(original, back.gaussians, meta)
    if count <= 2:  # fewer values than codebook entries
        for name in ("log_scales", "sh0", "sh_rest"):
            np.testing.assert_array_equal(arrays(original)[name], arrays(back.gaussians)[name])


@pytest.mark.parametrize("rest", [0, 8])
def test_an_empty_scene_can_be_written(tmp_path, rest):
    sog.write(tmp_path / "a.sog", random_scene(0, rest))
    back = sog.read(tmp_path / "a.sog")
    assert len(back.gaussians) == 0 and back.gaussians.sh_rest.shape[1] == rest


@pytest.mark.parametrize("antialiased", [None, False, True])
@pytest.mark.parametrize("up", [None, (0.0, -1.0, 0.0), (0.6, 0.0, -0.8)])
def test_antialiasing_and_up_are_kept(tmp_path, antialiased, up):
    sog.write(tmp_path / "a.sog", Scene(random_scene(3, 0).gaussians, antialiased, up))
    back = sog.read(tmp_path / "a.sog")
    assert back.antialiased is antialiased
    assert back.up == up if up is None else back.up == pytest.approx(up, abs=1e-15)
    meta = json.loads(unzipped(tmp_path / "a.sog")["meta.json"])
    assert meta.get("antialias") is antialiased
    assert meta.get("model") == ("antialiased" if antialiased else None)  # for PlayCanvas' splat-transform


@pytest.mark.parametrize(
    ("model", "antialiased"), [("antialiased", True), ("default", False), ("2dgs", None), (7, None)]
)
def test_antialiasing_is_read_from_the_model_of_splat_transform(tmp_path, model, antialiased):
    folder = tmp_path / "scene"
    write_scene(folder / "meta.json", Scene(random_scene(3, 0).gaussians))
    meta = json.loads((folder / "meta.json").read_bytes())
    (folder / "meta.json").write_text(json.dumps({**meta, "model": model}))
    assert read_scene(folder).antialiased is antialiased


def test_zip_and_folder_hold_the_same_bytes_every_time(tmp_path):
    scene = random_scene(1500, 3)
    for name in ("a.sog", "b.sog"):
        sog.write(tmp_path / name, scene)
    assert (tmp_path / "a.sog").read_bytes() == (tmp_path / "b.sog").read_bytes()
    with zipfile.ZipFile(tmp_path / "a.sog") as bundle:
        assert {entry.compress_type for entry in bundle.infolist()} == {zipfile.ZIP_STORED}

    sog.write(tmp_path / "folder" / "meta.json", scene)
    contents = {file.name: file.read_bytes() for file in (tmp_path / "folder").iterdir()}
    assert contents == unzipped(tmp_path / "a.sog")
    assert list(unzipped(tmp_path / "a.sog")) == ["meta.json", *IMAGES, *SH_IMAGES]
    a, b = (arrays(sog.read(tmp_path / p).gaussians) for p in ("a.sog", "folder/meta.json"))
    for name, values in a.items():
        np.testing.assert_array_equal(values, b[name])


def test_a_scene_is_read_as_specified(tmp_path):
    """Decode every number from the pixels in plain loops."""
    scene = random_scene(70, 3)
    sog.write(tmp_path / "a.sog", scene)
    files = unzipped(tmp_path / "a.sog")
    meta = json.loads(files["meta.json"])
    assert (meta["version"], meta["count"], meta["shN"]["bands"]) == (2, 70, 1)
    images = {
        name: Image.open(io.BytesIO(data)).convert("RGBA")
        for name, data in files.items()
        if name != "meta.json"
    }
    assert {images[name].size for name in [*IMAGES, "shN_labels.webp"]} == {(12, 8)}
    assert images["shN_centroids.webp"].size == (64 * 3, 2)

    read = arrays(sog.read(tmp_path / "a.sog").gaussians)
    for i in range(70):
        at = {name: images[name].getpixel((i % 12, i // 12)) for name in [*IMAGES, "shN_labels.webp"]}
        for axis in range(3):
            low, high = meta["means"]["mins"][axis], meta["means"]["maxs"][axis]
            n = low + (high - low) * (at["means_l.webp"][axis] + 256 * at["means_u.webp"][axis]) / 65535
            assert read["means"][i, axis] == pytest.approx(
                math.copysign(math.exp(abs(n)) - 1, n), rel=1e-6, abs=1e-9
            )
            assert read["log_scales"][i, axis] == pytest.approx(
                meta["scales"]["codebook"][at["scales.webp"][axis]]
            )
            assert read["sh0"][i, 0, axis] == pytest.approx(meta["sh0"]["codebook"][at["sh0.webp"][axis]])
        small = [(byte / 255 - 0.5) * 2 / math.sqrt(2) for byte in at["quats.webp"][:3]]
        small.insert(at["quats.webp"][3] - 252, math.sqrt(1 - sum(s * s for s in small)))
        assert read["quats"][i].tolist() == pytest.approx(small, abs=1e-6)
        opacity = 1 / (1 + math.exp(-read["logit_opacities"][i]))
        assert opacity == pytest.approx(
            at["sh0.webp"][3] / 255, abs=0.26 / 255
        )  # 0 and 1 have no finite logit
        label = at["shN_labels.webp"][0] + 256 * at["shN_labels.webp"][1]
        for c in range(3):
            entry = images["shN_centroids.webp"].getpixel((label % 64 * 3 + c, label // 64))
            expected = [meta["shN"]["codebook"][byte] for byte in entry[:3]]
            assert read["sh_rest"][i, c].tolist() == pytest.approx(expected)


def test_rotations_are_stored_w_first():
    """Alpha minus 252 is the index of the largest of (w, x, y, z). Zero lies at 127.5, rounded up."""
    quats = np.array(
        [[2, 0, 0, 0], [0, -3, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1e-30], [1, 1, 0, 0]], dtype=np.float32
    )
    expected = [[128, 128, 128, 252], [128, 128, 128, 253], [128, 128, 128, 254], [128, 128, 128, 255]]
    assert quats_to_pixels(quats).tolist() == [*expected, [255, 128, 128, 252]]


def test_splats_are_in_morton_order(tmp_path):
    """The means that were read are rounded already, so writing them again keeps the order."""
    scene = random_scene(300, 0)
    scene.gaussians.means[:40] = scene.gaussians.means[40:80]
    write_scene(tmp_path / "a.sog", scene)
    read = read_scene(tmp_path / "a.sog").gaussians
    steps, _ = positions_to_steps(read.means.numpy())
    assert (np.diff(morton_codes(steps).astype(np.int64)) >= 0).all()


@pytest.mark.parametrize(
    ("values", "optimum"),
    [
        (np.random.default_rng(0).uniform(0, 1, 200_000), 1 / 256 / math.sqrt(12)),  # equal steps
        # Panter and Dite's limit for many entries and a normal density: sqrt(3) pi / 2 / 256^2
        (np.random.default_rng(0).normal(size=200_000), math.sqrt(math.sqrt(3) * math.pi / 2) / 256),
    ],
)
def test_codebooks_are_nearly_optimal(values, optimum):
    values = values.astype(np.float32)
    entries = codebook(values)
    assert (np.diff(entries) >= 0).all()
    error = values - entries[nearest_in_codebook(values, entries)]
    # Entries fitted to a finite sample do slightly better than the density's optimum; random gaps cost about 1 %.
    assert 0.97 * optimum < math.sqrt(np.mean(error**2)) < 1.02 * optimum


def test_codebooks_keep_few_values_exactly():
    few = np.array([3.0, -1e38, 3.0, 0.5, 1e-40], dtype=np.float32)
    entries = codebook(few)
    np.testing.assert_array_equal(entries[nearest_in_codebook(few, entries)], few)
    heavy = np.concatenate([np.zeros(100_000), np.linspace(1, 2, 400), [1e30]]).astype(np.float32)
    entries = codebook(heavy)
    error = heavy - entries[nearest_in_codebook(heavy, entries)]
    assert np.abs(error).max() < 1 / 100, "the other values keep nearly all entries"


def test_palettes_keep_few_vectors_exactly():
    rng = np.random.default_rng(0)
    few = rng.normal(size=(1500, 9)).astype(np.float32)
    vectors = few[rng.integers(0, 1500, 5000)]
    entries, labels = palette(vectors, np.ones(5000, dtype=np.float32))
    assert len(entries) <= 1500
    np.testing.assert_array_equal(entries[labels], vectors)
    zeros = np.copysign(0.0, rng.normal(size=(5000, 24))).astype(np.float32)
    entries, labels = palette(zeros, np.ones(5000, dtype=np.float32))
    assert len(entries) == 1, "-0 is 0"


@pytest.mark.parametrize("size", [1e-38, 1.0, 1e36])
@pytest.mark.parametrize("spread", [0.0, 1.0])
def test_palettes_beat_a_subset_of_the_vectors(size, spread):
    """5000 vectors near a 3-dimensional subspace, with unequal weights, are more than the 4096 entries."""
    rng = np.random.default_rng(0)
    vectors = rng.normal(size=(5000, 3)) @ rng.normal(size=(3, 24)) + 0.05 * rng.normal(size=(5000, 24))
    weights = np.exp(spread * rng.normal(size=5000)).astype(np.float32)
    entries, labels = palette((size * vectors).astype(np.float32), weights)
    assert 4000 < len(entries) <= 4096 and labels.max() < len(entries)

    def loss(read):
        return float((weights * ((vectors - read) ** 2).sum(axis=1)).sum())

    # the baseline keeps the heaviest vectors and maps the others to the nearest of these
    kept = vectors[np.argsort(-weights, kind="stable")[:4096]]
    nearest = np.argmin((kept**2).sum(axis=1) - 2 * vectors @ kept.T, axis=1)
    assert loss(entries[labels].astype(np.float64) / size) < 0.8 * loss(kept[nearest])


def test_the_number_of_picks_is_exact_for_any_chances():
    rng = np.random.default_rng(0)
    for _ in range(200):
        chances = 10 ** rng.uniform(-40, 20, 50) * rng.integers(0, 2, 50)
        count = int(rng.integers(1, 50))
        picked = sampled_rows(chances, count)
        assert picked.sum() == count
        if count * chances.max() >= chances.sum() > 0:
            assert picked[chances.argmax()], "a chance of at least one is always picked"
    even = sampled_rows(np.ones(100), 20)
    assert np.diff(np.flatnonzero(even)).tolist() == [5] * 19


def test_many_vectors_get_a_palette_within_sixteen_bits(tmp_path):
    scene = random_scene(3000, 3)
    sog.write(tmp_path / "a.sog", scene)
    meta = json.loads(unzipped(tmp_path / "a.sog")["meta.json"])
    assert 1024 < meta["shN"]["count"] <= 2048
    back = sog.read(tmp_path / "a.sog").gaussians
    error = (matched(scene.gaussians, back).sh_rest - back.sh_rest).square().mean()
    assert float(error) < 0.25 * float(scene.gaussians.sh_rest.var())  # 9 dimensions, 1.5 splats per entry


def test_harmonics_of_visible_splats_are_kept_best(tmp_path):
    """Every other splat is a hundredth as large as the rest and nearly transparent."""
    scene = random_scene(3000, 8)
    scene.gaussians.log_scales[::2] -= 4.6
    scene.gaussians.logit_opacities[::2] = -4.0
    sog.write(tmp_path / "a.sog", scene)
    back = sog.read(tmp_path / "a.sog").gaussians
    original = matched(scene.gaussians, back)
    errors = (original.sh_rest - back.sh_rest).square().mean(dim=(1, 2))
    hidden = original.logit_opacities == -4.0
    assert float(errors[~hidden].mean()) < 0.1 * float(errors[hidden].mean())


def test_scenes_that_a_sog_cannot_hold_are_refused(tmp_path):
    gaussians = random_scene(5).gaussians
    gaussians.quats[3] = 0
    with pytest.raises(ArgumentError, match=r"quats\[3\]: has zero length"):
        sog.write(tmp_path / "a.sog", Scene(gaussians))
    with pytest.raises(ArgumentError, match=r"means\[0, 0\]: is NaN or infinite"):
        sog.write(tmp_path / "a.sog", Scene(random_scene(5).gaussians.map(lambda t: t.double() * 1e300)))
    one = random_scene(1, 0).gaussians
    many = one.map(lambda t: t.expand(2**26 + 1, *t.shape[1:]))  # an expanded tensor takes no memory
    with pytest.raises(ArgumentError, match="are 67,108,865, but a SOG has at most"):
        sog.write(tmp_path / "a.sog", Scene(many))
    assert list(tmp_path.iterdir()) == []


def test_numbers_at_the_ends_of_float32_survive(tmp_path):
    """Numbers whose squares overflow or underflow."""
    gaussians = random_scene(2000, 3).gaussians
    largest = float(np.finfo(np.float32).max)
    for tensor in gaussians.tensors().values():
        tensor[:2], tensor[2:4] = largest, 1e-45
    gaussians.means[1] = gaussians.log_scales[1] = gaussians.logit_opacities[1] = -largest
    sog.write(tmp_path / "a.sog", Scene(gaussians))
    back = sog.read(tmp_path / "a.sog").gaussians
    assert all(bool(t.isfinite().all()) for t in back.tensors().values())
    assert float(back.means.max()) == largest and float(back.means.min()) == -largest


def test_a_failed_write_leaves_the_old_folder(tmp_path, monkeypatch):
    path = tmp_path / "meta.json"
    sog.write(path, random_scene(20, 3))
    before = {file.name: file.read_bytes() for file in tmp_path.iterdir()}
    written = Path.write_bytes

    def disk_full(file, data):
        if ".sh0." in file.name:
            raise OSError(28, "No space left on device")
        return written(file, data)

    monkeypatch.setattr("pathlib.Path.write_bytes", disk_full)
    with pytest.raises(OSError, match=r"No space left on device: .*sh0\.webp"):
        sog.write(path, random_scene(30, 3))
    assert {file.name: file.read_bytes() for file in tmp_path.iterdir()} == before


@pytest.mark.parametrize(("name", "count"), [("playbot_lod3_0", 31_000), ("playbot_lod6_0", 1_873)])
def test_a_scene_from_another_program(tmp_path, name, count):
    """A scene read from a SOG has few distinct values, so writing it again changes only the order."""
    scene = sog.read(kept_file(f"formats/{name}.sog"))
    read = arrays(scene.gaussians)
    assert (len(scene.gaussians), scene.gaussians.sh_degree) == (count, 2)
    assert (scene.antialiased, scene.up) == (None, None)
    # y points down, as in the source PLY: the robot stands at 0 and is 1 unit high.
    assert -1.1 < read["means"][:, 1].min() < -1.0 and 0.0 < read["means"][:, 1].max() < 0.05

    sog.write(tmp_path / "a.sog", scene)
    again = arrays(sog.read(tmp_path / "a.sog").gaussians)

    def sorted_rows(values):
        kept = (values["log_scales"], values["sh0"][:, 0], values["logit_opacities"][:, None])
        rows = np.concatenate([*kept, values["sh_rest"].reshape(count, -1)], axis=1)
        return rows[np.lexsort(rows.T)]

    np.testing.assert_array_equal(sorted_rows(read), sorted_rows(again))


def test_axes_match_those_of_a_ply(tmp_path):
    original = load_ply(kept_file("plush_dog/point_cloud_29999_clean.ply"))
    sog.write(tmp_path / "a.sog", Scene(original))
    back = sog.read(tmp_path / "a.sog").gaussians
    # 16 bits over a logarithmic range of about 1 have an error well below 1e-3.
    distance = torch.cdist(back.means[:500], original.means)
    assert float(distance.min(dim=1).values.max()) < 1e-4
    same = Gaussians.concatenated([original.map(lambda t: t[distance.argmin(dim=1)])])
    turns = quat_to_R_t(same.quats.double()).mT @ quat_to_R_t(back.quats[:500].double())
    assert float(torch.einsum("nii->n", turns).min()) > 2.99
    # The palette has half as many vectors as there are splats, and approximates invisible splats coarsely.
    assert (
        float(torch.corrcoef(torch.stack([same.sh_rest.flatten(), back.sh_rest[:500].flatten()]))[0, 1]) > 0.9
    )


def test_a_palette_has_as_many_entries_as_asked_and_more_are_closer():
    scene = random_scene(6000, 3)
    vectors = scene.gaussians.sh_rest.reshape(6000, -1).numpy()
    weights = np.ones(6000, dtype=np.float32)
    errors = []
    for most in (1024, 1500, 3000):
        entries, labels = palette(vectors, weights, most)
        assert 0.98 * most <= len(entries) <= most and labels.max() < len(entries)
        errors.append(float(np.square(entries[labels] - vectors).sum()))
    assert errors[0] > errors[1] > errors[2]
    assert len(palette(vectors, weights, 60_000)[0]) == 6000
