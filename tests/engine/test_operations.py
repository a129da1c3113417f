"""Operations and words of a shader, counted in its text and by hand."""

import pytest

from gsplat_edu.engine.operations import SLOW, Shader, width_of
from gsplat_edu.engine.passes import MODULES, module_source

TEXT = """
// Comments do not count: 1.0 + 2.0.
struct Pair {
    a: vec4<f32>,            // a comment
    b: f32,
}

const FOUR = 4u;

@group(1) @binding(0) var<storage, read> given: array<vec4<f32>>;
@group(1) @binding(1) var<storage, read_write> made: array<f32>;

var<workgroup> shared_: array<Pair, FOUR>;

fn slow(x: f32) -> f32 {
    return sqrt(x);
}

fn through(p: ptr<function, Pair>, by: f32) {
    (*p).b += by;
}

@compute @workgroup_size(64)
fn entry(@builtin(local_invocation_index) thread: u32) {
BODY
}
"""


def work(body, **rates):
    shader = Shader(TEXT.replace("BODY", body))
    assert shader.threads == {"entry": 64} and shader.bindings == {"given": 0, "made": 1}
    return shader.work("entry", {key.replace("__", "."): value for key, value in rates.items()})


@pytest.mark.parametrize(
    ("body", "operations"),
    [
        ("let a = 1.0 + 2.0;", 1),
        ("let a = vec3<f32>(1.0) * 2.0;", 3),
        ("let a = 1.0 * 2.0 + 3.0;", 1),  # a product that is added
        ("let a = 1.0 * 2.0 + 3.0 * 4.0 + 5.0;", 3),
        ("let a = 1.0 / 2.0;", SLOW),
        ("let a = slow(1.0 + f32(thread));", 2 + SLOW),
        ("let a = dot(vec3<f32>(1.0), vec3<f32>(2.0));", 3),
        ("let a = vec4<f32>(1.0); let b = a.xy * a.zw;", 2),
        ("let a = -f32(thread);", 2),
        ("var p: Pair; through(&p, 2.0);", 1),
        ("var p: Pair; p.a = vec4<f32>(0.0);", 0),
        ("let a = shared_[1].a;", 1),
        ("for (var k = 0u; k < FOUR; k++) { let a = 1.0 + 2.0; }", 4),
        ("for (var k = 64u; k > 0u; k /= 2u) { let a = 1.0 + 2.0; }", 7),
        ("if (thread < 3u) { let a = 1.0 + 2.0; } else { let a = 1.0 / 2.0; }", 2),
        ("switch thread { case 0u: { let a = 1.0 + 2.0; } default: { let a = 1.0 / 2.0; } }", (1 + SLOW) / 2),
        ("let m = mat3x3<f32>(vec3<f32>(1.0), vec3<f32>(1.0), vec3<f32>(1.0)); let a = vec3<f32>(1.0) * m;", 9),
    ],
)  # fmt: skip
def test_operations_by_hand(body, operations):
    assert work(body).operations == operations


def test_words_of_buffers():
    """A component of a vector comes with the vector; `+=` reads and writes; workgroup memory is no buffer."""
    found = work("let a = given[thread].x; made[0] += a; made[1] = shared_[2].b;")
    assert found.loaded == {"given": 4, "made": 1} and found.stored == {"made": 2}


def test_shares_and_turns_come_from_the_rates():
    body = "if (thread > 5u) { return; } for (var k = 0u; k < thread; k++) { made[k] = 1.0 + 2.0; }"
    assert work(body, entry__k=3).stored == {"made": 3}
    shader = Shader(TEXT.replace("BODY", body))
    quarter = shader.work("entry", {"entry.k": 4, "thread > 5u": 0.75})
    assert quarter.stored == {"made": 1.0}
    assert shader.work("entry", {"entry.k": 4, "entry: thread > 5u": 1.0, "thread > 5u": 0.5}).stored == {
        "made": 0.0
    }
    with pytest.raises(KeyError, match="entry.k"):
        shader.work("entry", {})


def test_what_it_cannot_read_is_an_error():
    with pytest.raises(ValueError, match="entry: expected"):
        work("let a = 1.0 2.0;")


@pytest.mark.parametrize("module", MODULES)
def test_the_engines_shaders_are_read_whole(module):
    """Every entry point, function, constant and buffer of the text."""
    text = module_source(module)
    shader = Shader(text)
    assert text.count("\nfn ") + text.startswith("fn ") == len(shader.functions)
    assert text.count("@compute") == len(shader.threads) > 0
    assert text.count("@group(1)") == len(shader.bindings)
    assert text.count("\nstruct ") + text.startswith("struct ") == len(shader.structs)


def test_widths():
    assert [width_of(kind) for kind in ("f32", "vec3<f32>", "mat3x3<f32>", "Pair", "atomic<u32>")] == [
        1,
        3,
        9,
        1,
        1,
    ]
