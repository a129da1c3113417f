"""Two commands never write one output at the same time: the second is refused in one line, and loses nothing."""

import subprocess
import sys
import time
from types import SimpleNamespace

import pytest

from gsplat_edu.base.locks import locked_file
from gsplat_edu.cli.main import main
from gsplat_edu.data.procedural import procedural_capture
from gsplat_edu.data.writers import write_colmap
from gsplat_edu.io.formats import read_scene, write_scene
from scene_files import make_run, random_scene
from splat_ball import ball

pytestmark = pytest.mark.slow

WAITS = """
import sys
from gsplat_edu.cli.main import main
from gsplat_edu.viewer import export
write = export.write

def waiting(*words):
    print("writing", flush=True)
    sys.stdin.readline()
    write(*words)

export.write = waiting
sys.exit(main(sys.argv[1:]))
"""
"""The command line, which waits for a line of its input before it writes a scene."""


def tree(folder):
    return {path.relative_to(folder): path.is_file() and path.read_bytes() for path in folder.rglob("*")}


@pytest.mark.own_process
@pytest.mark.parametrize("name", ["web/meta.json", "web/lod-meta.json", "web/tileset.json", "out.ply"])
def test_of_two_conversions_to_one_output_the_second_is_refused(tmp_path, capsys, name):
    """Both would write files of the same names into one folder."""
    for i, count in enumerate((300, 200)):
        write_scene(tmp_path / f"{i}.ply", random_scene(count, seed=i))
    out, expected = tmp_path / "out" / name, tmp_path / "expected" / name
    assert main(["convert", str(tmp_path / "0.ply"), str(expected)]) == 0
    words = [sys.executable, "-c", WAITS, "convert", str(tmp_path / "0.ply"), str(out)]
    first = subprocess.Popen(
        words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    try:
        while (line := first.stdout.readline()) != "writing\n":
            assert line, first.stderr.read()
        capsys.readouterr()
        assert main(["convert", str(tmp_path / "1.ply"), str(out)]) == 2
        said = capsys.readouterr().err
        assert f"OUT: {out} is in use by `gsplat-edu convert`, process {first.pid} " in said
        assert said.count("\n") == 1
        other = out.with_name("other.ply")
        assert main(["convert", str(tmp_path / "1.ply"), str(other)]) == 0  # another file of the folder
        assert len(read_scene(other).gaussians) == 200
        other.unlink()
        _, complained = first.communicate("\n", timeout=300)
        assert first.returncode == 0, complained
    finally:
        first.kill()
        first.communicate()
    assert tree(tmp_path / "out") == tree(tmp_path / "expected")


def test_a_mesh_with_its_material_and_image_has_one_writer(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("gsplat_edu.cli.mesh.ORBIT_VIEWS", 20)
    monkeypatch.setattr("gsplat_edu.cli.mesh.ORBIT_SIZE", 160)
    write_scene(tmp_path / "ball.ply", ball())
    out = tmp_path / "ball.obj"
    words = ["mesh", str(tmp_path / "ball.ply"), str(out), "--voxel", "0.1", "--backend", "cpu"]
    out.write_text("written by the other command")
    with locked_file("OUT", out, "gsplat-edu mesh", pytest.fail):
        assert main(words) == 2
    said = capsys.readouterr().err
    assert f"OUT: {out} is in use by `gsplat-edu mesh`" in said and said.count("\n") == 1
    assert out.read_text() == "written by the other command"
    assert main(words) == 0
    assert sorted(path.name for path in tmp_path.iterdir()) == ["ball.obj", "ball.ply"]


def test_a_cleaned_scene_has_one_writer(tmp_path, capsys):
    run, *_ = make_run(tmp_path / "run")
    out = tmp_path / "cleaned.ply"
    with locked_file("--out", out, "gsplat-edu clean", pytest.fail):
        assert main(["clean", str(run.path), "--out", str(out)]) == 2
    said = capsys.readouterr().err
    assert f"--out: {out} is in use by `gsplat-edu clean`" in said and said.count("\n") == 1
    assert not out.exists()


def test_a_training_waits_with_its_export_for_another_that_writes_the_same_files(tmp_path, monkeypatch):
    """What a training has reached is not lost for a file that is in use: it is written after the other's."""
    write_colmap(tmp_path / "capture", *procedural_capture(24, 6, splats=40))
    out = tmp_path / "web" / "meta.json"
    held = locked_file("--export", out, "gsplat-edu train", pytest.fail)
    held.__enter__()
    out.write_text("written by the other command")
    waited = []

    def ends(seconds):
        waited.append(out.read_text())
        held.__exit__(None, None, None)

    clock = SimpleNamespace(**(vars(time) | {"sleep": ends}))
    monkeypatch.setattr("gsplat_edu.base.locks.time", clock)
    words = ["train", tmp_path / "capture", "--out", tmp_path / "run", "--iterations", 5, "--export", out]
    assert main([str(word) for word in words]) == 0
    assert waited == ["written by the other command"]
    assert len(read_scene(out).gaussians)
