"""Count what a thread of an entry point does, from the text of its WGSL: operations, and words of each buffer.

A reader of the part of WGSL that the engine's shaders use. It knows the type of every expression, and goes through the
text once, as often as loops turn and with the share of threads that take a branch:

- a number that is added, multiplied, compared or converted is one operation; a product that is added is one together
  with the addition; a quotient, square root, exponential or logarithm is `SLOW`;
- a scalar or vector that comes from memory or goes there is one;
- a loop between constants turns as often as it says, and is unrolled; of any other loop, `Rates` has the turns, under
  "function.variable", with "#2" for the second one of a function;
- `Rates` has the share of threads that take a branch, under the text of its condition, with or without "function: "
  before it. Without an entry the branch is taken, unless it leaves the function, the loop or a turn early.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field

Rates = Mapping[str, float]
"""Turns of loops and shares of branches; see the module."""

SLOW = 4
"""Operations that a quotient, root, exponential or logarithm stands for: GPUs compute a quarter as many of them."""

SLOWLY = frozenset({"sqrt", "exp2", "log2", "exp", "log", "inverseSqrt", "pow", "sin", "cos"})
GENERIC = frozenset({"vec2", "vec3", "vec4", "mat3x3", "array", "bitcast", "ptr", "atomic"})
PRECEDENCE = (
    ("||",), ("&&",), ("|",), ("^",), ("&",), ("==", "!="), ("<", ">", "<=", ">="), ("<<", ">>"), ("+", "-"),
    ("*", "/", "%"),
)  # fmt: skip
TOKEN = re.compile(
    r"\s*(0x[0-9a-f]+u?|\d+\.?\d*(?:e[-+]?\d+)?[uif]?|\w+|\|\||&&|<<|>>|[-+*/%&|^<>=!]=|\+\+|--|->|.)"
)
LEAVES = frozenset({"return", "break", "continue"})


@dataclass
class ThreadWork:
    """What a thread does on average.

    Args:
        operations: Their number.
        loaded: Words read, by the name of the variable in the shader.
        stored: Words written.
    """

    operations: float = 0.0
    loaded: dict[str, float] = field(default_factory=dict)
    stored: dict[str, float] = field(default_factory=dict)

    def add(self, other: ThreadWork, times: float = 1.0) -> None:
        """Add another one, so many times."""
        self.operations += times * other.operations
        for mine, theirs in ((self.loaded, other.loaded), (self.stored, other.stored)):
            for name, words in theirs.items():
                mine[name] = mine.get(name, 0.0) + times * words


@dataclass(frozen=True)
class _Function:
    parameters: dict[str, str]
    returns: str
    body: list[str]


class Shader:
    """A module's text, read.

    Args:
        text: WGSL.

    Attributes:
        bindings: Place of each storage buffer in group 1, by the name of its variable.
        threads: Threads of a workgroup, by entry point.
    """

    def __init__(self, text: str) -> None:
        text = re.sub(r" *//.*", "", text)
        storage = re.findall(r"@group\(1\) @binding\((\d+)\) var<storage[^>]*> (\w+)", text)
        self.bindings = {name: int(place) for place, name in storage}
        sizes = re.findall(r"@workgroup_size\((\w+)\)\s*fn (\w+)", text)
        text = re.sub(r"@\w+(\([^)]*\))?", "", text)
        self.structs: dict[str, dict[str, str]] = {}
        self.constants: dict[str, float] = {}
        self.variables: dict[str, tuple[str, str]] = {}  # address space and type
        self.functions: dict[str, _Function] = {}
        for name, body in re.findall(r"struct (\w+) \{(.*?)\n\}", text, re.DOTALL):
            self.structs[name] = dict(re.findall(r"(\w+): (.+?),?$", body, re.MULTILINE))
        for name, value in re.findall(r"^const (\w+) = ([-\d.e]+)[uf]?;", text, re.MULTILINE):
            self.constants[name] = float(value)
        self.threads = {name: int(self.constants.get(size) or size) for size, name in sizes}
        for space, name, kind in re.findall(r"^ *var<(\w+)[^>]*> (\w+): (.*);", text, re.MULTILINE):
            self.variables[name] = space, kind
        for name, given, returns, body in re.findall(
            r"^fn (\w+)\((.*?)\)(?: -> ([\w<>]+))? \{\n(.*?)^\}", text, re.DOTALL | re.MULTILINE
        ):
            parameters = {
                key: re.sub(r"ptr<function, (.*)>", r"\1", kind.strip())
                for key, kind in re.findall(r"(\w+): ((?:ptr<[^:]*>)|[^,]+)", given)
            }
            self.functions[name] = _Function(parameters, returns, TOKEN.findall(body))

    def work(self, entry: str, rates: Rates) -> ThreadWork:
        """Return what a thread of an entry point does.

        Args:
            entry: Its name.
            rates: Turns and shares; see the module.

        Raises:
            KeyError: a loop has no entry in `rates`; the key is what it lacks.
        """
        return _Reader(self, entry, rates).work


def width_of(kind: str) -> int:
    """Return the numbers of a scalar, vector or matrix type; 1 for any other."""
    found = re.match(r"vec(\d)", kind)
    return int(found[1]) if found else 9 if kind.startswith("mat3x3") else 1


class _Reader:
    """Goes through one function."""

    def __init__(self, shader: Shader, name: str, rates: Rates) -> None:
        self.shader, self.name, self.rates = shader, name, rates
        function = shader.functions[name]
        self.tokens, self.at = function.body, 0
        self.types = dict(function.parameters)
        self.work = ThreadWork()
        self._product = False  # whether what was read last is a product
        self._seen: dict[str, int] = {}
        self._folded: set[str] = set()  # variables of unrolled loops
        self._block_until(len(self.tokens))

    # statements

    def _block_until(self, end: int) -> bool:
        """Read statements; return whether the last one leaves."""
        outer, left, leaves = self.work, 1.0, False
        while self.at < end:
            self.work = ThreadWork()
            leaves = self._peek() in LEAVES
            taken = self._statement()
            outer.add(self.work, left)
            left *= 1.0 - taken
        self.work = outer
        return leaves

    def _statement(self) -> float:
        """Read a statement; return the share of threads that leave in it before others."""
        token = self._peek()
        if token == "if":
            return self._if()
        if token in ("for", "while"):
            self._loop(token)
        elif token == "switch":
            self._switch()
        elif token in ("let", "var", "const"):
            self._declaration()
        elif token in LEAVES:
            self._next()
            if self._peek() != ";":
                self._expression()
            self._take(";")
        else:
            self._assignment()
            self._take(";")
        return 0.0

    def _if(self) -> float:
        self._take("if")
        condition = self._condition()
        first, leaves = self._braces()
        other = ThreadWork()
        if self._peek() == "else":
            self._next()
            if self._peek() == "if":
                with self._apart() as other:
                    self._if()
            else:
                other, _ = self._braces()
        default = 0.0 if leaves else 1.0
        share = self.rates.get(f"{self.name}: {condition}", self.rates.get(condition, default))
        self.work.add(first, share)
        self.work.add(other, 1.0 - share)
        return share if leaves else 0.0

    def _condition(self) -> str:
        """Read an expression in brackets, and return its text."""
        begin = self.at
        self._take("(")
        self._expression()
        self._take(")")
        text = " ".join(self.tokens[begin + 1 : self.at - 1])
        return re.sub(r" ?([\[\]().,]) ?", r"\1", text).replace(",", ", ")

    def _loop(self, kind: str) -> None:
        self._next()
        if kind == "while":
            with self._apart() as head:
                self._condition()
            body, _ = self._braces()
            turns, unrolled = self.rates[self._numbered(f"{self.name}.while")], False
        else:
            end = self._closing()
            parts = " ".join(self.tokens[self.at + 1 : end]).split(";")
            self._take("(")
            if self._peek() == ";":
                self._next()
            else:
                self._declaration()
            with self._apart() as head:
                self._expression()
                self._take(";")
                self._assignment()
            self._take(")")
            turns, unrolled = self._turns(*(part.strip() for part in parts))
            if unrolled:
                self._folded.add(parts[1].split()[0])
            body, _ = self._braces()
        self.work.add(body, turns)
        self.work.add(head, 0.0 if unrolled else turns)

    def _turns(self, begins: str, goes_on: str, moves: str) -> tuple[float, bool]:
        """Return how often a loop turns, between constants from its text, else from the rates; and whether unrolled."""
        name = goes_on.split()[0]
        key = self._numbered(f"{self.name}.{name}")
        if key in self.rates:
            return self.rates[key], False
        start = re.fullmatch(r"var \w+ = (\w+)", begins)
        end = re.fullmatch(r"\w+ (<|>|<=) (\w+)", goes_on)
        step = re.fullmatch(r"\w+ (\+\+|[-+*/]=)(?: (\w+))?", moves)
        if not (start and end and step):
            raise KeyError(key)
        try:
            value, bound, by = self._number(start[1]), self._number(end[2]), self._number(step[2] or "1")
        except ValueError:
            raise KeyError(key) from None
        turns = 0
        while value > bound if end[1] == ">" else value < bound + (end[1] == "<="):
            turns += 1
            value = {"+": value + by, "*": value * by, "/": value // by, "-": value - by}[step[1][0]]
        return turns, True

    def _number(self, text: str) -> float:
        return self.shader.constants[text] if text in self.shader.constants else float(text.rstrip("uif"))

    def _numbered(self, key: str) -> str:
        self._seen[key] = self._seen.get(key, 0) + 1
        return key if self._seen[key] == 1 else f"{key}#{self._seen[key]}"

    def _switch(self) -> None:
        """Read a switch, whose cases are equally frequent."""
        self._take("switch")
        self._expression()
        self._take("{")
        cases = []
        while self._peek() != "}":
            while self._peek() != "{":
                self._next()
            cases.append(self._braces()[0])
        self._take("}")
        for case in cases:
            self.work.add(case, 1.0 / len(cases))

    def _declaration(self) -> None:
        self._next()
        name, kind = self._next(), ""
        if self._peek() == ":":
            self._next()
            kind = self._type()
        if self._peek() == "=":
            self._next()
            found = self._expression()
            kind = kind or found
        self._take(";")
        self.types[name] = kind

    def _assignment(self) -> None:
        """Read an assignment, or a call whose result nobody takes."""
        kind, place = self._unary(loads=False)
        operator = self._peek()
        if operator == "++":
            self._next()
            self.work.operations += 1
        elif operator.endswith("="):
            self._next()
            self._expression()
            if operator != "=":
                self._load(place, width_of(kind))
                self._add_or_not(operator[0], width_of(kind), self._product)
            self._store(place, width_of(kind))

    # expressions

    def _expression(self, level: int = 0) -> str:
        if level == len(PRECEDENCE):
            return self._unary()[0]
        left = self._expression(level + 1)
        while (operator := self._peek()) in PRECEDENCE[level]:
            self._next()
            product = self._product
            right = self._expression(level + 1)
            left = self._result(operator, left, right, product or self._product)
            self._product = operator == "*"
        return left

    def _result(self, operator: str, left: str, right: str, product: bool = False) -> str:
        """Count an operator and return its type; `product` tells whether a side of it is a product."""
        if operator == "*" and left.startswith("mat") != right.startswith("mat"):
            self.work.operations += 9  # three products of three numbers, six of them added to another one
            return "vec3<f32>"
        wide = left if width_of(left) >= width_of(right) else right
        self._add_or_not(operator, width_of(wide), product)
        return "bool" if operator in ("==", "!=", "<", ">", "<=", ">=") and width_of(wide) == 1 else wide

    def _add_or_not(self, operator: str, width: int, product: bool) -> None:
        """Count an operator, unless it adds a product."""
        if not (product and operator in ("+", "-")):
            self.work.operations += width * (SLOW if operator in "/%" else 1)

    def _unary(self, loads: bool = True) -> tuple[str, str]:
        """Read an operand; return its type, and the variable in a buffer or in workgroup memory that it is part of."""
        token = self._peek()
        if token in ("-", "!", "~"):
            self._next()
            kind, _ = self._unary()
            self.work.operations += width_of(kind)
            return kind, ""
        if token in ("*", "&"):
            self._next()
            return self._unary(loads=loads and token == "*")
        kind, place, width = self._operand()
        self._product = False
        if loads:
            self._load(place, width)
        return kind, place

    def _operand(self) -> tuple[str, str, int]:
        """Read a name, number, call or bracket with what follows it; also return the words that its value takes."""
        token, place = self._next(), ""
        if token == "(":
            kind = self._unary(loads=False)[0] if self._peek() == "*" else self._expression()
            while self._peek() != ")":  # more than a pointer in brackets
                operator = self._next()
                kind = self._result(operator, kind, self._expression())
            self._take(")")
        elif token[0].isdigit():
            kind = "u32" if token.endswith("u") else "f32"
        elif token in GENERIC or self._peek() == "(":
            kind = self._call(token)
        elif token in self.types:
            kind = self.types[token]
        elif token in self.shader.variables:
            space, kind = self.shader.variables[token]
            place = "" if space == "uniform" else token
        else:
            kind = "f32"  # a constant
        width = width_of(kind)
        while self._peek() in ("[", "."):
            if self._next() == "[":
                self._expression()
                self._take("]")
                found = re.match(r"array<(.*?)(?:, ?\w+)?>$", kind)
                kind = found[1] if found else "f32"
                width = width_of(kind)
            else:
                kind, width = self._member(kind, self._next(), width)
        return kind, place, width

    def _member(self, kind: str, name: str, width: int) -> tuple[str, int]:
        if kind in self.shader.structs:
            inner = self.shader.structs[kind][name]
            return inner, width_of(inner)
        scalar = kind[kind.index("<") + 1 : -1]
        return (scalar if len(name) == 1 else f"vec{len(name)}<{scalar}>"), width

    def _call(self, name: str) -> str:
        if name in GENERIC:
            self.at -= 1
            name = self._type()
        kinds, begin = list[str](), self.at
        self._take("(")
        while self._peek() != ")":
            kinds.append(self._expression())
            if self._peek() == ",":
                self._next()
        self._take(")")
        if name in self.shader.functions:
            if not self._is_constant(self.tokens[begin : self.at]):
                self.work.add(_Reader(self.shader, name, self.rates).work)
            return self.shader.functions[name].returns
        if name in self.shader.structs or name.startswith(("array", "mat")):
            return name
        return self._builtin(name, kinds)

    def _is_constant(self, tokens: list[str]) -> bool:
        """Return whether a compiler knows all arguments: numbers and variables of unrolled loops."""
        names = [token for token in tokens if token[0].isalpha()]
        return bool(names) and all(name in self._folded or name in self.shader.constants for name in names)

    def _builtin(self, name: str, kinds: list[str]) -> str:
        """Count a function of WGSL, or a conversion."""
        wide = max(kinds, key=width_of, default="f32")
        width = width_of(wide)
        if name.startswith("bitcast"):
            return name[len("bitcast<") : -1]
        if name in ("f32", "u32", "i32", "bool") or name.startswith("vec"):
            converts = len(kinds) == 1 and kinds[0] != name and width_of(kinds[0]) == width_of(name)
            self.work.operations += width_of(name) if converts else 0
            return name
        if name in ("dot", "cross"):
            self.work.operations += width if name == "dot" else 6
            return "f32" if name == "dot" else wide
        self.work.operations += SLOW * width if name in SLOWLY else (2 if name == "clamp" else 1) * width
        return {"any": "bool", "all": "bool"}.get(name, wide)

    # memory

    def _load(self, place: str, words: int) -> None:
        self._move(self.work.loaded, place, words)

    def _store(self, place: str, words: int) -> None:
        self._move(self.work.stored, place, words)

    def _move(self, where: dict[str, float], place: str, words: int) -> None:
        if place:
            self.work.operations += 1
        if place in self.shader.bindings:
            where[place] = where.get(place, 0.0) + words

    # tokens

    def _peek(self) -> str:
        return self.tokens[self.at] if self.at < len(self.tokens) else ""

    def _next(self) -> str:
        self.at += 1
        return self.tokens[self.at - 1]

    def _take(self, token: str) -> None:
        found = self._next()
        if found != token:
            near = " ".join(self.tokens[max(self.at - 8, 0) : self.at + 4])
            raise ValueError(f"{self.name}: expected {token!r}, not {found!r}, in: {near}")

    def _type(self) -> str:
        """Read the name of a type."""
        kind, depth = self._next(), 0
        if self._peek() != "<":
            return kind
        while True:
            token = self._next()
            depth += token.count("<") - token.count(">")
            kind += ", " if token == "," else token
            if not depth:
                return kind

    def _closing(self) -> int:
        """Return the place of the bracket that closes the one here."""
        depth = 0
        for at in range(self.at, len(self.tokens)):
            depth += (self.tokens[at] in ("(", "{")) - (self.tokens[at] in (")", "}"))
            if not depth:
                return at
        raise ValueError(f"{self.name}: a bracket is not closed")

    def _braces(self) -> tuple[ThreadWork, bool]:
        """Read a block; return its work, and whether it ends by leaving."""
        end = self._closing()
        self._take("{")
        with self._apart() as inside:
            leaves = self._block_until(end)
        self._take("}")
        return inside, leaves

    @contextmanager
    def _apart(self) -> Iterator[ThreadWork]:
        """Count into a value of its own."""
        outer, self.work = self.work, ThreadWork()
        inside = self.work
        try:
            yield inside
        finally:
            self.work = outer
