"""A host that plays the engine's programs from Python, over wgpu: Vulkan, Metal or DirectX 12.

    device = Device.default()
    memory = device.allocate(program, {"gaussians": 1000})
    memory.write("keys", keys)
    found = memory.play("sort", read=("keys",))

A part of a program is one submission, or several on a slow device (`pace.py`). Nothing is read back but what `read`
names.
"""

from __future__ import annotations

import contextlib
import functools
import threading
import time
from collections.abc import Callable, Iterable, Mapping
from typing import Any

import numpy as np

from gsplat_edu.base.errors import BackendUnavailableError
from gsplat_edu.engine.adapters import adapters, chosen_adapter, listed_adapters, why_unavailable
from gsplat_edu.engine.dispatch import JOB_BYTES, SLICE, VIEW_BYTES, Parts, dispatch
from gsplat_edu.engine.failures import listen, one_line, wait
from gsplat_edu.engine.fit import why_too_large
from gsplat_edu.engine.pace import Pace
from gsplat_edu.engine.passes import LEAST as LEAST, LIMITS, WORD, Pass, Program, module_source
from gsplat_edu.engine.transfers import Kept, Ticket

TIMESTAMPS = "timestamp-query"
"""The optional feature of measuring passes."""


class Device:
    """An adapter that is ready to compute, with the pipelines that were made for it.

    Args:
        adapter: Its place in `adapters()`.
        limits: What it is asked for, by the names of `LIMITS`; None for all that the adapter has.
        most_groups: Workgroups in one dimension; more continue in the second.
        pace: How long its submissions may take.
        source: Returns the WGSL of a module by its name; None for `passes.module_source`.

    Raises:
        BackendUnavailableError: it does not start.

    Attributes:
        sent: Bytes written to its buffers so far.
        received: Bytes read from them.
        answered: When the last submission was seen to be done, by `time.perf_counter`.
        recording: Seconds in which `Memory.submit` recorded passes.
        submitting: Seconds in which it handed them over.
    """

    def __init__(
        self,
        adapter: int = 0,
        limits: Mapping[str, int] | None = None,
        most_groups: int | None = None,
        pace: Pace | None = None,
        source: Callable[[str], str] | None = None,
    ) -> None:
        listen()
        self.name, chosen = listed_adapters()[adapter]
        wanted = {key: chosen.limits[key] for key in LIMITS} if limits is None else dict(limits)
        self.measures = TIMESTAMPS in chosen.features
        with one_line(f"the adapter {self.name.name} does not start"):
            self.device = chosen.request_device_sync(
                required_limits=wanted, required_features=[TIMESTAMPS] if self.measures else []
            )
        self.limits: Mapping[str, int] = wanted
        self.most_groups = most_groups or wanted["max-compute-workgroups-per-dimension"]
        self.pace = pace or Pace()
        self._source = source
        self.lock = threading.RLock()
        self.sent, self.received, self.answered = 0, 0, 0.0
        self.recording = self.submitting = 0.0
        self._staging: dict[int, list[Any]] = {}
        self._modules: dict[str, Any] = {}
        self._pipelines: dict[tuple[str, str, int, int], Any] = {}

    def renewed(self) -> Device:
        """Return a new device on the same adapter, in place of one that is lost.

        Raises:
            BackendUnavailableError: the adapter is gone, or does not start.
        """
        with contextlib.suppress(
            Exception
        ):  # a lost device may refuse anything; this ends wgpu's thread for it
            self.device.destroy()
        listed_adapters.cache_clear()
        if self.name not in adapters():
            raise BackendUnavailableError(
                f"backend 'webgpu': {self.name.name} is gone; restart the computer, or use the backend cpu"
            )
        return Device(adapters().index(self.name), self.limits, self.most_groups, self.pace, self._source)

    def is_lost(self) -> bool:
        """Return whether the system has reset the device or taken it away."""
        import wgpu

        try:
            self.device.create_buffer(size=SLICE, usage=wgpu.BufferUsage.COPY_DST).destroy()
        except wgpu.GPUOutOfMemoryError:
            return False
        except (wgpu.GPUError, RuntimeError):
            return True
        return False

    def wait(self, arrival: Any) -> None:  # noqa: ANN401
        """Wait for what wgpu promises.

        Raises:
            DeviceLostError: the device is lost.
        """
        wait(arrival, f"{self.name.name} does not answer", self)

    @staticmethod
    @functools.cache
    def default() -> Device:
        """Return the device of `chosen_adapter`.

        Raises:
            BackendUnavailableError: there is none, or it does not start; the message says why.
        """
        if reason := why_unavailable():
            raise BackendUnavailableError(f"backend 'webgpu': {reason}")
        return Device(adapters().index(chosen_adapter()))

    def allocate(
        self,
        program: Program,
        counts: Mapping[str, int],
        poison: bool = False,
        like: Memory | None = None,
    ) -> Memory:
        """Allocate a program's buffers.

        Args:
            program: The program.
            counts: Its counts by name.
            poison: Fill the buffers with noise instead of zeros, so that tests find what is read before it is written.
            like: Its buffers are used again where name and size agree, with their contents; both then write to them.

        Raises:
            BackendUnavailableError: the device has too little memory or too small buffers; the message says which.
        """
        return Memory(self, program, counts, poison, like)

    def keep(self, array: np.ndarray) -> Kept:
        """Put an array of four-byte numbers on the device, to be copied into a program's buffers there.

        Raises:
            BackendUnavailableError: the device has too little memory.
        """
        import wgpu

        with self.lock, one_line(f"{self.name.name} has no {array.nbytes / 2**20:.0f} MiB for a photo", self):
            usage = wgpu.BufferUsage.COPY_SRC | wgpu.BufferUsage.COPY_DST
            buffer = self.device.create_buffer_with_data(data=np.ascontiguousarray(array), usage=usage)
        self.sent += array.nbytes
        return Kept(buffer, array.nbytes)

    def staging(self, size: int) -> Any:  # noqa: ANN401
        """Return a buffer of so many bytes that can be mapped; `Ticket.words` hands it back."""
        import wgpu

        if waiting := self._staging.setdefault(size, []):
            return waiting.pop()
        return self.device.create_buffer(
            size=size, usage=wgpu.BufferUsage.MAP_READ | wgpu.BufferUsage.COPY_DST
        )

    def free_staging(self, staging: Any) -> None:  # noqa: ANN401
        """Take back what `staging` returned, when it was read."""
        self.received += staging.size
        self._staging[staging.size].append(staging)

    @property
    def largest(self) -> int:
        """Bytes of the largest buffer that a pass can use."""
        return min(self.limits["max-storage-buffer-binding-size"], self.limits["max-buffer-size"])

    def check_fits(self, program: Program, counts: Mapping[str, int]) -> None:
        """Check that no buffer is larger than the device allows.

        Raises:
            BackendUnavailableError: one is; the message names it, and how many would fit.
        """
        if why := why_too_large(program, counts, self.largest, self.name.name):
            raise BackendUnavailableError(f"backend 'webgpu': {why}, or use the backend cpu")

    def pipeline(self, one: Pass) -> tuple[Any, Any]:
        """Return the compiled pipeline of a pass, and the layout of its storage buffers."""
        key = (one.module, one.entry, len(one.reads), len(one.writes))
        if key not in self._pipelines:
            self._pipelines[key] = self._compiled(one)
        return self._pipelines[key]  # type: ignore[no-any-return]

    def _compiled(self, one: Pass) -> tuple[Any, Any]:
        if one.module not in self._modules:
            with one_line(f"{self.name.name} refuses the shader {one.module}", self):
                code = (self._source or module_source)(one.module)
                self._modules[one.module] = self.device.create_shader_module(code=code)
        kinds = ["read-only-storage"] * len(one.reads) + ["storage"] * len(one.writes)
        storage = self.device.create_bind_group_layout(
            entries=[_entry(binding, {"type": kind}) for binding, kind in enumerate(kinds)]
        )
        layout = self.device.create_pipeline_layout(bind_group_layouts=[self.uniform_layout, storage])
        stage = {"module": self._modules[one.module], "entry_point": one.entry}
        with one_line(f"{self.name.name} refuses the shader {one.name}", self):
            return self.device.create_compute_pipeline(layout=layout, compute=stage), storage

    @functools.cached_property
    def uniform_layout(self) -> Any:  # noqa: ANN401
        """The layout of group 0: the job of the pass, and the view."""
        job = {"type": "uniform", "has_dynamic_offset": True, "min_binding_size": JOB_BYTES}
        return self.device.create_bind_group_layout(
            entries=[_entry(0, job), _entry(1, {"type": "uniform", "min_binding_size": VIEW_BYTES})]
        )


class Memory:
    """The buffers of a program for certain counts; `Device.allocate` makes it.

    Args:
        device: Where they are.
        program: The program.
        counts: Its counts by name.
        poison: Whether they begin with noise.
        like: Has buffers to use again.

    Attributes:
        buffers: wgpu's buffers by their names.
    """

    def __init__(
        self,
        device: Device,
        program: Program,
        counts: Mapping[str, int],
        poison: bool,
        like: Memory | None = None,
    ) -> None:
        import wgpu

        device.check_fits(program, counts)
        self.device, self.program, self.counts = device, program, dict(counts)
        usage = wgpu.BufferUsage
        storage = usage.STORAGE | usage.COPY_SRC | usage.COPY_DST
        self._words = program.words(counts)
        total = WORD * sum(self._words.values())
        make = device.device.create_buffer
        with one_line(f"{device.name.name} has no {total / 2**20:.0f} MiB for {counts}", device):
            self.buffers = {} if like is None else like._shared(self._words)
            for name in self._words.keys() - self.buffers:
                self.buffers[name] = make(size=WORD * self._words[name], usage=storage)
            self._view = make(size=VIEW_BYTES, usage=usage.UNIFORM | usage.COPY_DST)
        if poison:
            noise = np.random.default_rng(0)
            for name, words in self._words.items():
                self.write(name, noise.integers(0, 2**32, words, dtype=np.uint32))
        self._staging: Any = None
        self._parts = Parts(device, program, counts, self.buffers, self._view)

    def _shared(self, words: Mapping[str, int]) -> dict[str, Any]:
        """Return the buffers of these names that have these sizes."""
        return {name: buffer for name, buffer in self.buffers.items() if words.get(name) == self._words[name]}

    def write(self, name: str, array: np.ndarray) -> None:
        """Write an array of four-byte numbers to the beginning of a buffer.

        Raises:
            ValueError: it is longer than the buffer, or its numbers have another size.
        """
        if array.itemsize != WORD or array.size > self._words[name]:
            raise ValueError(
                f"{name}: has {self._words[name]} words, not {array.size} of {array.itemsize} bytes"
            )
        if array.size:
            with one_line(f"{self.device.name.name} does not take {name}", self.device):
                self.device.device.queue.write_buffer(self.buffers[name], 0, np.ascontiguousarray(array))
            self.device.sent += array.nbytes

    def read(self, name: str) -> np.ndarray:
        """Wait for all that was submitted, and return a buffer's contents as uint32.

        Raises:
            BackendUnavailableError: the device fails.
        """
        with self.device.lock, one_line(f"{self.device.name.name} does not give {name}", self.device):
            encoder = self.device.device.create_command_encoder()
            return self._read_after(encoder, (name,))[name]

    def submit(self, part: str, view: bytes, read: str, kept: Kept | None = None, into: str = "") -> Ticket:
        """Play a part of the program as one submission, without waiting for it.

        Args:
            part: Its name.
            view: Begin of the uniform block that its passes share.
            read: A small buffer, whose contents at the end of the part the ticket returns.
            kept: What is copied to the beginning of the buffer `into` before.
            into: That buffer's name.

        Raises:
            BackendUnavailableError: the device fails.
        """
        with self.device.lock, one_line(f"{self.device.name.name} fails in {part}", self.device):
            began = time.perf_counter()
            encoder = self._begun(view)
            if kept is not None:
                encoder.copy_buffer_to_buffer(kept.buffer, 0, self.buffers[into], 0, kept.nbytes)
            encoder, pieces = self._parts.record(encoder, part)
            size = self._bytes_of((read,))
            staging = self.device.staging(size)
            encoder.copy_buffer_to_buffer(self.buffers[read], 0, staging, 0, WORD * self._words[read])
            device, commands = self.device, encoder.finish()
            recorded = time.perf_counter()
            device.device.queue.submit([commands])
            device.recording += recorded - began
            device.submitting += time.perf_counter() - recorded
            arrival = staging.map_async("READ", 0, size)
            return Ticket(
                self.device, staging, arrival, lambda seconds: self._parts.watch(part, seconds, pieces)
            )

    def play(self, part: str, view: bytes = b"", read: Iterable[str] = ()) -> dict[str, np.ndarray]:
        """Play a part of the program as one submission, and wait for it if something is read.

        Args:
            part: Its name.
            view: Begin of the uniform block that its passes share; empty leaves it as it is.
            read: Buffers whose contents are returned, as uint32.

        Raises:
            BackendUnavailableError: the device fails.
        """
        names = tuple(read)
        with self.device.lock, one_line(f"{self.device.name.name} fails in {part}", self.device):
            encoder = self._begun(view)
            encoder, pieces = self._parts.record(encoder, part)
            began = time.perf_counter()
            found = self._read_after(encoder, names)
            if names:
                self._parts.watch(part, time.perf_counter() - began, pieces)
            return found

    def _begun(self, view: bytes) -> Any:  # noqa: ANN401
        """Return an encoder, after writing the uniform block."""
        if view:
            self.device.device.queue.write_buffer(self._view, 0, view)
            self.device.sent += len(view)
        return self.device.device.create_command_encoder()

    def _read_after(self, encoder: Any, names: tuple[str, ...]) -> dict[str, np.ndarray]:  # noqa: ANN401
        """Submit what was recorded, and return buffers as they are then."""
        offset = 0
        staging = self._staging_for(names)
        for name in names:
            encoder.copy_buffer_to_buffer(self.buffers[name], 0, staging, offset, WORD * self._words[name])
            offset += WORD * self._words[name]
        self.device.device.queue.submit([encoder.finish()])
        return self._collected(names, staging)

    def times(self, part: str) -> dict[str, float]:
        """Play a part once more, pass by pass, and return the milliseconds that the device took for each entry point.

        Raises:
            BackendUnavailableError: the device has no timestamps, or fails.
        """
        import wgpu

        if not self.device.measures:
            raise BackendUnavailableError(f"backend 'webgpu': {self.device.name.name} has no timestamps")
        make, recorded = self.device.device, self._parts.whole[part]
        passes = [one for one in self.program.parts[part] if one.groups(self.counts)]
        with self.device.lock, one_line(f"{self.device.name.name} fails in {part}", self.device):
            queries = make.create_query_set(type="timestamp", count=2 * len(passes))
            usage = wgpu.BufferUsage.QUERY_RESOLVE | wgpu.BufferUsage.COPY_SRC
            resolved = make.create_buffer(size=16 * len(passes), usage=usage)
            encoder = make.create_command_encoder()
            for place, call in enumerate(recorded):
                marks = {"beginning_of_pass_write_index": 2 * place, "end_of_pass_write_index": 2 * place + 1}
                computing = encoder.begin_compute_pass(timestamp_writes={"query_set": queries, **marks})
                dispatch(computing, call)
                computing.end()
            encoder.resolve_query_set(queries, 0, 2 * len(passes), resolved, 0)
            make.queue.submit([encoder.finish()])
            stamps = np.frombuffer(make.queue.read_buffer(resolved), dtype=np.uint64).reshape(-1, 2)
        found: dict[str, float] = {}
        for one, (begin, end) in zip(passes, stamps, strict=True):
            found[one.entry] = found.get(one.entry, 0.0) + (int(end) - int(begin)) / 1e6
        return found

    def _staging_for(self, names: tuple[str, ...]) -> Any:  # noqa: ANN401
        """Return a buffer that holds these buffers and can be mapped; it is kept for the next read."""
        import wgpu

        size = self._bytes_of(names)
        if size and (self._staging is None or self._staging.size < size):
            usage = wgpu.BufferUsage.MAP_READ | wgpu.BufferUsage.COPY_DST
            self._staging = self.device.device.create_buffer(size=size, usage=usage)
        return self._staging

    def _collected(self, names: tuple[str, ...], staging: Any) -> dict[str, np.ndarray]:  # noqa: ANN401
        if not names:
            return {}
        size = self._bytes_of(names)
        self.device.wait(staging.map_async("READ", 0, size))
        words = np.frombuffer(staging.read_mapped(0, size), dtype=np.uint32)
        staging.unmap()
        self.device.received += size
        lengths = [self._words[name] for name in names]
        return dict(zip(names, np.split(words, np.cumsum(lengths)[:-1]), strict=False))

    def _bytes_of(self, names: tuple[str, ...]) -> int:
        """Return the bytes of these buffers; mapped ranges are multiples of 8."""
        return -(-WORD * sum(self._words[name] for name in names) // 8) * 8


def _entry(binding: int, buffer: Mapping[str, object]) -> dict[str, object]:
    return {"binding": binding, "visibility": 4, "buffer": dict(buffer)}  # 4: ShaderStage.COMPUTE
