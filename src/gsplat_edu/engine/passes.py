"""The passes of the engine as data: buffers, passes and programs, described once for every host.

A host allocates the buffers, and for each pass of a part binds them and dispatches its workgroups. Nothing here needs
more than a browser grants by default: 8 storage buffers a pass, 16 KiB of workgroup memory, 65,535 workgroups a
dimension.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path

FOLDER = Path(__file__).parent
"""The folder of the WGSL files."""

MODULES: dict[str, tuple[str, ...]] = {
    "scan": ("job", "scan"),
    "sort": ("job", "sort"),
    "project": (
        *("job", "view", "constants", "elementary", "gaussian", "pinhole"),
        *("harmonics", "flat", "ellipse", "project"),
    ),
    "order": ("job", "order"),
    "intersect": ("job", "view", "constants", "flat", "ellipse", "intersect"),
    "composite": ("job", "view", "constants", "flat", "splat", "composite"),
    "composite_backward": ("job", "view", "constants", "flat", "splat", "composite_backward"),
    "statistics": ("job", "view", "constants", "flat", "splat", "statistics"),
    "features": ("job", "features"),
    "project_backward": (
        *("job", "view", "constants", "elementary", "gaussian", "pinhole"),
        *("harmonics", "project_backward", "pinhole_backward"),
    ),
    "loss": ("job", "view", "constants", "step", "loss"),
    "adam": ("job", "view", "step", "elementary", "adam"),
    "noise": ("job", "view", "step", "elementary", "noise"),
}
"""Shader modules, and the WGSL files that are joined to each; those of lenses and panoramas are added below."""

LENS_FILES: dict[str, tuple[str, ...]] = {
    "pinhole": ("lens", "sight"),
    "pinhole_backward": ("lens_backward", "sight_backward"),
}
"""The WGSL files in place of a pinhole's for any other lens, and for a rolling shutter."""

SEAM_FILES: dict[str, tuple[str, ...]] = {"flat": ("seam",)}
"""The same for a panorama, whose left and right edges meet."""


def _with(module: str, files: Mapping[str, tuple[str, ...]]) -> tuple[str, ...]:
    """Return the WGSL files of a module with some of them replaced."""
    return tuple(name for file in MODULES[module] for name in files.get(file, (file,)))


MODULES |= {f"{module}_lens": _with(module, LENS_FILES) for module in ("project", "project_backward")}
MODULES |= {
    f"{module}_seam": _with(module, LENS_FILES | SEAM_FILES)
    for module in ("project", "intersect", "composite", "composite_backward", "statistics")
}

BLOCK = 1024
"""Items that a workgroup of scan and sort takes."""

DIGIT_BITS = 4
"""Bits of a sort's digit."""

DIGITS = 1 << DIGIT_BITS
"""Values of a digit."""

WORD = 4
"""Bytes of a number."""

LEAST = 4
"""Words of the smallest buffer: one row of four numbers, which is the largest type of an array."""

LIMITS = {
    "max-storage-buffers-per-shader-stage": 8,
    "max-storage-buffer-binding-size": 128 << 20,
    "max-buffer-size": 256 << 20,
    "max-compute-workgroup-storage-size": 16 << 10,
    "max-compute-invocations-per-workgroup": 256,
    "max-compute-workgroups-per-dimension": 65535,
}
"""What every WebGPU device offers. Source: W3C, WebGPU, section 3.6.2."""


@dataclass(frozen=True)
class Size:
    """A number that follows from the counts of a program: words * ceil(count / per).

    Args:
        count: Name of the count, "gaussians" for instance.
        words: Factor.
        per: Items that share one.
    """

    count: str
    words: int = 1
    per: int = 1

    def of(self, counts: Mapping[str, int]) -> int:
        """Return the number for these counts."""
        return self.words * -(-counts[self.count] // self.per)


@dataclass(frozen=True)
class Buffer:
    """Memory of a program.

    Args:
        name: Its name in the program.
        size: Its length in words of four bytes; a host allocates at least one.
    """

    name: str
    size: Size


@dataclass(frozen=True)
class Pass:
    """One dispatch, or several: a host may cut its workgroups into stretches at any place (`pace.py`).

    Args:
        module: A name in `MODULES`.
        entry: The entry point.
        reads: Buffers that it reads only, bound from binding 0 of group 1 on.
        writes: Buffers that it may write, bound after them.
        items: Its number of items.
        group: Items that a workgroup takes; 0 if one workgroup takes all blocks of `BLOCK`.
        live: Place in the buffer `live` of the number of items that there are, or of a total that the pass writes.
        shift: Lowest bit of a sort's digit; 1 for a composite without background.
    """

    module: str
    entry: str
    reads: tuple[str, ...]
    writes: tuple[str, ...]
    items: Size
    group: int
    live: int = 0
    shift: int = 0

    def job(self, counts: Mapping[str, int], first: int = 0) -> tuple[int, int, int, int, int]:
        """Return the numbers of `Job` in `job.wgsl`: count, live, blocks, shift, first.

        Args:
            counts: The program's counts.
            first: The first workgroup of the dispatch. One that is not the whole pass has one dimension.
        """
        count = self.items.of(counts)
        return count, self.live, -(-count // (self.group or BLOCK)), self.shift, first

    @property
    def name(self) -> str:
        """Module and entry point."""
        return f"{self.module}.{self.entry}"

    def groups(self, counts: Mapping[str, int]) -> int:
        """Return the number of workgroups."""
        return self.job(counts)[2] if self.group else 1


@dataclass(frozen=True)
class Program:
    """Passes that share buffers.

    Args:
        buffers: All buffers.
        parts: Passes by the name of their part; a part is one submission.
    """

    buffers: tuple[Buffer, ...]
    parts: Mapping[str, tuple[Pass, ...]]

    def words(self, counts: Mapping[str, int]) -> dict[str, int]:
        """Return the length of every buffer in words, as a host allocates it."""
        return {buffer.name: max(LEAST, buffer.size.of(counts)) for buffer in self.buffers}

    def passes(self) -> Iterable[Pass]:
        """Yield the passes of all parts."""
        for part in self.parts.values():
            yield from part


def module_source(module: str) -> str:
    """Return the WGSL of a module."""
    return "\n".join((FOLDER / f"{name}.wgsl").read_text(encoding="utf-8") for name in MODULES[module])


def manifest(program: Program, source: Callable[[str], str] = module_source) -> dict[str, object]:
    """Return a program as JSON for a host in another language: the shaders' text, buffers and passes.

    A size is {count, words, per}, as in `Size`; a pass has the fields of `Pass`.

    Args:
        program: The program.
        source: Returns the WGSL of a module by its name.
    """
    parts = {part: [asdict(one) for one in passes] for part, passes in program.parts.items()}
    modules = sorted({one.module for one in program.passes()})
    return {
        "modules": {name: source(name) for name in modules},
        "buffers": [asdict(buffer) for buffer in program.buffers],
        "parts": parts,
        "block": BLOCK,
        "limits": LIMITS,
    }


def scan_scratch(items: Size) -> Size:
    """Return the size of the buffer of sums that a scan of so many numbers needs."""
    return Size(items.count, 1, items.per * BLOCK // items.words)


def scan(values: str, sums: str, items: Size, total: int) -> tuple[Pass, ...]:
    """Return the passes that replace numbers by their running sums, each without the number itself.

    Args:
        values: Buffer of the numbers.
        sums: Buffer of `scan_scratch(items)`.
        items: Number of numbers.
        total: Place in `live` of their sum.
    """
    return (
        Pass("scan", "reduce", (values,), (sums,), items, BLOCK),
        Pass("scan", "scan_sums", (), (sums, "live"), items, 0, live=total),
        Pass("scan", "scan_blocks", (sums,), (values,), items, BLOCK),
    )


def sort_scratch(prefix: str, count: str) -> tuple[Buffer, ...]:
    """Return the buffers that a sort of `count` keys needs besides keys and values: PREFIX_keys and so on."""
    digits = Size(count, DIGITS, BLOCK)
    return (
        Buffer(f"{prefix}_keys", Size(count)),
        Buffer(f"{prefix}_values", Size(count)),
        Buffer(f"{prefix}_digits", digits),
        Buffer(f"{prefix}_sums", scan_scratch(digits)),
    )


def sort(
    keys: str, values: str, prefix: str, count: str, live: int, bits: int, spare: int
) -> tuple[Pass, ...]:
    """Return the passes that sort values by keys, stably.

    Args:
        keys: Buffer of the keys.
        values: Buffer of the values.
        prefix: Of the names in `sort_scratch`.
        count: Name of the capacity.
        live: Place in `live` of the number of keys.
        bits: Bits of the keys that are compared, from the lowest one; keys end where they began if 8 divides the bits
            rounded up to fours, which `sort_bits` sees to.
        spare: Place in `live` for the sums of digit counts, which nothing reads.
    """
    items, digits = Size(count), Size(count, DIGITS, BLOCK)
    here, there = (keys, values), (f"{prefix}_keys", f"{prefix}_values")
    passes: list[Pass] = []
    for shift in range(0, sort_bits(bits), DIGIT_BITS):
        counts, sums = f"{prefix}_digits", f"{prefix}_sums"
        passes.append(Pass("sort", "count_digits", ("live", here[0]), (counts,), items, BLOCK, live, shift))
        passes += scan(counts, sums, digits, spare)
        passes.append(Pass("sort", "scatter", ("live", *here, counts), there, items, BLOCK, live, shift))
        here, there = there, here
    return tuple(passes)


def sort_bits(bits: int) -> int:
    """Round up to an even number of digits, so that sorted keys are in the buffer where they began."""
    return -(-bits // (2 * DIGIT_BITS)) * 2 * DIGIT_BITS
