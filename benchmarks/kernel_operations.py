"""How many vector operations do the compositing kernels take for each vector of pixels? Counted in their source.

Counted is the loop over the rows of a tile in `native/composite.cpp` and `native/composite_backward.cpp`, for colours
only and a gentle splat, as almost all are (`native/tile.h`). An operation is an addition, a multiplication, both fused,
a division, a minimum, a comparison or a selection, each of one vector. Loads, stores, constants, indices, and what is
done once per splat or strip do not count. A statement that this program does not understand is an error.
"""

from __future__ import annotations

import ast
import re
from pathlib import Path

NATIVE = Path(__file__).resolve().parent.parent / "native"

KERNELS = {
    "composite": ("composite.cpp", r"const auto blend = \[&\]\([^)]*\) \{"),
    "composite_backward": (
        "composite_backward.cpp",
        r"for \(int32_t row = first; row <= last; \+\+row\) \{",
    ),
}
"""By stage of a frame the file, and where the body that is counted begins."""

FREE = {"load", "splat", "_mm512_set1_ps"}
"""Functions that compute nothing."""

TYPES = re.compile(r"^(const )?(V|VF|auto|__m512|__mmask16) (?=\w)")
CASTS = re.compile(r"\((VF|__m512)\)")


def operations(kernel: str, lanes: int) -> int:
    """Count the operations of a kernel for one vector of pixels.

    Args:
        kernel: "composite" or "composite_backward".
        lanes: Pixels in a vector of float32; with 16, the branches for AVX-512 are counted.

    Raises:
        ValueError: the source has a form that this function does not understand.
    """
    file, begin = KERNELS[kernel]
    return OperationCounter(lanes).body(_block((NATIVE / file).read_text(encoding="utf-8"), begin))


class OperationCounter:
    """Counts operations in our C++ for one vector width."""

    def __init__(self, lanes: int) -> None:
        self.wide = lanes == 16
        self.simd = (NATIVE / "simd.h").read_text(encoding="utf-8")
        self.tile = (NATIVE / "tile.h").read_text(encoding="utf-8")

    def body(self, text: str) -> int:
        """Count the statements of a block; those under a condition on the mode are for depth and features."""
        text, total = re.sub(r"//[^\n]*", "", text).strip(), 0
        while text:
            if text.startswith("if"):
                text = _after_condition(text)
                continue
            statement, _, text = text.partition(";")
            total += self.statement(statement.strip())
            text = text.strip()
        return total

    def statement(self, text: str) -> int:
        """Count a statement; declarations without a value and scalar indices count nothing."""
        if re.match(r"(const )?int", text) or re.fullmatch(r"V \w+", text):
            return 0
        text = TYPES.sub("", text.removeprefix("return "))
        try:
            [parsed] = ast.parse(_as_python(text)).body
        except (SyntaxError, ValueError):
            raise ValueError(f"kernel_operations.py: cannot count {text!r}") from None
        if isinstance(parsed, ast.AugAssign):
            return self.count(ast.BinOp(parsed.target, parsed.op, parsed.value))
        if isinstance(parsed, ast.Assign | ast.Expr):
            return self.count(parsed.value)
        raise ValueError(f"kernel_operations.py: cannot count {text!r}")

    def count(self, node: ast.expr) -> int:
        """Count an expression; an addition fuses with a multiplication that it takes."""
        if isinstance(node, ast.Name | ast.Constant | ast.Attribute):
            return 0
        if isinstance(node, ast.Tuple):
            return sum(map(self.count, node.elts))
        if isinstance(node, ast.NamedExpr):
            return self.count(node.value)
        if isinstance(node, ast.BinOp) and isinstance(node.op, ast.Add | ast.Sub | ast.Mult | ast.Div):
            sides = (node.left, node.right)
            products = [isinstance(n, ast.BinOp) and isinstance(n.op, ast.Mult) for n in sides]
            fused = isinstance(node.op, ast.Add | ast.Sub) and any(products)
            return (0 if fused else 1) + sum(map(self.count, sides))
        if isinstance(node, ast.Compare):
            return 1 + self.count(node.left) + sum(map(self.count, node.comparators))
        if isinstance(node, ast.IfExp):
            return 1 + self.count(node.test) + self.count(node.body) + self.count(node.orelse)
        if isinstance(node, ast.Call):
            return self.call(node)
        raise ValueError(f"kernel_operations.py: cannot count {ast.unparse(node)!r}")

    def call(self, node: ast.Call) -> int:
        """Count a call: what the function does, and the computation of its arguments."""
        name = node.func.attr if isinstance(node.func, ast.Attribute) else ast.unparse(node.func)
        within = sum(map(self.count, node.args)) if name not in FREE else 0
        if name in FREE or name == "store":
            return self.count(node.args[1]) if name == "store" else 0
        if name == "alpha":  # of a gentle splat
            return self.statement(_found(self.tile, r"key = value;\s*(return between\([^;]*);"))
        if name == "step":
            return self.statement(_found(self.tile, r"void step\(int32_t k\) \{\s*if \(GENTLY\) ([^;]*);"))
        if name == "where_open":
            return self.helper("where_below") + within
        if name == "vmin" or name.startswith("_mm512_"):
            return 1 + within
        return self.helper(name) + within

    def helper(self, name: str) -> int:
        """Count a function of float vectors in `simd.h`, in its branch for this width."""
        text = _block(self.simd, rf"GSPLAT_INLINE VF {name}\([^)]*\) \{{")
        branches = re.search(r"#if GSPLAT_VECTOR_BYTES == 64\n(.*?)#else\n(.*?)#endif", text, re.DOTALL)
        return self.body(branches[1 if self.wide else 2] if branches else text)


def _block(text: str, begin: str) -> str:
    """Return what stands between the brace at the end of a match and its partner."""
    match = re.search(begin, text)
    if match is None:
        raise ValueError(f"kernel_operations.py: the source has no {begin!r}")
    depth, at = 1, match.end()
    while depth:
        depth += {"{": 1, "}": -1}.get(text[at], 0)
        at += 1
    return text[match.end() : at - 1]


def _after_condition(text: str) -> str:
    """Return what follows a conditional statement."""
    depth, at = 0, text.index("(")
    while at == text.index("(") or depth:
        depth += {"(": 1, ")": -1}.get(text[at], 0)
        at += 1
    condition, rest = text[:at], text[at:].strip()
    if "MODE" not in condition and "settings.pixel_stop" not in condition and "channels" not in condition:
        raise ValueError(f"kernel_operations.py: cannot count under {condition!r}")
    if rest.startswith("{"):
        return rest[len(_block(rest, r"\{")) + 2 :].strip()
    return _after_condition(rest) if rest.startswith("if") else rest.partition(";")[2].strip()


def _as_python(text: str) -> str:
    """Write a C++ statement as Python with the same operations."""
    text = CASTS.sub("", re.sub(r"load<\w+>", "load", text)).replace("VF{}", "0")
    text = re.sub(r"(?<=\d)f\b", "", text)
    if chosen := re.fullmatch(r"(.*?) \? (.*?) : (.*)", text):
        text = f"({chosen[2]}) if ({chosen[1]}) else ({chosen[3]})"
    parts, depth = [""], 0
    for letter in text:
        depth += {"(": 1, ")": -1}.get(letter, 0)
        parts = [*parts, ""] if letter == "," and not depth else [*parts[:-1], parts[-1] + letter]
    if len(parts) > 1:  # the comma operator, or several declarations
        named = [re.sub(r"^(\w+) ([-+*/]?)= (.*)$", _walrus, part.strip(), flags=re.DOTALL) for part in parts]
        return ", ".join(f"({part})" for part in named)
    return text.strip()


def _walrus(match: re.Match[str]) -> str:
    name, operator, value = match.groups()
    return (
        f"{name} := {name} {operator} {value if '*' in value else f'({value})'}"
        if operator
        else f"{name} := {value}"
    )


def _found(text: str, pattern: str) -> str:
    match = re.search(pattern, text)
    if match is None:
        raise ValueError(f"kernel_operations.py: the source has no {pattern!r}")
    return match[1]
