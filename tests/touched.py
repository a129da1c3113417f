"""The test files that a change touches, all of whose sliced cases run (slices.py).

The change is every path in which the working tree (staged, unstaged and untracked files included) differs from a base.
The base is the merge base of HEAD with the main branch (origin/main, else main) if HEAD is ahead of that branch. On the
main branch itself it is HEAD's first parent, so uncommitted work there is tested together with the last commit.
GSPLAT_EDU_BASE names another base.

- A changed test file is touched. A changed conftest.py touches the tests of its folder, and so do data beside tests.
- A helper of tests (one of tests/fixtures, say) touches the test files and benchmarks that import it, also through
  other helpers.
- src/gsplat_edu/PACKAGE touches tests/PACKAGE, tests/test_PACKAGE.py and what ELSEWHERE names.
- A module of a package without a folder of tests (base, scene, ops, photos) touches tests/test_MODULE.py and the test
  files that import it. If at most FEW packages import it, or no test does, the tests of these packages are touched as
  well. A module with more users (errors.py) touches no further tests.
- A chapter or a benchmark touches the cases with its name; for other files, ELSEWHERE lists the tests.
"""

import ast
import os
import subprocess
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cache
from pathlib import Path, PurePosixPath

FEW = 6

FIGURES = tuple(f"repo/test_figures{of}.py" for of in ("", "_colour", "_geometry", "_gradients"))

ELSEWHERE: dict[str, tuple[str, ...]] = {
    "src/gsplat_edu/render": ("native", "parity", "gradients"),
    "src/gsplat_edu/render/triton": ("gpu",),
    "src/gsplat_edu/render/webgpu.py": ("engine",),
    "src/gsplat_edu/render/webgpu_resident.py": ("engine",),
    "src/gsplat_edu/train/resident.py": ("engine",),
    "native": ("native",),
    "benchmarks/ladder": ("ladder",),
    "benchmarks/kernel_operations.py": ("native/test_operations.py",),
    "conformance": ("conformance", "gpu/test_conformance.py"),
    "docs": ("repo/test_site.py",),
    "docs/site/static": FIGURES,
    "docs/GLOSSARY.md": ("repo/test_glossary.py",),
    "notebooks/exercises": ("repo/test_exercises.py",),
    "tools/site_figures.py": FIGURES,
    "tools/figure_photos.py": FIGURES,
    "tools/build_site.py": ("repo/test_site.py",),
    "tools/landing_scene.py": ("repo/test_site.py",),
    "tools/build_notebooks.py": ("repo/test_notebooks.py",),
    "tools/build_wheels.py": ("repo/test_wheels.py",),
    "packaging": ("repo/test_wheels.py",),
    "CMakeLists.txt": ("repo/test_wheels.py",),
    "pyproject.toml": ("repo/test_layering.py", "repo/test_wheels.py"),
}
"""Tests, below tests/, of files outside the package, and of packages whose tests are in folders of another name."""


@dataclass(frozen=True)
class History:
    """History and changes of a working tree, from git.

    Attributes:
        count: Number of commits up to HEAD; 0 if unknown.
        changed: Paths that differ from the base, relative to the root.
        missing: Why the count and the change are unknown; empty if they are known.
    """

    count: int
    changed: frozenset[str]
    missing: str = ""


def git(root: Path, *words: str) -> str | None:
    """Return the output of a git command, or None if it fails. GIT_DIR, which hooks set, is ignored."""
    environment = {name: value for name, value in os.environ.items() if not name.startswith("GIT_")}
    try:
        done = subprocess.run(
            ["git", "-C", str(root), *words], capture_output=True, text=True, check=False, env=environment
        )
    except OSError:
        return None
    return done.stdout.rstrip("\n") if done.returncode == 0 else None


def base_of(root: Path) -> str | None:
    """Return the commit with which the working tree is compared, or None."""
    if asked := os.environ.get("GSPLAT_EDU_BASE"):
        return git(root, "rev-parse", "--verify", "--quiet", f"{asked}^{{commit}}")
    head = git(root, "rev-parse", "HEAD")
    for branch in ("origin/main", "main"):
        met = git(root, "merge-base", "HEAD", branch)
        if met is not None and met != head:
            return met
    return git(root, "rev-parse", "--verify", "--quiet", "HEAD^")


def history(root: Path) -> History:
    """Return the number of commits and the changed paths; outside git and in a shallow clone, why they are unknown."""
    top = git(root, "rev-parse", "--show-toplevel")
    if top is None or Path(top).resolve() != root.resolve():
        return History(0, frozenset(), "no git repository, so the change is unknown")
    if git(root, "rev-parse", "--is-shallow-repository") != "false":
        return History(0, frozenset(), "a shallow clone, so the change is unknown (git fetch --unshallow)")
    count, base = git(root, "rev-list", "--count", "HEAD"), base_of(root)
    if count is None or base is None:
        return History(0, frozenset(), "no commit to compare with, so the change is unknown")
    different = git(root, "diff", "--name-only", "--no-renames", "-z", base) or ""
    untracked = git(root, "ls-files", "--others", "--exclude-standard", "-z") or ""
    return History(int(count), frozenset(f"{different}\0{untracked}".split("\0")) - {""})


@cache
def imported(path: Path) -> frozenset[str]:
    """Return the modules that a file imports, with the names it takes from them, as dotted names."""
    found: set[str] = set()
    try:
        tree = ast.parse(path.read_text(encoding="utf-8"))
    except (SyntaxError, UnicodeDecodeError):  # tests that import the file report its error
        return frozenset()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            found |= {node.module, *(f"{node.module}.{alias.name}" for alias in node.names)}
    return frozenset(found)


def imports(path: Path, module: str) -> bool:
    """Return whether a file imports a module or a part of it."""
    return any(name == module or name.startswith(f"{module}.") for name in imported(path))


def test_files(folder: Path) -> set[Path]:
    """Return the test files below a folder, or the file itself."""
    return {folder} if folder.is_file() else set(folder.rglob("test_*.py"))


def module_name(root: Path, path: Path) -> str:
    """Return the dotted name by which tests import a helper."""
    return ".".join(path.relative_to(root / "tests").with_suffix("").parts)


def users(root: Path, module: str, seen: frozenset[str] = frozenset()) -> set[Path]:
    """Return the test files that import a module, also through helpers and through the conftest.py of their folder.
    For a helper of tests, return the benchmarks that import it as well.
    """
    found: set[Path] = set()
    if not module.startswith("gsplat_edu"):
        found |= {path for path in (root / "benchmarks").glob("*.py") if imports(path, module)}
    for path in (root / "tests").rglob("*.py"):
        if path == root / "tests" / "conftest.py" or not imports(path, module):
            continue
        if path.name.startswith("test_"):
            found.add(path)
        elif path.name == "conftest.py":
            found |= test_files(path.parent)
        elif (name := module_name(root, path)) not in seen:
            found |= users(root, name, seen | {name})
    return found


def of_package(root: Path, parts: tuple[str, ...]) -> set[Path]:
    """Return the tests of a package. For a module of a package without tests, return its tests and those of its few
    users.

    Args:
        root: The repository.
        parts: The file's path below src/gsplat_edu.
    """
    tests, package = root / "tests", root / "src" / "gsplat_edu"

    def own(name: str) -> set[Path]:
        return test_files(tests / name) | {path for path in [tests / f"test_{name}.py"] if path.is_file()}

    if (tests / parts[0].removesuffix(".py")).is_dir():
        return own(parts[0].removesuffix(".py"))
    module = ".".join(("gsplat_edu", *parts)).removesuffix(".py").removesuffix(".__init__")
    needing = {
        path.relative_to(package).parts[0].removesuffix(".py")
        for path in package.rglob("*.py")
        if imports(path, module)
    } - {parts[0].removesuffix(".py"), "__init__"}
    direct = own(module.rsplit(".", 1)[-1]) | users(root, module)
    return direct.union(*map(own, needing)) if len(needing) <= FEW or not direct else direct


def of_test_folder(root: Path, path: Path) -> set[Path]:
    """Return the tests that a changed file below tests touches."""
    tests = root / "tests"
    if path.name.startswith("test_") and path.suffix == ".py":
        return {path}
    if path == tests / "conftest.py":
        return set()
    used = users(root, module_name(root, path)) if path.suffix == ".py" else set()
    folder = tests / path.relative_to(tests).parts[0]
    return used | (test_files(folder) if folder != path and not used else set())


def tests_of(root: Path, changed: Iterable[str]) -> set[str]:
    """Return the tests that a change touches.

    Args:
        root: The repository.
        changed: Paths relative to it.

    Returns:
        Test files relative to the root, and names in brackets, "[09_train_in_3d]", that stand for the cases with this
        name.
    """
    found: set[Path] = set()
    names: set[str] = set()
    for name in changed:
        path = PurePosixPath(name)
        if path.parts[0] == "tests":
            found |= of_test_folder(root, root / path)
        if path.parts[:2] == ("src", "gsplat_edu"):
            found |= of_package(root, path.parts[2:])
        for key, places in ELSEWHERE.items():
            if path.is_relative_to(key):
                found |= set().union(*(test_files(root / "tests" / place) for place in places))
        if path.parts[0] == "notebooks" and path.suffix == ".py":
            names.add(f"[{path.stem}]")
        if path.parts[0] == "benchmarks":
            names.add(f"[{'/'.join(path.parts[:2])}]")
    files = {path.relative_to(root).as_posix() for path in found if path.is_file()}
    return {f"[{name}]" if name.startswith("benchmarks/") else name for name in files} | names
