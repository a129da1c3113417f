"""SPZ files of an independent writer in this file and of other programs are read, and damaged files are refused."""

import gzip
import random
import struct
import tracemalloc
from dataclasses import replace

import numpy as np
import pytest
import torch
import zstandard

from gsplat_edu.base.errors import ArgumentError, SceneFormatError
from gsplat_edu.io import compressed_ply, ply, spz
from gsplat_edu.io.axes import half_turned
from gsplat_edu.io.scene import Scene
from gsplat_edu.render.api import render
from gsplat_edu.scene.camera import Camera
from gsplat_edu.scene.gaussians import Gaussians, cov3d_t
from scene_files import kept_file, refused

HALF_COLOR = 0.5 / (0.15 * 255)
HALF_HARMONIC = 0.5 / 128
HALF_SCALE = 0.5 / 16
HALF_OPACITY = 0.5 / 255
ROUNDING = 1e-6  # rounding of float32, small relative to the steps above

# The three small components s of a quaternion have steps of 1 / (511 sqrt(2)). An error e of half a step each moves the
# quaternion by |e| across and by at most (2 |s| |e| + |e|²) / 2c along its largest component c >= 1/2, where
# |s| <= sqrt(3/4). The rotation's angle is off by twice as much.
E3 = np.sqrt(3) * 0.5 / (511 * np.sqrt(2))
ANGLE = 2 * np.hypot(E3, np.sqrt(3) * E3 + E3**2)


def random_scene(count, rest, seed=0, **facts):
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape):
        return torch.randn(*shape, generator=generator)

    gaussians = Gaussians(
        means=3 * normal(count, 3),
        quats=normal(count, 4),
        log_scales=(normal(count, 3) - 3).clamp(-9.9, 5.9),
        sh0=normal(count, 1, 3).clamp(-3.3, 3.3),
        sh_rest=(0.3 * normal(count, rest, 3)).clamp(-0.99, 0.99),
        logit_opacities=2 * normal(count),
    )
    return Scene(gaussians, **facts)


def angles(a, b):
    """Return the angles between rotations, computed from the chord, which is accurate for small angles."""
    a, b = (torch.nn.functional.normalize(q.double(), dim=1) for q in (a, b))
    chord = torch.minimum((a - b).norm(dim=1), (a + b).norm(dim=1))
    return 4 * torch.asin(chord / 2)


def assert_close(read, given, mean_step, angle=ANGLE):
    """Check that every attribute read is within half a step of the given one."""
    assert all(t.dtype == torch.float32 and t.is_contiguous() for t in read.tensors().values())
    assert (len(read), read.sh_degree) == (len(given), given.sh_degree)
    if not len(given):
        return

    def worst(name, change=lambda t: t):
        difference = (change(getattr(read, name)) - change(getattr(given, name))).abs()
        return float(difference.max()) if difference.numel() else 0.0

    assert worst("means") <= 0.5 * mean_step + ROUNDING
    assert worst("log_scales") <= HALF_SCALE + ROUNDING
    assert worst("sh0") <= HALF_COLOR + ROUNDING
    assert worst("sh_rest") <= HALF_HARMONIC + ROUNDING
    assert worst("logit_opacities", torch.sigmoid) <= HALF_OPACITY + ROUNDING
    assert float(angles(read.quats, given.quats).max()) <= angle

    # Entries of Sigma are at most its largest variance v. A factor f = exp(1/32) on the scales changes them by at most
    # (f² - 1) v, and a rotation by an angle t by at most 2 t f² v.
    a, b = (cov3d_t(g.log_scales.double(), g.quats.double()) for g in (read, given))
    f2 = np.exp(2 * HALF_SCALE)
    largest = torch.exp(2 * given.log_scales.double().amax(dim=1))
    assert float(((a - b).abs().amax(dim=(1, 2)) / largest).max()) <= (f2 - 1) + 2 * angle * f2


@pytest.mark.parametrize("count", [0, 1, 1000])
@pytest.mark.parametrize("rest", [0, 3, 8, 15])
def test_a_round_trip_stays_within_half_a_step(tmp_path, rest, count):
    path = tmp_path / "new" / "a.spz"
    scene = random_scene(count, rest)
    spz.write(path, scene)
    read = spz.read(path)
    bits = path.read_bytes()[13]
    assert bits == 24 if not count else 19 <= bits <= 22  # means have sigma 3, and 19 bits hold up to 16
    assert_close(read.gaussians, scene.gaussians, 2.0**-bits)


def test_a_second_round_trip_changes_nothing(tmp_path):
    path = tmp_path / "a.spz"
    spz.write(path, random_scene(1000, 15))
    once = spz.read(path)
    spz.write(path, once)
    twice = spz.read(path)
    for name, tensor in once.gaussians.tensors().items():
        if name != "quats":
            assert torch.equal(tensor, twice.gaussians.tensors()[name]), name
    # If the two largest components are nearly equal, the second write may omit the other one.
    assert float(angles(once.gaussians.quats, twice.gaussians.quats).max()) <= ANGLE
    before = path.read_bytes()
    spz.write(path, once)
    assert path.read_bytes() == before


def test_the_layout_of_version_4(tmp_path):
    scene = random_scene(5, 8, antialiased=True)
    spz.write(tmp_path / "a.spz", scene)
    data = (tmp_path / "a.spz").read_bytes()
    assert data[:4] == b"NGSP"
    assert struct.unpack("<II", data[4:12]) == (4, 5)
    degree, bits, flags, streams, table = struct.unpack("<BBBBI", data[12:20])
    assert (degree, flags, streams, table, data[20:32]) == (2, 1, 6, 32, bytes(12))
    contents, start = [], table + 16 * streams
    for i in range(streams):
        packed, unpacked = struct.unpack_from("<QQ", data, table + 16 * i)
        contents.append(zstandard.decompress(data[start : start + packed]))
        assert len(contents[-1]) == unpacked
        start += packed
    assert start == len(data)
    assert [len(c) for c in contents] == [45, 5, 15, 15, 20, 120]
    g = scene.gaussians
    x, y, z = (int.from_bytes(contents[0][i : i + 3], "little", signed=True) / 2**bits for i in (0, 3, 6))
    np.testing.assert_allclose((x, -y, -z), g.means[0].numpy(), atol=2.0**-bits)
    # The second coefficient of degree 1 belongs to z, whose sign the half turn changes. Its green value is byte 4.
    assert contents[5][4] == round(128 - 128 * float(g.sh_rest[0, 1, 1]))
    assert contents[1][0] == round(255 * float(g.opacities[0]))


@pytest.mark.parametrize(
    ("largest", "bits"),
    [(0.1, 24), (0.499, 24), (1.0, 22), (2047.9, 12), (2048.0, 11), (8_388_607.0, 0)],
)
def test_as_many_fractional_bits_as_the_scene_allows(tmp_path, largest, bits):
    scene = random_scene(3, 0)
    scene.gaussians.means[:] = torch.tensor([[0.0, 0.05, -largest], [largest, 0, 0], [-0.0, 0, 0.01]])
    spz.write(tmp_path / "a.spz", scene)
    assert (tmp_path / "a.spz").read_bytes()[13] == bits
    assert_close(spz.read(tmp_path / "a.spz").gaussians, scene.gaussians, 2.0**-bits)


def test_values_out_of_range_are_clamped_or_refused(tmp_path):
    path = tmp_path / "a.spz"
    g = random_scene(2, 3).gaussians.map(torch.Tensor.double)
    for tensor in (g.log_scales, g.sh0, g.sh_rest, g.logit_opacities):
        tensor[0], tensor[1] = -1e307, 1e307
    spz.write(path, Scene(g))
    read = spz.read(path).gaussians
    assert read.log_scales[:, 0].tolist() == [-10.0, 255 / 16 - 10]
    assert read.sh0[:, 0, 0].tolist() == pytest.approx([-0.5 / 0.15, 0.5 / 0.15])
    # The half turn changes the sign of the first coefficient but not of the third.
    assert read.sh_rest[:, 2, 0].tolist() == [-1.0, 127 / 128]
    assert read.sh_rest[:, 0, 0].tolist() == [-127 / 128, 1.0]
    assert bool(read.logit_opacities.isfinite().all())
    assert read.opacities.tolist() == pytest.approx([0, 1], abs=HALF_OPACITY)

    far = replace(g, means=torch.tensor([[0.0, 0, 0], [0, 8_388_608.0, 0]]).double())
    before = path.read_bytes()
    with pytest.raises(ArgumentError, match="means: one is 8,388,608 units from the origin"):
        spz.write(path, Scene(far))
    with pytest.raises(ArgumentError, match=r"quats\[1\]: has zero length"):
        spz.write(path, Scene(replace(g, quats=torch.tensor([[1.0, 0, 0, 0], [0, 0, 0, 0]]).double())))
    assert path.read_bytes() == before


def test_quaternions_of_any_length_and_float64(tmp_path):
    given = random_scene(200, 3).gaussians.map(torch.Tensor.double).trainable()
    lengths = 10.0 ** torch.linspace(-300, 300, 200, dtype=torch.float64)
    spz.write(tmp_path / "a.spz", Scene(replace(given, quats=given.quats * lengths[:, None])))
    read = spz.read(tmp_path / "a.spz").gaussians
    assert float(angles(read.quats, given.quats.detach()).max()) <= ANGLE


@pytest.mark.parametrize(("given", "stored"), [(None, False), (False, False), (True, True)])
def test_antialiasing_is_kept_and_up_is_y_unless_an_extension_says_otherwise(tmp_path, given, stored):
    for up, kept in ((None, (0.0, -1.0, 0.0)), ((1.0, 0.0, 0.0), (1.0, 0.0, 0.0))):
        spz.write(tmp_path / "a.spz", random_scene(2, 0, antialiased=given, up=up))
        read = spz.read(tmp_path / "a.spz")
        assert (read.antialiased, read.up) == (stored, kept)


def test_a_half_turned_scene_renders_the_same():
    """Rotated Gaussians in front of the rotated camera give the same image, including view-dependent colour."""
    g = random_scene(40, 15).gaussians.map(torch.Tensor.double)
    camera = Camera.looking_at((1.0, -2.0, -9.0), (0.2, 0.1, 0.0), 30.0, 31.0, 24, 28)
    turn = np.diag((1.0, -1.0, -1.0))
    turned = Camera(camera.R @ turn, turn @ camera.eye, 30.0, 31.0, camera.cx, camera.cy, 24, 28)
    image = render(g, camera, backend="torch").image
    assert float(image.max()) > 0.2
    # Only float64 rounding differs; a wrong sign of a single degree would change the image by about 0.1.
    torch.testing.assert_close(
        render(half_turned(g), turned, backend="torch").image, image, rtol=0, atol=1e-9
    )
    assert float((render(g, turned, backend="torch").image - image).abs().max()) > 0.01
    again = half_turned(half_turned(g))
    assert all(torch.equal(t, again.tensors()[name]) for name, t in g.tensors().items())


# An independent writer of SPZ: every version, splat by splat.


def planes(version, g, bits=12, degree_4=False):
    """Return the streams of a version, for Gaussians in the file's axes."""
    positions, rotations, harmonics = b"", b"", b""
    for i in range(len(g)):
        for value in g.means[i].tolist():
            if version == 1:
                positions += struct.pack("<e", value)
            else:
                positions += round(value * 2**bits).to_bytes(3, "little", signed=True)
        w, x, y, z = (g.quats[i] / g.quats[i].norm()).tolist()
        if version < 3:
            rotations += bytes(round(127.5 * (v if w > 0 else -v) + 127.5) for v in (x, y, z))
        else:
            parts = [x, y, z, w]
            top = max(range(4), key=lambda k: abs(parts[k]))
            word = top
            for k in range(4):
                if k != top:
                    same = (parts[k] < 0) == (parts[top] < 0)
                    word = word << 10 | (0 if same else 512) | round(abs(parts[k]) * 2**0.5 * 511)
            rotations += struct.pack("<I", word)
        values = [round(128 + 128 * v) for v in g.sh_rest[i].flatten().tolist()]
        harmonics += bytes(values) + (bytes(27) if degree_4 else b"")
    return [
        positions,
        bytes(round(255 * o) for o in g.opacities.tolist()),
        bytes(round(38.25 * c + 127.5) for c in g.sh0.flatten().tolist()),
        bytes(round(16 * (s + 10)) for s in g.log_scales.flatten().tolist()),
        rotations,
        harmonics,
    ]


def old_body(version, g, bits=12, flags=0, degree_4=False):
    degree = 4 if degree_4 else g.sh_degree
    header = struct.pack("<4sIIBBBB", b"NGSP", version, len(g), degree, bits, flags, 0)
    return header + b"".join(planes(version, g, bits, degree_4))


def new_file(g, flags=0, zone=b"", degree_4=False):
    streams = [stream for stream in planes(4, g, 12, degree_4) if stream]
    packed = [zstandard.compress(stream) for stream in streams]
    degree, table = 4 if degree_4 else g.sh_degree, 32 + len(zone)
    header = struct.pack("<4sIIBBBBI12x", b"NGSP", 4, len(g), degree, 12, flags, len(streams), table)
    sizes = [struct.pack("<QQ", len(p), len(s)) for p, s in zip(packed, streams, strict=True)]
    return b"".join([header, zone, *sizes, *packed])


# Versions 1 and 2 store x, y, z as bytes, so half a step is 1/255. w >= 1/2 changes by (2 |s| |e| + |e|²) / 2w.
E2 = np.sqrt(3) / 255
ANGLE_2 = 2 * np.hypot(E2, np.sqrt(3) * E2 + E2**2)


@pytest.mark.parametrize("rest", [0, 3, 8, 15])
@pytest.mark.parametrize("version", [1, 2, 3])
def test_older_versions(tmp_path, version, rest):
    g = random_scene(20, rest, seed=version).gaussians
    if version < 3:
        g.quats[:, 0] = 0.6 * g.quats.norm(dim=1) * torch.where(torch.arange(20) % 2 == 0, 1, -1)
    path = tmp_path / "a.spz"
    path.write_bytes(gzip.compress(old_body(version, half_turned(g), flags=1), mtime=0))
    read = spz.read(path)
    assert read.antialiased
    # float16 has 11 significant bits, so half a step of numbers up to 16 is 2^-8.
    assert_close(read.gaussians, g, 2.0**-7 if version == 1 else 2.0**-12, ANGLE if version == 3 else ANGLE_2)
    path.write_bytes(old_body(version, half_turned(g), flags=1))  # not compressed by gzip
    again = spz.read(path).gaussians
    assert all(torch.equal(t, again.tensors()[name]) for name, t in read.gaussians.tensors().items())


def test_nan_and_infinity_are_left_to_the_caller(tmp_path):
    body = bytearray(old_body(1, random_scene(2, 0).gaussians))
    body[16:20] = b"\x01\x7c\x00\xfc"  # a signalling NaN, and minus infinity
    (tmp_path / "a.spz").write_bytes(gzip.compress(bytes(body)))
    assert spz.read(tmp_path / "a.spz").gaussians.finite_rows().tolist() == [False, True]


@pytest.mark.parametrize("version", [3, 4])
def test_the_fourth_degree_is_left_out(tmp_path, version):
    g = random_scene(7, 15).gaussians
    turned = half_turned(g)
    data = (
        new_file(turned, degree_4=True) if version == 4 else gzip.compress(old_body(3, turned, degree_4=True))
    )
    (tmp_path / "a.spz").write_bytes(data)
    assert_close(spz.read(tmp_path / "a.spz").gaussians, g, 2.0**-12)


def record(kind, payload):
    return struct.pack("<II", kind, len(payload)) + payload


@pytest.mark.parametrize("version", [3, 4])
def test_extensions_other_than_axes_are_skipped(tmp_path, version):
    g = random_scene(6, 15).gaussians
    path = tmp_path / "a.spz"

    def write(stored, *records):
        zone = record(0xADBE0002, bytes(12)) + record(0x12340001, b"") + b"".join(records)
        new = (
            new_file(stored, 2, zone) if version == 4 else gzip.compress(old_body(3, stored, flags=2) + zone)
        )
        path.write_bytes(new)

    for axes, stored in ((None, half_turned(g)), (0, half_turned(g)), (4, half_turned(g)), (6, g)):
        write(stored, *([] if axes is None else [record(0xADBE0003, struct.pack("<I", axes))]))
        assert_close(spz.read(path).gaussians, g, 2.0**-12)
    write(g, record(0xADBE0003, struct.pack("<I", 9)))
    assert "its axes (number 9 in the axes extension) are not supported" in refused(path)
    write(half_turned(g), record(0x12340001, b"cut")[:-1])
    assert_close(spz.read(path).gaussians, g, 2.0**-12)


@pytest.fixture
def files(tmp_path):
    """A file of each kind, below 16 KiB."""
    scene = random_scene(120, 15)
    spz.write(tmp_path / "new.spz", scene)
    body = old_body(3, scene.gaussians)
    kinds = {"new": (tmp_path / "new.spz").read_bytes(), "gzip": gzip.compress(body), "bare": body}
    assert all(1000 < len(data) < 16384 for data in kinds.values())
    return kinds


@pytest.mark.parametrize("kind", ["new", "gzip", "bare"])
def test_truncated_and_extended_files_are_refused(tmp_path, files, kind):
    path, whole = tmp_path / "a.spz", files[kind]
    for length in [*range(40), *range(64, len(whole), 64), len(whole) - 1]:
        path.write_bytes(whole[:length])
        refused(path)
    for more in (b"\0", b"garbage", whole):
        path.write_bytes(whole + more)
        assert "follow its last stream" in refused(path) or "more than its header declares" in refused(path)
    path.write_bytes(whole)
    spz.read(path)


@pytest.mark.parametrize("kind", ["new", "gzip", "bare"])
def test_random_damage_is_refused_or_harmless(tmp_path, files, kind):
    path, chance = tmp_path / "a.spz", random.Random(0)
    for _ in range(300):
        data = bytearray(files[kind])
        for _ in range(chance.randint(1, 3)):
            data[chance.randrange(chance.choice((40, 140, len(data))))] = chance.randrange(256)
        path.write_bytes(data)
        try:
            spz.read(path)
        except SceneFormatError as error:
            assert str(error).startswith(f"{path}: ")


@pytest.mark.parametrize(
    ("at", "new", "message"),
    [
        (0, b"PK\x03\x04", "is not an SPZ file: it begins with neither NGSP nor gzip"),
        (0, b"version https://git-lfs.github.com/spec/v1\n", "is a Git LFS pointer"),
        (4, b"\0", "has SPZ version 0, but 1 to 4 are supported"),
        (4, b"\x05", "has SPZ version 5"),
        (8, b"\xff\xff\xff\xff", "claims to hold 279,172,874,175 bytes in a file of"),
        (8, b"\0\0\0\0", "has 6 streams, but its header requires 0"),
        (8, b"\x79", "the number of its positions differs from its header"),
        (12, b"\x05", "its header gives SH degree 5"),
        (12, b"\x02", "the number of its coefficients differs"),
        (12, b"\0", "has 6 streams, but its header requires 5"),
        (13, b"\x19", "its header gives 25 fractional bits"),
        (14, b"\x80", "holds levels of detail"),
        (15, b"\x05", "has 5 streams"),
        (16, b"\x10", "its table of contents extends beyond its end"),
        (16, b"\0\0\0\xff", "its table of contents extends beyond its end"),
        (32, b"\xff\xff\xff\xff\xff\xff\xff\xff", "is truncated within its positions"),
        (128, b"\0\0\0\0", "its positions cannot be unpacked"),
    ],
)
def test_damage_is_named(tmp_path, files, at, new, message):
    data = bytearray(files["new"])
    data[at : at + len(new)] = new
    (tmp_path / "a.spz").write_bytes(data)
    assert message in refused(tmp_path / "a.spz")


def test_bytes_after_the_end_of_a_stream_are_refused(tmp_path):
    g = random_scene(3, 0).gaussians
    data = new_file(g)
    (packed,) = struct.unpack_from("<Q", data, 32)
    end = 112 + packed
    (tmp_path / "a.spz").write_bytes(
        data[:32] + struct.pack("<Q", packed + 2) + data[40:end] + b"!!" + data[end:]
    )
    assert "its positions cannot be unpacked" in refused(tmp_path / "a.spz")


def test_damage_of_older_versions_is_named(tmp_path, files):
    path, body = tmp_path / "a.spz", files["bare"]
    for data, message in (
        (gzip.compress(body.replace(b"NGSP", b"PSGN", 1)), "is not an SPZ file"),
        (gzip.compress(body.replace(b"\x03", b"\x04", 1)), "is of version 4, but in one gzip"),
        (gzip.compress(body + b"!"), "holds more than its header declares"),
        (gzip.compress(body[:-1]), "is truncated: 7,799 of 7,800 bytes are present"),
        (gzip.compress(b""), "is not an SPZ file"),
        (files["gzip"][:-8] + bytes(8), "its gzip cannot be unpacked"),  # checksum
        (body.replace(b"x\0\0\0", b"\xff\xff\xff\xff", 1), "is truncated"),
        (
            gzip.compress(body.replace(b"x\0\0\0", b"\xff\xff\xff\xff", 1)),
            "claims to hold 279,172,874,175 bytes",
        ),
    ):
        path.write_bytes(data)
        assert message in refused(path)


def bombs():
    zeros = bytes(1 << 24)
    one = random_scene(1, 0).gaussians
    yield gzip.compress(old_body(3, one) + zeros)  # it unpacks to more than it declares
    yield gzip.compress(old_body(3, one, flags=2) + zeros)  # the bomb is in the extensions
    # it unpacks to as much as it declares
    yield gzip.compress(old_body(3, one)[:8] + struct.pack("<IBBBB", 1 << 20, 0, 12, 0, 0) + zeros)
    for declared in (True, False):  # the frame may or may not declare its size
        packed = zstandard.ZstdCompressor(write_content_size=declared).compress(zeros)
        data = new_file(one)
        sizes = list(struct.iter_unpack("<QQ", data[32:112]))
        rest = data[112 + sizes[0][0] :]
        yield data[:32] + struct.pack("<QQ", len(packed), 9) + data[48:112] + packed + rest


def test_compression_bombs_are_not_unpacked(tmp_path):
    for i, data in enumerate(bombs()):
        path = tmp_path / f"{i}.spz"
        path.write_bytes(data)
        assert len(data) < 1 << 17
        tracemalloc.start()
        refused(path)
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        assert peak < 1 << 22, "a quarter of the unpacked size"


def test_the_same_scene_as_compressed_ply():
    """Another program wrote these 152,746 splats in both formats, in the same order and with 12 fractional bits."""
    read = spz.read(kept_file("formats/biker.spz"))
    other = compressed_ply.read(kept_file("formats/biker.compressed.ply"))
    assert (len(read.gaussians), read.gaussians.sh_degree, read.antialiased) == (152_746, 0, False)
    there = other.gaussians.log_scales >= -10  # SPZ clamps values outside
    assert float(there.float().mean()) > 0.999
    scales = torch.where(there, other.gaussians.log_scales, read.gaussians.log_scales)
    assert_close(read.gaussians, replace(other.gaussians, log_scales=scales), 2.0**-12)


def test_three_splats_as_ply():
    folder = "metalsplatter_3splats/test-splat.3-points-from-train"
    read = spz.read(kept_file(f"formats/{folder}.spz")).gaussians
    other = ply.load_ply(kept_file(f"formats/{folder}.ply"))
    # Their writer rounded degree 1 to 5 bits and the others to 4: bins of 8 and 16 byte values.
    wide = torch.tensor([8.0] * 3 + [16.0] * 12)[:, None] / 2 / 128 + HALF_HARMONIC
    assert bool(((read.sh_rest - other.sh_rest).abs() <= wide).all())
    assert_close(replace(read, sh_rest=other.sh_rest.contiguous()), other, 2.0**-12)


@pytest.mark.parametrize(("name", "z"), [("raw", 1), ("v2", 1), ("v3", -1), ("v4", -1)])
def test_minimal_files_from_other_programs(name, z):
    """The scene is four corners of a square. The first two files' writers use the opposite sign of z."""
    read = spz.read(kept_file(f"formats/splat_fixtures/minimal-{name}.spz")).gaussians
    assert read.sh_degree == 0
    assert read.means.tolist() == [[-1, 0, z], [0, 0, z], [-1, 0, 0], [0, 0, 0]]
    assert float(angles(read.quats, torch.tensor([[1.0, 0, 0, 0]]).repeat(4, 1)).max()) <= ANGLE_2


def test_a_coarse_precision_rounds_positions_and_coefficients_and_zero_stays_zero(tmp_path):
    """The tolerances follow from the definition: half a step of the bits that are kept."""
    scene = random_scene(500, 15)
    scene.gaussians.sh_rest[:7] = 0.0
    path = tmp_path / "a.spz"
    path.write_bytes(spz.packed(scene, spz.Precision(1 / 32, (5, 4))))
    back = spz.read(path).gaussians
    step = 2.0 ** np.floor(np.log2(scene.gaussians.log_scales.median().exp().item() / 32))
    places = back.means.double().numpy() / step
    np.testing.assert_array_equal(places, np.rint(places))
    assert float((back.means - scene.gaussians.means).abs().max()) <= step / 2 * 1.0001
    given = scene.gaussians.sh_rest.clamp(-1.0, 0.96)
    errors = (back.sh_rest.clamp(-1.0, 0.96) - given).abs()
    assert float(errors[:, :3].max()) <= 0.5 / 16 + 1e-6 and float(errors[:, 3:].max()) <= 0.5 / 8 + 1e-6
    assert float(back.sh_rest[:7].abs().max()) == 0.0
    assert path.stat().st_size < 0.75 * len(spz.packed(scene))
