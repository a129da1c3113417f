"""What Triton 3.4, our lower bound, and 3.6 refuse and the installed version takes."""

import ast
from pathlib import Path

import pytest

from gsplat_edu.render import cuda

FILES = sorted(Path(cuda.__file__).parent.glob("*.py"))


def kernels(file):
    """Return the functions of a file that Triton compiles."""
    found = [node for node in ast.walk(ast.parse(file.read_text())) if isinstance(node, ast.FunctionDef)]
    return [one for one in found if any("jit" in ast.unparse(mark) for mark in one.decorator_list)]


def assigned(kernel):
    """Return the targets of a kernel's assignments."""
    return [target for node in ast.walk(kernel) if isinstance(node, ast.Assign) for target in node.targets]


@pytest.mark.parametrize("file", FILES, ids=lambda file: file.stem)
def test_kernels_assign_no_tuples_within_tuples(file):
    """The compiler of 3.6 raises TypeError for them."""
    nested = [
        (kernel.name, ast.unparse(target))
        for kernel in kernels(file)
        for target in assigned(kernel)
        if isinstance(target, ast.Tuple) and any(isinstance(part, ast.Tuple) for part in target.elts)
    ]
    assert nested == []


@pytest.mark.parametrize("file", FILES, ids=lambda file: file.stem)
def test_loops_assign_no_variable_of_a_loop(file):
    """The compiler of 3.4 takes it for a value that the loop carries, of another type."""
    twice = []
    for kernel in kernels(file):
        names = {
            node.id for target in assigned(kernel) for node in ast.walk(target) if isinstance(node, ast.Name)
        }
        loops = [node for node in ast.walk(kernel) if isinstance(node, ast.For)]
        twice += [(kernel.name, loop.target.id) for loop in loops if loop.target.id in names]
    assert twice == []


def test_kernels_are_found():
    assert sum(len(kernels(file)) for file in FILES) > 30
