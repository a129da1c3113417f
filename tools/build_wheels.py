"""Build the wheels that this machine can build, check them, and say which it could not.

    python tools/build_wheels.py [--out dist] [--targets linux-x86_64 ...] [--build build/wheels] [--repeat]

zig compiles and links for every platform: for Linux against glibc 2.17, for macOS and Windows against the interfaces
that it ships. The wheel cp312-abi3 serves Python 3.12 and newer and needs an interpreter from 3.12 on here; the wheel
cp311 needs Python 3.11. PATH and pyenv's folder are searched for both. Every wheel is checked (tools/wheels/checks.py);
a wheel for this machine is also imported by each Python found. With --repeat, every target is built a second time,
from a copy of the checkout in another folder, and has to give the same bytes. Exits with 1 if a wheel was asked for
and did not come out, or came out differently.
"""

from __future__ import annotations

import argparse
import os
import platform
import re
import shlex
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT / "tools"))

import build_wasm  # noqa: E402
from wheels.checks import problems  # noqa: E402
from wheels.contents import nanobind_parts, zig_parts  # noqa: E402
from wheels.pack import pack  # noqa: E402
from wheels.repeat import unrepeated  # noqa: E402
from wheels.targets import TARGETS, Target  # noqa: E402
from wheels.windows import windows_python  # noqa: E402

FOR_MACOS = """\
for word; do
    shift
    case "$word" in
        -Wl,@*) ;;
        -bundle) set -- "$@" -dynamiclib ;;
        *) set -- "$@" "$word" ;;
    esac
done
"""
"""Shell: replace what CMake and nanobind ask of Apple's linker and zig's cannot do. It reads no lists of symbols;
nanobind's holds those of Python, which one option for all of them covers. A bundle makes it fault; Python imports a
dynamic library just the same."""


class NotBuiltError(Exception):
    """A wheel could not be built; the message says why in one line."""


def pythons() -> dict[str, Path]:
    """Return interpreters of CPython from 3.11 on, by version such as "3.12"."""
    folders = [Path(folder) for folder in os.environ.get("PATH", "").split(os.pathsep) if folder]
    folders += sorted(Path(os.environ.get("PYENV_ROOT", Path.home() / ".pyenv")).glob("versions/3.*/bin"))
    code = "import sys; print(sys.implementation.name, '%d.%d' % sys.version_info[:2], sys.executable)"
    found: dict[str, Path] = {}
    for folder in [Path(sys.executable).parent, *folders]:
        for path in sorted(folder.glob("python3.[0-9]*[0-9]")):
            if path.name.removeprefix("python") in found or not os.access(path, os.X_OK):
                continue
            done = subprocess.run([path, "-c", code], capture_output=True, text=True, check=False)
            words = done.stdout.split(maxsplit=2)
            if done.returncode == 0 and words[0] == "cpython" and int(words[1].split(".")[1]) >= 11:
                found.setdefault(words[1], Path(words[2].strip()))
    return found


def run(words: list[object], log: Path, cwd: Path = ROOT) -> None:
    """Run a command, its output into a file; raise NotBuiltError with its last line if it fails."""
    with log.open("a") as file:
        print(shlex.join(map(str, words)), file=file, flush=True)
        done = subprocess.run([*map(str, words)], cwd=cwd, stdout=file, stderr=subprocess.STDOUT, check=False)
    if done.returncode:
        lines = [
            line
            for line in log.read_text(errors="replace").splitlines()
            if re.search(r"\berror:|Error:|CMake Error", line)
        ]
        raise NotBuiltError(
            f"{lines[0].strip() if lines else 'the build failed'} (all of it in {os.path.relpath(log)})"
        )


def pure_wheel(build: Path) -> Path:
    """Make the wheel of the package without its native module, by the project's build backend.

    Raises:
        NotBuiltError: zig does not compile the modules for browsers, which the wheel contains.
    """
    if not build_wasm.is_built():
        try:
            build_wasm.build()
        except build_wasm.NotBuiltError as error:
            raise NotBuiltError(str(error)) from error
    folder = build / "pure"
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    code = "import sys, scikit_build_core.build as b; b.build_wheel(sys.argv[1], {'wheel.cmake': 'false'})"
    run([sys.executable, "-c", code, folder], build / "pure.log")
    (made,) = folder.glob("*.whl")
    return made


def compilers(build: Path, target: Target) -> dict[str, Path]:
    """Write the scripts by which CMake calls zig for a target."""
    folder = build / target.name
    folder.mkdir(parents=True, exist_ok=True)
    scripts = {}
    for tool, options in (("c++", f"-target {target.zig}"), ("ar", ""), ("ranlib", ""), ("rc", "")):
        path = folder / f"zig-{tool}"
        command = f'exec {shlex.quote(sys.executable)} -m ziglang {tool} {options} "$@"'
        path.write_text(f"#!/bin/sh\n{FOR_MACOS if target.system == 'Darwin' else ''}{command}\n")
        path.chmod(0o755)
        scripts[tool] = path
    return scripts


def python_options(build: Path, target: Target, python: Path) -> list[str]:
    """Return CMake's options for the headers and, on Windows, import libraries of a target's Python."""
    code = "import sys, sysconfig; print(sys.version_info[1], sysconfig.get_paths()['include'])"
    done = subprocess.run([python, "-c", code], capture_output=True, text=True, check=True)
    minor, include = done.stdout.strip().split(maxsplit=1)
    if not target.windows:
        return [f"-DPython_EXECUTABLE={python}", f"-DPython_INCLUDE_DIR={include}"]
    try:
        made = windows_python(build / target.name / "python", Path(include), int(minor))
    except RuntimeError as error:
        raise NotBuiltError(str(error)) from error
    return [f"-DPython_EXECUTABLE={python}", *made]


def build_module(build: Path, target: Target, version: str, python: Path) -> bytes:
    """Compile the module for a target with the headers of an interpreter of this machine; return the file."""
    abi3 = version != "3.11"
    tools = compilers(build, target)
    folder = build / target.name / "cmake"  # of both wheels: the kernels do not depend on Python
    log = build / target.name / f"{'abi3' if abi3 else 'cp311'}.log"
    log.unlink(missing_ok=True)
    import nanobind

    # CMake asks for a tool that would edit paths of libraries, which these modules do not have.
    unused = [f"-DCMAKE_INSTALL_NAME_TOOL={shutil.which('true')}"] if target.system == "Darwin" else []
    options = [
        *("-UPython*", "-U_Python*", "-Unanobind*", "-USKBUILD*"),  # what an earlier run found
        f"-Dnanobind_ROOT={nanobind.cmake_dir()}",
        f"-DCMAKE_CXX_COMPILER={tools['c++']}",
        f"-DCMAKE_AR={tools['ar']}",
        f"-DCMAKE_RANLIB={tools['ranlib']}",
        f"-DCMAKE_RC_COMPILER={tools['rc']}",
        f"-DCMAKE_MODULE_LINKER_FLAGS={target.linker_flags()}",
        f"-DCMAKE_SYSTEM_NAME={target.system}",
        f"-DCMAKE_SYSTEM_PROCESSOR={target.processor}",
        "-DCMAKE_BUILD_TYPE=Release",
        *unused,
        *(["-DSKBUILD_SABI_COMPONENT=Development.SABIModule"] if abi3 else []),
        *python_options(build, target, python),
    ]
    beside = Path(sys.executable).parent
    cmake = beside / "cmake"
    for stale in folder.glob("_native*"):
        stale.unlink()
    run(
        [
            cmake,
            "-S",
            ROOT,
            "-B",
            folder,
            "-G",
            "Ninja",
            f"-DCMAKE_MAKE_PROGRAM={beside / 'ninja'}",
            *options,
        ],
        log,
    )
    run([cmake, "--build", folder, "--target", "_native"], log)
    (made,) = (path for path in folder.glob("_native*") if path.suffix in (".so", ".pyd", ".dylib", ".dll"))
    return made.read_bytes()


def build_wheel(build: Path, pure: Path, target: Target, version: str, python: Path, out: Path) -> Path:
    """Build, pack and check one wheel."""
    abi3 = version != "3.11"
    data = build_module(build, target, version, python)
    unix = "_native.abi3.so" if abi3 else f"_native.cpython-311-{target.processor}-linux-gnu.so"
    module = "_native.pyd" if target.windows else unix
    tag = f"{'cp312-abi3' if abi3 else 'cp311-cp311'}-{target.tag}"
    wheel = pack(pure, (module, data), tag, nanobind_parts() + zig_parts(target.windows), out)
    wrong = problems(wheel)
    if wrong:
        wheel.unlink()
        raise NotBuiltError("; ".join(wrong))
    return wheel


def imported(wheel: Path, python: Path) -> str:
    """Import a wheel's module with an interpreter that has no packages; return "" or what went wrong."""
    code = (
        "import sys, importlib.util as u; s = u.spec_from_file_location('_native', sys.argv[1]);"
        " m = u.module_from_spec(s); s.loader.exec_module(m); assert m.isas(), 'no instruction set'"
    )
    with tempfile.TemporaryDirectory() as folder:
        shutil.unpack_archive(wheel, folder, "zip")
        (module,) = (
            path for path in Path(folder).glob("gsplat_edu/_native*") if path.suffix in (".so", ".pyd")
        )
        done = subprocess.run([python, "-I", "-c", code, module], capture_output=True, text=True, check=False)
    return "" if done.returncode == 0 else done.stderr.strip().splitlines()[-1]


def native_here(target: Target) -> bool:
    """Return whether this machine runs programs of a target."""
    return target.system == platform.system() and target.processor.lower() == platform.machine().lower()


def make(args: argparse.Namespace) -> list[str]:
    """Build the wheels that were asked for; return the lines about those that failed."""
    found = pythons()
    newest = max((v for v in found if v != "3.11"), key=lambda v: int(v.split(".")[1]), default=None)
    oldest = "3.12" if "3.12" in found else newest
    pure = pure_wheel(args.build)
    failed = []
    for target in (target for target in TARGETS if target.name in args.targets):
        for version, python_version in (("3.11", "3.11"), ("3.12", oldest)):
            label = f"{target.name}, {'cp311' if version == '3.11' else 'cp312-abi3'}"
            start = time.monotonic()
            try:
                if version == "3.11" and not target.cross_cp311:
                    print(
                        f"{label}: not built here; without the stable ABI it needs that system's own Python headers"
                    )
                    continue
                if python_version not in found:
                    raise NotBuiltError(f"there is no Python {version} here; its headers are needed")
                wheel = build_wheel(args.build, pure, target, version, found[python_version], args.out)
                line = f"{label}: {wheel.name}, {wheel.stat().st_size / 1e6:.2f} MB, {time.monotonic() - start:.0f} s"
                if native_here(target):
                    able = [v for v in found if (v == "3.11") == (version == "3.11")]
                    wrong = {v: imported(wheel, found[v]) for v in able}
                    if any(wrong.values()):
                        raise NotBuiltError(
                            "; ".join(f"Python {v}: {text}" for v, text in wrong.items() if text)
                        )
                    line += f"; imported by Python {', '.join(sorted(able))}"
                else:
                    line += "; not run here"
                print(line, flush=True)
            except NotBuiltError as error:
                failed.append(f"{label}: {error}")
                print(f"{label}: NOT BUILT: {error}", flush=True)
    return failed


def repeat(args: argparse.Namespace) -> list[str]:
    """Build each target again and compare; return the lines about those that differ."""
    failed = []
    for target in args.targets:
        start = time.monotonic()
        try:
            found = unrepeated(target, args.out)
        except RuntimeError as error:
            found = [f"the second build failed: {error}"]
        line = "; ".join(found) or "the same bytes from another folder"
        print(
            f"{target}: {'NOT REPEATED: ' if found else ''}{line}, {time.monotonic() - start:.0f} s",
            flush=True,
        )
        failed += found
    return failed


def main() -> int:
    """Run the tool."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n", 1)[0])
    names = [target.name for target in TARGETS]
    parser.add_argument(
        "--out", type=Path, default=ROOT / "dist", help="folder of the wheels (default: dist)"
    )
    parser.add_argument("--build", type=Path, default=ROOT / "build" / "wheels", help="folder of the builds")
    parser.add_argument("--targets", nargs="+", choices=names, default=names, help="platforms (default: all)")
    parser.add_argument(
        "--repeat",
        action="store_true",
        help="build every target twice, in two folders, and compare the bytes",
    )
    args = parser.parse_args()
    args.out, args.build = args.out.resolve(), args.build.resolve()
    args.build.mkdir(parents=True, exist_ok=True)
    return 1 if make(args) or (args.repeat and repeat(args)) else 0


if __name__ == "__main__":
    sys.exit(main())
