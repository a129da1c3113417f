from dataclasses import replace

import pytest
import torch

from gsplat_edu.io.edit import Similarity
from gsplat_edu.io.formats import file_in, losses, read_scene, stored_bytes, write_scene
from scene_files import matched, random_scene, suffixes

STEPS = {"means": 8 / 2**11, "log_scales": 1 / 16, "sh0": 0.03, "sh_rest": 8 / 256}
"""11 bits over a chunk's 8 units, bytes over 16 units, over the colours of SPZ, and over 8 units."""


@pytest.fixture
def threads():
    before = torch.get_num_threads()
    yield torch.set_num_threads
    torch.set_num_threads(before)


@pytest.mark.parametrize("suffix", suffixes())
def test_bytes_do_not_depend_on_threads(tmp_path, threads, suffix):
    """The scene has 40,000 splats, because torch splits work on more than 32,768 numbers among threads."""
    move = Similarity.of_matrix([[0, 0, 1, 0.1], [1, 0, 0, 0.2], [0, 1, 0, 0.3]])
    written = []
    for count in (1, 2):
        threads(count)
        path = tmp_path / f"{count}{suffix}"
        write_scene(path, move.scene(random_scene(40_000, rest=3)))
        written.append(path.read_bytes())
    assert written[0] == written[1]


@pytest.mark.parametrize("suffix", suffixes())
def test_a_second_round_trip_gives_the_same_scene(tmp_path, suffix):
    write_scene(tmp_path / f"1{suffix}", random_scene(300))
    first = read_scene(tmp_path / f"1{suffix}")
    write_scene(tmp_path / f"2{suffix}", first)
    again = read_scene(tmp_path / f"2{suffix}")
    assert (again.antialiased, again.up) == (first.antialiased, first.up)
    same = matched(first.gaussians, again.gaussians)
    # The second rounding moves a value by at most one step of the coarsest format.
    for name, step in STEPS.items():
        moved = same.tensors()[name] - again.gaussians.tensors()[name]
        assert not moved.numel() or moved.abs().max() <= step, name
    assert (same.opacities - again.gaussians.opacities).abs().max() <= 1 / 255


@pytest.mark.parametrize("suffix", suffixes())
def test_trainable_doubles_are_written_like_floats(tmp_path, suffix):
    scene = random_scene(300)
    for name, gaussians in (
        ("a", scene.gaussians),
        ("b", scene.gaussians.map(torch.Tensor.double).trainable()),
    ):
        write_scene(tmp_path / f"{name}{suffix}", replace(scene, gaussians=gaussians))
    assert (tmp_path / f"a{suffix}").read_bytes() == (tmp_path / f"b{suffix}").read_bytes()


def test_losses_of_a_format_are_reported(tmp_path):
    scene = random_scene(3)
    assert losses("a.ply", scene) == []
    assert "up to degree 0; degrees up to 3 are dropped" in losses("a.splat", scene)[0]


@pytest.mark.parametrize("suffix", suffixes())
@pytest.mark.parametrize("antialiased", [False, True])
def test_antialiasing_is_kept_or_reported_lost(tmp_path, suffix, antialiased):
    scene = replace(random_scene(3, 0), antialiased=antialiased)
    write_scene(tmp_path / f"a{suffix}", scene)
    kept = read_scene(tmp_path / f"a{suffix}").antialiased
    said = [note for note in losses(f"a{suffix}", scene) if "antialiased" in note]
    assert len(said) == (0 if bool(kept) == antialiased else 1)


def test_an_unpacked_sog_is_read_by_its_folder_or_its_meta_json(tmp_path):
    path = tmp_path / "scene" / "meta.json"
    write_scene(path, random_scene(30))
    for name in (path, path.parent):
        assert len(read_scene(name).gaussians) == 30
    assert stored_bytes(path) == sum(file.stat().st_size for file in path.parent.iterdir())


@pytest.mark.parametrize(
    ("files", "found"),
    [
        (
            ["cfg_args", "input.ply", *(f"point_cloud/iteration_{n}/point_cloud.ply" for n in (7000, 30000))],
            "point_cloud/iteration_30000/point_cloud.ply",
        ),
        (["cfg.yml", "ply/point_cloud_6999.ply", "ply/point_cloud_29999.ply"], "ply/point_cloud_29999.ply"),
        (["splat.ply"], "splat.ply"),
        (["splat.ply", "images/a.jpg"], None),
        (["config.json", "point_cloud/iteration_30/point_cloud.ply"], None),
    ],
    ids=["Kerbl et al.", "gsplat", "nerfstudio", "a capture", "a run of ours"],
)
def test_the_folder_of_another_programs_model_is_its_last_scene(tmp_path, files, found):
    for name in files:
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).touch()
    assert file_in(tmp_path) == (tmp_path if found is None else tmp_path / found)
    if found is not None:
        write_scene(tmp_path / found, random_scene(5))
        assert len(read_scene(tmp_path).gaussians) == 5
