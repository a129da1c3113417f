"""A wheel with this machine's module is packed, installed into an empty environment, and used. The module is the one
that the set-up compiled from this checkout. `make wheels` compiles others, which takes minutes.
"""

import base64
import email.parser
import hashlib
import json
import os
import re
import shutil
import struct
import subprocess
import sys
import sysconfig
import venv
import zipfile
from importlib.metadata import distribution
from pathlib import Path

import nanobind
import pytest

import build_wheels
import gsplat_edu._native
from wheels import binaries, checks, repeat
from wheels.contents import nanobind_parts
from wheels.pack import pack

ROOT = Path(__file__).parents[2]

FAST_TESTS = (
    *("tests/test_camera.py", "tests/io/test_ply.py"),
    "tests/native/test_parity.py::test_every_sh_degree_matches_the_reference",
    "tests/viewer/test_content_policy.py",
)
"""Tests of the references, the kernels, the formats, and the files of the package that are not Python."""

ONLY_INSTALLED = """
from pathlib import Path
import sys, gsplat_edu, gsplat_edu._native as native
for module in (gsplat_edu, native):
    assert Path(module.__file__).is_relative_to(sys.prefix), module.__file__
"""


@pytest.fixture(scope="module")
def module():
    """The name and bytes of the compiled module."""
    path = Path(gsplat_edu._native.__file__)
    return path.name, path.read_bytes()


@pytest.fixture(scope="module")
def pure(tmp_path_factory):
    return build_wheels.pure_wheel(tmp_path_factory.mktemp("build"))


@pytest.fixture(scope="module")
def wheel(module, pure, tmp_path_factory):
    platform = sysconfig.get_platform().replace("-", "_").replace(".", "_")
    tag = f"cp3{sys.version_info.minor}-cp3{sys.version_info.minor}-{platform}"
    return pack(pure, module, tag, nanobind_parts(), tmp_path_factory.mktemp("dist"))


@pytest.fixture(scope="module")
def installed(wheel, tmp_path_factory):
    """A virtual environment with the wheel and this environment's dependencies, but not its gsplat_edu."""
    folder = tmp_path_factory.mktemp("installed") / "venv"
    venv.create(folder, symlinks=True)
    python = folder / "bin" / "python"
    words = ["install", "--quiet", "--no-deps", "--no-index", "--disable-pip-version-check", wheel]
    done = subprocess.run(
        [sys.executable, "-m", "pip", "--python", python, *words], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    (site,) = folder.glob("lib/python3.*/site-packages")
    # Python ignores .pth files, such as that of an editable installation, in a folder that a .pth file adds.
    (site / "dependencies.pth").write_text(sysconfig.get_paths()["purelib"] + "\n")
    return folder


def run_installed(installed, *words, cwd):
    """Run a program of the environment; PATH has only that environment, so no compiler."""
    env = {name: value for name, value in os.environ.items() if not name.startswith(("PYTHON", "GSPLAT"))}
    env |= {"PATH": str(installed / "bin"), "OMP_NUM_THREADS": "1"}
    return subprocess.run(
        [installed / "bin" / words[0], *words[1:]],
        cwd=cwd,
        env=env,
        capture_output=True,
        text=True,
        check=False,
    )


@pytest.mark.slow
def test_the_demo_runs_from_the_wheel_without_a_compiler(installed, tmp_path):
    done = run_installed(installed, "python", "-c", ONLY_INSTALLED, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    done = run_installed(installed, "gsplat-edu", "demo", "--iters", "50", "--size", "48", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert {path.name for path in (tmp_path / "out").iterdir()} == {
        "sphere.png",
        "sphere_curves.png",
        "sphere.ply",
    }


@pytest.mark.slow
def test_fast_tests_pass_on_the_installed_package(installed, tmp_path):
    # this plugin fails the run if it tested another gsplat_edu
    lines = "".join(f"    {line}\n" for line in ONLY_INSTALLED.splitlines())
    (tmp_path / "only_installed.py").write_text(f"def pytest_sessionfinish():\n{lines}")
    words = [
        f"--rootdir={ROOT}",
        f"--config-file={ROOT / 'pyproject.toml'}",
        "-o",
        "pythonpath=tests conformance .",
    ]
    words += ["-q", "-x", "-p", "no:cacheprovider", "-p", "only_installed", "-m", "not own_process"]
    done = run_installed(
        installed, "python", "-m", "pytest", *words, *(ROOT / name for name in FAST_TESTS), cwd=tmp_path
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert " passed" in done.stdout


NEWER = {version: path for version, path in build_wheels.pythons().items() if version != "3.11"}


@pytest.mark.slow
@pytest.mark.skipif(not NEWER, reason="no Python 3.12 or newer is here, whose headers the stable ABI needs")
def test_one_abi3_wheel_is_imported_by_every_newer_python(pure, tmp_path):
    """Only nanobind and the bindings depend on Python and are compiled again; other object files are the set-up's."""
    objects = ROOT.glob("build/cp3*/CMakeFiles/*.dir/native/*.o")
    rest = [path for path in objects if not path.name.startswith("bindings")]
    assert len(rest) > 10, "make clean, then make test, compiles them"
    oldest = min(NEWER, key=lambda version: int(version.split(".")[1]))
    code = "import sysconfig; print(sysconfig.get_paths()['include'])"
    done = subprocess.run([NEWER[oldest], "-c", code], capture_output=True, text=True, check=True)
    include = Path(nanobind.include_dir())
    folders = [done.stdout.strip(), include, include.parent / "ext" / "robin_map" / "include"]
    options = ["-std=c++20", "-O0", "-fPIC", "-fvisibility=hidden", "-fno-strict-aliasing"]
    options += ["-DPy_LIMITED_API=0x030C0000", "-DNDEBUG", "-include", "Python.h", "-include", "stdio.h"]
    sources = [*(ROOT / "native").glob("bindings*.cpp"), include.parent / "src" / "nb_combined.cpp"]
    made = tmp_path / "_native.abi3.so"
    words = ["c++", *options, *(f"-I{folder}" for folder in folders), *sources, *rest]
    subprocess.run([*words, "-shared", "-pthread", "-s", "-o", made], check=True)

    listed = subprocess.run(
        ["nm", "-D", "--undefined-only", made], capture_output=True, text=True, check=True
    )
    asked = {name for name in re.findall(r" U (\w+)", listed.stdout) if name.startswith(("Py", "_Py"))}
    assert len(asked) > 50
    assert asked - binaries.stable_abi(12) == set()
    platform = sysconfig.get_platform().replace("-", "_").replace(".", "_")
    wheel = pack(pure, (made.name, made.read_bytes()), f"cp312-abi3-{platform}", nanobind_parts(), tmp_path)
    assert {version: build_wheels.imported(wheel, path) for version, path in NEWER.items()} == dict.fromkeys(
        NEWER, ""
    )


def test_a_wheel_has_every_file_of_the_package(wheel):
    package = ROOT / "src" / "gsplat_edu"
    wanted = {
        f"gsplat_edu/{path.relative_to(package).as_posix()}"
        for path in package.rglob("*")
        if path.is_file() and "__pycache__" not in path.parts and path.suffix != ".so"
    }
    names = set(zipfile.ZipFile(wheel).namelist())
    assert {n for n in names if n.startswith("gsplat_edu/")} == wanted | {
        f"gsplat_edu/{Path(gsplat_edu._native.__file__).name}"
    }


def test_wheels_have_no_modules_that_only_tests_and_benchmarks_use(wheel):
    archive = zipfile.ZipFile(wheel)
    packed = {archive.read(name) for name in archive.namelist()}
    captures = {path.name: path.read_bytes() for path in (ROOT / "lab" / "captures").glob("[!_]*.py")}
    assert {"city.py", "garden.py", "outdoors.py", "plant.py", "solids.py"} <= captures.keys()
    assert not [name for name, data in captures.items() if data in packed]


def imports(source, module):
    """Return whether a Python file imports a module or names of it."""
    package, _, name = module.rpartition(".")
    found = rf"(from|import) {re.escape(module)}\b|from {re.escape(package)} import [^\n]*\b{name}\b"
    return re.search(found, source.read_text()) is not None


@pytest.mark.slow
@pytest.mark.parametrize("room", ["data", "clean"])
def test_packages_that_had_fixtures_have_only_modules_for_users(room):
    """Each module of these packages is imported by the package, or used in the course or the documents."""
    package = ROOT / "src" / "gsplat_edu"
    sources = list(package.rglob("*.py"))
    shown = [*ROOT.glob("notebooks/source/*.py"), ROOT / "README.md", *ROOT.glob("docs/**/*.md")]
    text = "".join(path.read_text() for path in shown)
    modules = {path: f"gsplat_edu.{room}.{path.stem}" for path in (package / room).glob("*.py")}
    del modules[package / room / "__init__.py"]
    assert len(modules) > 3
    for path, module in modules.items():
        users = [source for source in sources if source != path and imports(source, module)]
        assert users or module in text, f"{module}: only tests use it; move it to lab/captures"


def test_the_same_content_makes_the_same_wheel(wheel, module, tmp_path):
    """The build backend packs the package again, without adding a time or a folder."""
    again = pack(
        build_wheels.pure_wheel(tmp_path),
        module,
        "-".join(wheel.stem.split("-")[-3:]),
        nanobind_parts(),
        tmp_path,
    )
    assert again.name == wheel.name
    assert hashlib.sha256(again.read_bytes()).hexdigest() == hashlib.sha256(wheel.read_bytes()).hexdigest()


def compiled(folder):
    """Compile some files of the module, both kernels and others, from a copy of the checkout."""
    shutil.copytree(ROOT / "native", folder / "native")
    shutil.copyfile(ROOT / "CMakeLists.txt", folder / "CMakeLists.txt")
    tools = Path(sys.executable).parent
    options = [f"-DPython_EXECUTABLE={sys.executable}", f"-DCMAKE_MAKE_PROGRAM={tools / 'ninja'}"]
    words = [tools / "cmake", "-S", folder, "-B", folder / "build", "-G", "Ninja", *options]
    subprocess.run(words, check=True, capture_output=True)
    kernels = re.findall(r"kernels_\w+", (folder / "build" / "build.ninja").read_text())[0]
    objects = [f"CMakeFiles/{kernels}.dir/native/{name}.cpp.o" for name in ("adam", "table")]
    objects += [f"CMakeFiles/_native.dir/native/{name}.cpp.o" for name in ("dispatch", "system")]
    subprocess.run([tools / "ninja", "-C", folder / "build", *objects], check=True, capture_output=True)
    return {name: (folder / "build" / name).read_bytes() for name in objects}


@pytest.mark.slow
def test_the_compiler_gives_the_same_bytes_in_every_folder(tmp_path):
    """`make wheels REPEAT=1` compares the whole module."""
    first, second = compiled(tmp_path / "one"), compiled(tmp_path / "another" / "folder")
    assert [name for name in first if first[name] != second[name]] == []


@pytest.mark.slow
def test_differences_between_two_wheels_are_named(module, pure, tmp_path):
    tag = "cp311-cp311-linux_x86_64"
    wheel, same = (pack(pure, module, tag, [], tmp_path / name) for name in ("one", "two"))
    assert repeat.differences(wheel, same) == []
    other = pack(pure, (module[0], module[1] + b"x"), tag, nanobind_parts(), tmp_path / "three")
    found = {name.rsplit("/", 1)[1] for name in repeat.differences(wheel, other)}
    assert found == {module[0], "RECORD", "gsplat_edu.cdx.json", "nanobind.txt", "robin-map.txt"}
    moved = tmp_path / "moved.whl"
    with zipfile.ZipFile(wheel) as archive, zipfile.ZipFile(moved, "w") as copy:
        for name in reversed(archive.namelist()):
            copy.writestr(name, archive.read(name))
    assert repeat.differences(wheel, moved) == ["the order, the times or the compression of the files"]


def test_the_time_of_every_file_is_the_one_asked_for(module, pure, tmp_path, monkeypatch):
    monkeypatch.setenv("SOURCE_DATE_EPOCH", "1700000000")
    made = pack(pure, module, "cp311-cp311-linux_x86_64", [], tmp_path)
    assert {entry.date_time for entry in zipfile.ZipFile(made).infolist()} == {(2023, 11, 14, 22, 13, 20)}


def test_the_record_lists_every_file_with_its_hash(wheel):
    """The test follows the format's definition instead of the tool's own check."""
    archive = zipfile.ZipFile(wheel)
    (record,) = (name for name in archive.namelist() if name.endswith("/RECORD"))
    rows = dict(line.rsplit(",", 2)[:2] for line in archive.read(record).decode().splitlines())
    assert rows.pop(record) == ""
    assert set(rows) | {record} == set(archive.namelist())
    for name, stated in rows.items():
        raw = base64.urlsafe_b64encode(hashlib.sha256(archive.read(name)).digest()).decode().rstrip("=")
        assert stated == f"sha256={raw}", name


def test_the_bill_of_materials_names_what_is_linked_and_what_is_required(wheel, module):
    archive = zipfile.ZipFile(wheel)
    (name,) = (name for name in archive.namelist() if name.endswith(".cdx.json"))
    assert ".dist-info/sboms/" in name
    bill = json.loads(archive.read(name))
    (metadata,) = (name for name in archive.namelist() if name.endswith(".dist-info/METADATA"))
    stated = email.parser.Parser().parsestr(archive.read(metadata).decode())
    assert (bill["bomFormat"], bill["specVersion"]) == ("CycloneDX", "1.6")
    assert bill["metadata"]["component"]["version"] == stated["Version"] == gsplat_edu.__version__
    by_name = {component["name"]: component for component in bill["components"]}
    assert by_name["nanobind"]["licenses"] == [{"expression": "BSD-3-Clause"}]
    required = {line.split(">")[0] for line in stated.get_all("Requires-Dist") if ";" not in line}
    assert {n for n, component in by_name.items() if component.get("scope") == "required"} == required
    assert by_name[f"gsplat_edu/{module[0]}"]["hashes"][0]["content"] == hashlib.sha256(module[1]).hexdigest()
    refs = {component["bom-ref"] for component in bill["components"]}
    assert len(refs) == len(bill["components"])
    assert set(bill["dependencies"][0]["dependsOn"]) == refs


def test_the_licence_of_everything_linked_is_in_the_wheel(wheel):
    archive = zipfile.ZipFile(wheel)
    texts = {
        Path(n).name: archive.read(n).decode() for n in archive.namelist() if ".dist-info/licenses/" in n
    }
    assert "Apache License" in texts["LICENSE"]
    assert "Wenzel Jakob" in texts["nanobind.txt"]
    assert "Permission is hereby granted" in texts["robin-map.txt"]


def test_the_module_names_no_folder_of_this_machine(wheel):
    assert checks.named_folders(wheel) == []


def test_a_folder_and_a_changed_file_are_found(module, pure, tmp_path):
    bad = pack(pure, (module[0], module[1] + bytes(ROOT)), "cp311-cp311-linux_x86_64", [], tmp_path)
    assert any(str(ROOT) in line for line in checks.named_folders(bad))
    assert checks.wrong_hashes(bad) == []
    with zipfile.ZipFile(bad, "a") as archive:
        archive.writestr("gsplat_edu/added.py", "")
    assert checks.wrong_hashes(bad) == ["gsplat_edu/added.py"]


def test_every_document_states_the_same_version():
    for name in ("CITATION.cff", "packaging/conda/recipe.yaml"):
        (stated,) = re.findall(r"^ *version: \"?(\d[\d.]*)", (ROOT / name).read_text(), re.M)
        assert stated == gsplat_edu.__version__, name
    assert f"gsplat_edu-{gsplat_edu.__version__}-" in (ROOT / "docs" / "INSTALL.md").read_text()


def macho(symbols, library=binaries.MACOS_LIBRARY, kind=6, oldest=(13, 0), signed=True):
    """Return a 64-bit Mach-O file. A symbol is a name and the number of its library, or None if it defines it."""
    path = library.encode() + b"\0" * (8 - len(library) % 8)
    commands = [
        struct.pack("<6I", 0xC, 24 + len(path), 24, 0, 0, 0) + path,
        struct.pack("<6I", 0x32, 24, 1, oldest[0] << 16 | oldest[1] << 8, 0, 0),
    ]
    commands += [struct.pack("<4I", 0x1D, 16, 0, 0)] if signed else []
    start = 32 + sum(map(len, commands)) + 24
    names, rows = b"\0", b""
    for name, number in symbols:
        own = number is None
        rows += struct.pack("<IBBHQ", len(names), 0x0F if own else 0x01, 0, 0 if own else number << 8, 0)
        names += name.encode() + b"\0"
    commands.append(struct.pack("<6I", 0x2, 24, start, len(symbols), start + len(rows), len(names)))
    size = sum(map(len, commands))
    head = struct.pack("<8I", 0xFEEDFACF, 0x0100000C, 0, kind, len(commands), size, 0, 0)
    return head + b"".join(commands) + rows + names


GOOD = [("_PyInit__native", None), ("_malloc", 1), ("_PyList_New", 0xFE)]


@pytest.mark.parametrize(
    ("symbols", "options", "wrong"),
    [
        (GOOD, {}, []),
        (GOOD[1:], {}, ["does not export PyInit__native"]),
        ([*GOOD, ("_new_in_macos_27", 1)], {}, ["_new_in_macos_27 is not in libSystem"]),
        # since Python 3.13
        (
            [*GOOD, ("_PyList_GetItemRef", 0xFE)],
            {},
            ["_PyList_GetItemRef is not in the stable ABI"],
        ),
        ([*GOOD, ("_PyDict_Clear", 0)], {}, []),
        (GOOD, {"library": "/opt/lib/libc++.1.dylib"}, ["loads /opt/lib/libc++.1.dylib"]),
        (GOOD, {"oldest": (14, 2)}, ["needs macOS 14.2"]),
        (GOOD, {"signed": False}, ["is not signed"]),
        (GOOD, {"kind": 8}, ["is no dynamic library"]),
    ],
)
def test_the_symbols_that_a_module_needs_from_macos_are_found(monkeypatch, symbols, options, wrong):
    # zig, which has the list, is not installed
    monkeypatch.setattr(binaries, "system_symbols", lambda: {"_malloc", "_free"})
    assert binaries.macos_problems(macho(symbols, **options), 12, (13, 0), arm=True) == wrong


def test_a_windows_program_is_not_accepted_as_a_module():
    """A launcher of setuptools is a program for x86-64, but not a module of Python."""
    (launcher,) = (path for path in distribution("setuptools").files if path.name == "cli-64.exe")
    found = binaries.windows_problems(Path(launcher.locate()).read_bytes(), 12)
    assert found[-1] == "does not export PyInit__native"
    assert "is not for x86-64" not in found
