"""The count of the compositing kernels' operations, from which chapter 14 computes shares of the peak."""

import sys
from pathlib import Path

import pytest

sys.path.append(str(Path(__file__).parents[2] / "benchmarks"))
import kernel_operations

# By hand. alpha: minimum, comparison and selection, of which AVX-512 makes two instructions.
FORWARD = {"alpha": 3, "weight": 1, "colours": 3, "transmittance": 1, "step": 2}
BACKWARD = {
    "alpha": 3,
    "g . c": 3,
    "weight, and its share of the colour": 2,
    "rest": 1,
    "odds": 2,  # 1 - alpha, a division
    "h, and 0 where alpha was clamped": 3,
    "transmittance": 1,
    "sums for the colour": 3,
    "sums for the shape": 3,
    "step": 2,
}


def test_the_count_is_that_by_hand():
    assert kernel_operations.operations("composite", 8) == sum(FORWARD.values()) == 10
    assert kernel_operations.operations("composite_backward", 8) == sum(BACKWARD.values()) == 23
    # with AVX-512, alpha takes one less; a reciprocal of four operations and a product replace the division
    assert kernel_operations.operations("composite", 16) == sum(FORWARD.values()) - 1
    assert kernel_operations.operations("composite_backward", 16) == sum(BACKWARD.values()) - 1 + 3


def counted(text):
    return kernel_operations.OperationCounter(8).body(text)


@pytest.mark.parametrize(
    ("text", "count"),
    [
        ("const V w = t * alpha;", 1),
        ("store(p + at, load<V>(p + at) + w * red);", 1),
        ("wr += w * r, sum += wr;", 2),
        ("const V drawn = w * cg, rest = load<V>(p + at) - drawn;", 2),
        ("const int at = row * TILE + column; V key;", 0),
        ("if (MODE != COLORS) { cg += z * d; wz += w; } a += b;", 1),
        ("if constexpr (MODE >= WITH_FEATURES) if (pair.channels) { x *= y; }", 0),
        ("a = b * c * d + e;  // two products, one of which fuses", 2),
        ("return x >= least ? y : VF{};", 2),
        ("value *= ratio * splat(factors[k]);", 2),
    ],
)
def test_statements_are_counted(text, count):
    assert counted(text) == count


@pytest.mark.parametrize(
    "text", ["for (;;) a += b;", "if (fast) a += b;", "a = new_function(b);", "a <<= b;"]
)
def test_what_is_not_understood_is_an_error(text):
    with pytest.raises(ValueError, match=r"kernel_operations\.py"):
        counted(text)
