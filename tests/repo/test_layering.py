"""The import contracts of pyproject.toml hold, and detect violations; only one room opens and decodes photos."""

import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]


def lint(folder):
    """Run the contracts on a copy of the package, into which a test may write an import."""
    # otherwise Python finds an editable installation before the copy
    code = (
        "import sys; sys.path.insert(0, 'src'); "
        "sys.meta_path[:] = [f for f in sys.meta_path if 'ScikitBuild' not in type(f).__name__]; "
        "import importlinter.cli as c; c.lint_imports_command()"
    )
    command = [sys.executable, "-c", code]
    return subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)


@pytest.fixture
def copy(tmp_path):
    shutil.copytree(ROOT / "src", tmp_path / "src", ignore=shutil.ignore_patterns("__pycache__"))
    shutil.copy(ROOT / "pyproject.toml", tmp_path)
    return tmp_path


def test_the_contracts_hold(copy):
    done = lint(copy)
    assert done.returncode == 0, done.stdout
    assert "0 broken" in done.stdout


@pytest.mark.parametrize(
    ("file", "line"),
    [
        ("scene/camera.py", "import gsplat_edu.ops.kernels"),
        ("train/trainer.py", "import gsplat_edu.data.synthetic"),
        ("train/trainer.py", "import gsplat_edu.cli.main"),
        ("train/density/surgery.py", "import gsplat_edu.render.torch.render"),
        ("train/optimizer.py", "from gsplat_edu.render.cuda.adam import adam_triton"),
        ("train/optimizer.py", "import gsplat_edu.ops.kernels"),
        ("render/torch/render.py", "import gsplat_edu.render.numpy_reference"),
        ("scene/sh.py", "import torch"),
        ("cli/main.py", "from lab.captures import solids"),
        ("ops/losses.py", "import gsplat_edu.data"),
        ("survey/finding.py", "import gsplat_edu.parts.sky.part"),
        ("train/density/surgery.py", "import gsplat_edu.train.density.adc"),
    ],
)
def test_a_planted_import_breaks_a_contract(copy, file, line):
    path = copy / "src" / "gsplat_edu" / file
    path.write_text(path.read_text() + f"\n{line}\n")
    done = lint(copy)
    assert done.returncode == 1, done.stdout
    assert "0 broken" not in done.stdout


def test_a_new_module_has_to_be_given_a_layer(copy):
    (copy / "src" / "gsplat_edu" / "helpers.py").write_text("")
    assert lint(copy).returncode == 1


def test_only_photos_opens_image_files_and_decodes_photos():
    """Elsewhere, headers are read for facts that only one room wants, and what is decoded is no photo."""
    allowed = {
        "sfm/photos.py": "focal length, camera and place in EXIF",
        "sfm/panoramas.py": "XMP of a panorama",
        "data/depth_files.py": "depths",
        "data/depth_folder.py": "confidences of depths",
        "evaluate/comparison.py": "pictures of a run, which this program wrote",
        "io/mesh_image.py": "textures",
        "io/sog/files.py": "numbers of splats",
    }
    package = ROOT / "src" / "gsplat_edu"
    texts = {path.relative_to(package).as_posix(): path.read_text() for path in package.rglob("*.py")}
    outside = {name: text for name, text in texts.items() if not name.startswith("photos/")}
    by_themselves = re.compile(r"\bImage\.open\b|\bimread\b|\bimdecode\b|\bHeifImageFile\b")
    assert by_themselves.search(texts["photos/image_files.py"])
    assert not [name for name, text in outside.items() if by_themselves.search(text)]
    assert {name for name, text in outside.items() if "opened_image" in text} == set(allowed)
