"""The dispatches of a program's parts, in one submission each, or in as many as the device's pace asks for."""

from __future__ import annotations

import struct
import time
from collections.abc import Mapping, Sequence
from typing import Any

from gsplat_edu.engine.pace import Stretch
from gsplat_edu.engine.passes import LEAST, WORD, Pass, Program

JOB_BYTES = 32
"""Bytes of a job in the uniform buffer."""

SLICE = 256
"""Bytes between the jobs of two passes: the alignment of uniforms that every device accepts."""

VIEW_BYTES = 640
"""Bytes of the uniform block that all passes of a part share: camera, settings, a step's numbers, and a lens."""

Call = tuple[Any, Any, Any, int, int, int]
"""Pipeline, uniforms, storage, offset of the job, workgroups in two dimensions."""


class Parts:
    """The dispatches of the parts of a program that has buffers.

    Args:
        device: The `Device` of host.py, which imports this module.
        program: The program.
        counts: Its counts by name.
        buffers: Its buffers by name.
        view: The uniform block that all passes share.

    Attributes:
        whole: The calls of each part that dispatch every pass at once.
    """

    def __init__(
        self,
        device: Any,  # noqa: ANN401
        program: Program,
        counts: Mapping[str, int],
        buffers: Mapping[str, Any],
        view: Any,  # noqa: ANN401
    ) -> None:
        self._device, self._gpu, self._program, self._counts = device, device.device, program, dict(counts)
        self._buffers, self._view = buffers, view
        self._bell: Any = None
        self._groups = {
            part: [(one.name, one.groups(counts)) for one in passes] for part, passes in program.parts.items()
        }
        self._bound: dict[Pass, tuple[Any, Any]] = {}
        self.whole = {
            part: self._calls(
                part, [Stretch(place, 0, groups) for place, (_, groups) in enumerate(each) if groups]
            )
            for part, each in self._groups.items()
        }
        self._cuts: dict[str, tuple[int, list[list[Call]]]] = {}

    def _calls(self, part: str, stretches: Sequence[Stretch]) -> list[Call]:
        """Return the calls that dispatch stretches of a part's passes."""
        import wgpu

        passes = self._program.parts[part]
        numbers = [passes[place].job(self._counts, first) for place, first, _ in stretches]
        jobs = self._gpu.create_buffer_with_data(
            data=b"".join(struct.pack("<5I", *each).ljust(SLICE, b"\0") for each in numbers) or bytes(SLICE),
            usage=wgpu.BufferUsage.UNIFORM,
        )
        uniforms = self._gpu.create_bind_group(
            layout=self._device.uniform_layout,
            entries=[
                {"binding": 0, "resource": {"buffer": jobs, "offset": 0, "size": JOB_BYTES}},
                {"binding": 1, "resource": {"buffer": self._view, "offset": 0, "size": VIEW_BYTES}},
            ],
        )
        calls = []
        for row, (place, _, groups) in enumerate(stretches):
            pipeline, storage = self._bind(passes[place])
            x = min(groups, self._device.most_groups)
            calls.append((pipeline, uniforms, storage, SLICE * row, x, -(-groups // x)))
        return calls

    def _bind(self, one: Pass) -> tuple[Any, Any]:
        """Return the pipeline of a pass, and its buffers as a bind group."""
        if one not in self._bound:
            pipeline, layout = self._device.pipeline(one)
            bound = [{"buffer": self._buffers[name]} for name in (*one.reads, *one.writes)]
            entries = [{"binding": k, "resource": each} for k, each in enumerate(bound)]
            self._bound[one] = pipeline, self._gpu.create_bind_group(layout=layout, entries=entries)
        return self._bound[one]

    def record(self, encoder: Any, part: str) -> tuple[Any, int]:  # noqa: ANN401
        """Record the passes of a part; all of its submissions but the last are made here.

        Returns:
            The encoder of the last one, and their number.
        """
        pace, groups = self._device.pace, self._groups[part]
        if part not in self._cuts or self._cuts[part][0] != pace.version:
            if not all(pace.is_known(name, each) for name, each in groups):
                return self._timed(encoder, part), 1
            self._cuts[part] = pace.version, self._cut(part, pace.plan(groups, self._device.most_groups))
        *before, last = self._cuts[part][1]
        for calls in before:
            encoder = self._submitted(recorded(encoder, calls))
        return recorded(encoder, last), len(before) + 1

    def _cut(self, part: str, pieces: list[list[Stretch]]) -> list[list[Call]]:
        """Return the calls of each submission of a part."""
        return [self.whole[part]] if len(pieces) == 1 else [self._calls(part, piece) for piece in pieces]

    def _submitted(self, encoder: Any) -> Any:  # noqa: ANN401
        """Submit what was recorded, and return an encoder for what follows."""
        self._gpu.queue.submit([encoder.finish()])
        return self._gpu.create_command_encoder()

    def _timed(self, encoder: Any, part: str) -> Any:  # noqa: ANN401
        """Play a part in short stretches, wait for each and time it; returns an encoder for what follows."""
        pace, widest = self._device.pace, self._device.most_groups
        encoder = self._submitted(encoder)
        _, call = self._waited(encoder)
        encoder, again = self._waited(self._gpu.create_command_encoder())
        call = min(call, again)
        for place, (name, groups) in enumerate(self._groups[part]):
            times, first, here = [], 0, pace.first_stretch(groups)
            while first < groups:
                calls = self._calls(part, [Stretch(place, first, here)])
                encoder, seconds = self._waited(recorded(encoder, calls))
                times.append((here, seconds - call))
                first += here
                here = pace.next_stretch(here, seconds, groups - first, widest)
            if times:
                pace.note(name, times)
        return encoder

    def _waited(self, encoder: Any) -> tuple[Any, float]:  # noqa: ANN401
        """Submit what was recorded and wait for it; return an encoder for what follows, and the seconds it took.

        wgpu 0.32 cannot wait for a submission itself, so this waits for a copy at its end.
        """
        import wgpu

        if self._bell is None:
            usage = wgpu.BufferUsage.MAP_READ | wgpu.BufferUsage.COPY_DST
            self._bell = self._gpu.create_buffer(size=SLICE, usage=usage)
        began = time.perf_counter()
        encoder.copy_buffer_to_buffer(next(iter(self._buffers.values())), 0, self._bell, 0, WORD * LEAST)
        encoder = self._submitted(encoder)
        self._device.wait(self._bell.map_async("READ", 0, WORD * LEAST))
        seconds = time.perf_counter() - began
        self._bell.unmap()
        return encoder, seconds

    def watch(self, part: str, seconds: float, pieces: int) -> None:
        """Tell the pace how long a part took in so many submissions."""
        self._device.pace.watch((name for name, _ in self._groups[part]), seconds, pieces)


def recorded(encoder: Any, calls: Sequence[Call]) -> Any:  # noqa: ANN401
    """Record dispatches as a compute pass, and return the encoder."""
    computing = encoder.begin_compute_pass()
    for call in calls:
        dispatch(computing, call)
    computing.end()
    return encoder


def dispatch(computing: Any, call: Call) -> None:  # noqa: ANN401
    """Record one dispatch."""
    pipeline, uniforms, storage, offset, x, y = call
    computing.set_pipeline(pipeline)
    computing.set_bind_group(0, uniforms, [offset])
    computing.set_bind_group(1, storage)
    computing.dispatch_workgroups(x, y)
