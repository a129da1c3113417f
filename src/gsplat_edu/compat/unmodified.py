"""Run code that imports gsplat and asks for "cuda" on a CPU, without changing it.

    from gsplat_edu.compat import install
    install()                              # before the code that imports gsplat
    python -m gsplat_edu.compat script.py  # the same, from outside

Two things are changed in this process, and `uninstall` reverts both.

- **gsplat.** If the package is installed, its Python stays: strategies, utilities, exporters. Every function that
  `gsplat_edu.compat.gsplat` exports takes the place of gsplat's own in all modules of gsplat. If it is not installed,
  modules of its names are registered with what we export; a name that only gsplat has is an error that says so.
- **Devices.** A `TorchFunctionMode` turns CUDA devices in the arguments of torch's functions into the CPU; `.cuda()`
  and `.pin_memory()` return the tensor itself. Torch keeps such modes for each thread: this one works in the thread
  that calls `install`, in the threads that are started afterwards, and in processes that are forked, such as those of
  a `DataLoader`. `torch.cuda.is_available()` does not change. `PATCHES` has what does not pass through modes.
"""

from __future__ import annotations

import importlib
import importlib.util
import re
import sys
import threading
from collections.abc import Callable
from contextlib import ExitStack, nullcontext
from importlib.machinery import ModuleSpec
from types import ModuleType
from typing import Any

import torch
from torch.overrides import TorchFunctionMode

from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.base.printing import complain
from gsplat_edu.compat import gsplat as ours
from gsplat_edu.compat.streams import CURRENT, Event, Stream

CUDA = re.compile(r"cuda(:\d+)?")
"""Names of CUDA devices."""

GSPLAT = re.compile(r"gsplat(\.|$)")
"""Names of gsplat's modules."""

WITH_KERNELS = ("", ".rendering", ".relocation", ".cuda", ".cuda._wrapper")
"""Modules of gsplat that have the functions we export; "" is gsplat itself."""

WITH_PYTHON = (
    ".strategy",
    ".strategy.ops",
    ".utils",
    ".distributed",
    ".optimizers",
    ".compression",
    ".exporter",
)
"""Modules of gsplat that code imports for its Python."""

_installed: list[ExitStack] = []
"""What reverts the changes; empty if nothing is installed."""


def install() -> None:
    """Let code that imports gsplat run on our kernels, and its "cuda" mean the CPU; print one line that says so.

    Call it before that code is imported. A second call changes nothing.

    Raises:
        ArgumentError: gsplat is imported already with its CUDA kernels.
    """
    if _installed:
        return
    if getattr(sys.modules.get("gsplat.cuda._backend"), "_C", None) is not None:
        raise ArgumentError(
            "gsplat: is imported with its CUDA kernels; call install() before anything uses them"
        )
    with ExitStack() as stack:
        found = importlib.util.find_spec("gsplat") is not None
        source = _patch_gsplat(stack) if found else _register_modules(stack)
        stack.enter_context(_ToCpu())
        for owner, name, change in PATCHES:
            _set(stack, owner, name, change(getattr(owner, name)))
        _installed.append(stack.pop_all())
    complain(
        f"gsplat_edu: {source}; devices named cuda are the CPU, and .cuda() does nothing; uninstall() reverts"
    )


def uninstall() -> None:
    """Revert what `install` did; without it, do nothing. Code that has imported our functions keeps them."""
    while _installed:
        _installed.pop().close()


class _ToCpu(TorchFunctionMode):
    """Turns CUDA devices in the arguments of torch's functions into the CPU."""

    def __torch_function__(
        self,
        func: Callable[..., Any],
        types: object,
        args: tuple[Any, ...] = (),
        kwargs: dict[str, Any] | None = None,
    ) -> Any:  # noqa: ANN401
        if func in (torch.Tensor.cuda, torch.Tensor.pin_memory):
            return args[0]
        numbered = func is torch.Tensor.to
        mapped = {name: _on_cpu(value, name == "device") for name, value in (kwargs or {}).items()}
        mapped.pop("pin_memory", None)
        return func(*(_on_cpu(value, numbered) for value in args), **mapped)


def _on_cpu(value: Any, numbered: bool = False) -> Any:  # noqa: ANN401
    """Return the CPU for a CUDA device, and everything else as it is; `numbered` if a whole number names a device."""
    if isinstance(value, torch.device):
        return torch.device("cpu") if value.type == "cuda" else value
    if isinstance(value, str) and CUDA.fullmatch(value):
        return "cpu"
    return "cpu" if numbered and type(value) is int else value


def _with_cpu(function: Callable[..., Any]) -> Callable[..., Any]:
    """Wrap a function whose devices torch does not pass through modes; a whole number in its arguments is a device."""

    def call(*args: Any, **kwargs: Any) -> Any:  # noqa: ANN401
        mapped = {name: _on_cpu(value, numbered=True) for name, value in kwargs.items()}
        return function(*(_on_cpu(value, numbered=True) for value in args), **mapped)

    return call


def _returning(result: object) -> Callable[[object], Callable[..., Any]]:
    """Return what replaces a function that waits for a GPU, chooses or measures one by one that returns `result`."""
    return lambda function: lambda *args, **kwargs: result


def _becoming(replacement: object) -> Callable[[object], object]:
    """Return what replaces anything by `replacement`."""
    return lambda original: replacement


def _with_mode(start: Callable[[threading.Thread], None]) -> Callable[[threading.Thread], None]:
    """Wrap `Thread.start`: the new thread has the mode as well."""

    def call(thread: threading.Thread) -> None:
        run = thread.run

        def in_mode() -> None:
            with _ToCpu():
                run()

        vars(thread)["run"] = in_mode  # also that of a subclass
        start(thread)

    return call


def _generators(original: type[torch.Generator]) -> type:
    """Return a class that makes torch's generators on the CPU; every generator is an instance of it."""

    class Kind(type):
        def __call__(cls, device: Any = "cpu") -> torch.Generator:  # noqa: ANN401
            return original(_on_cpu(device, numbered=True))

        def __instancecheck__(cls, instance: object) -> bool:
            return isinstance(instance, original)

    return Kind("Generator", (), {})


PATCHES: tuple[tuple[Any, str, Callable[[Any], Any]], ...] = (
    (torch, "load", _with_cpu),
    (torch, "set_default_device", _with_cpu),
    (torch, "Generator", _generators),
    (torch.nn.Module, "to", _with_cpu),
    (torch.cuda, "synchronize", _returning(None)),
    (torch.cuda, "set_device", _returning(None)),
    (torch.cuda, "current_device", _returning(0)),
    (torch.cuda, "device", _returning(nullcontext())),
    (torch.cuda, "Event", _becoming(Event)),
    (torch.cuda, "Stream", _becoming(Stream)),
    (torch.cuda, "current_stream", _returning(CURRENT)),
    (torch.cuda, "default_stream", _returning(CURRENT)),
    (torch.cuda, "set_stream", _returning(None)),
    (torch.cuda, "stream", _returning(nullcontext())),
    (torch.Tensor, "record_stream", _returning(None)),
    (torch.cuda, "max_memory_allocated", _returning(0)),
    (torch.cuda, "memory_allocated", _returning(0)),
    (torch.cuda, "reset_peak_memory_stats", _returning(None)),
    (threading.Thread, "start", _with_mode),
)
"""Functions and classes of torch that `install` replaces: owner, name, and what makes the replacement."""


def _set(stack: ExitStack, owner: Any, name: str, value: object) -> None:  # noqa: ANN401
    """Set an attribute until the stack is closed."""
    stack.callback(setattr, owner, name, getattr(owner, name))
    setattr(owner, name, value)


def _exports() -> dict[str, Any]:
    return {name: getattr(ours, name) for name in ours.__all__}


def _patch_gsplat(stack: ExitStack) -> str:
    """Put our functions in the place of those of the installed gsplat, in all of its modules."""
    if "gsplat" not in sys.modules:
        stack.callback(_forget_gsplat)
    if "gsplat.cuda._backend" not in sys.modules:  # it would load the CUDA extension, or compile it
        backend = ModuleType("gsplat.cuda._backend")
        vars(backend)["_C"] = None  # what gsplat has without an extension
        _register(stack, backend)
    for name in (*WITH_KERNELS, *WITH_PYTHON):
        importlib.import_module(f"gsplat{name}")
    theirs = [module for name, module in sys.modules.items() if GSPLAT.match(name)]
    replacements = _exports() | {
        "cli": _run_alone,
        "_make_lazy_cuda_func": _missing_function,
        "_make_lazy_cuda_obj": _missing,
    }
    owners = [sys.modules[f"gsplat{name}"] for name in (*WITH_KERNELS, ".distributed")]
    old = {
        id(value): name for module in owners for name, value in vars(module).items() if name in replacements
    }
    for module in theirs:
        for name, value in list(vars(module).items()):
            if id(value) in old:
                _set(stack, module, name, replacements[old[id(value)]])
    shared = len(set(old.values()) & set(ours.__all__))
    version = getattr(sys.modules["gsplat"], "__version__", "of unknown version")
    return f"gsplat {version} has our kernels in {shared} functions"


def _register_modules(stack: ExitStack) -> str:
    """Register modules with gsplat's names and our functions; what only gsplat has is an error that says so."""
    for name in (*WITH_KERNELS, *WITH_PYTHON):
        spec = ModuleSpec(f"gsplat{name}", None, is_package=True)
        module = importlib.util.module_from_spec(spec)
        if name in WITH_KERNELS:
            vars(module).update(_exports())
        if name == ".distributed":
            vars(module)["cli"] = _run_alone
        vars(module)["__getattr__"] = _absent_from(module)
        _register(stack, module)
        parent, _, child = spec.name.rpartition(".")
        if parent:
            vars(sys.modules[parent])[child] = module
    return f"gsplat is not installed; modules of its name have our {len(ours.__all__)} functions"


def _register(stack: ExitStack, module: ModuleType) -> None:
    """Make a module importable by its name until the stack is closed."""
    name = module.__name__
    if name in sys.modules:
        stack.callback(sys.modules.__setitem__, name, sys.modules[name])
    else:
        stack.callback(sys.modules.pop, name, None)
    sys.modules[name] = module


def _forget_gsplat() -> None:
    """Unload gsplat, so that the next import loads it with its own functions."""
    for name in [name for name in sys.modules if GSPLAT.match(name)]:
        del sys.modules[name]


def _absent_from(module: ModuleType) -> Callable[[str], Any]:
    """Return a module's `__getattr__` for names that only gsplat has."""

    def refuse(name: str) -> Any:  # noqa: ANN401
        if name.startswith("__"):
            raise AttributeError(f"module {module.__name__!r} has no attribute {name!r}")
        raise ImportError(
            f"{module.__name__}.{name}: comes from gsplat's Python, which is not installed; run pip install gsplat,"
            " which needs neither compiler nor GPU"
        )

    return refuse


def _missing_function(name: str) -> Callable[..., Any]:
    """Take the place of gsplat's `_make_lazy_cuda_func`: the function it makes refuses to run."""
    return lambda *args, **kwargs: _missing(name)


def _missing(name: str) -> Any:  # noqa: ANN401
    raise ArgumentError(f"gsplat: {name} needs its CUDA kernels, and gsplat_edu has no function for it")


def _run_alone(fn: Callable[..., object], args: object, verbose: bool = False) -> bool:
    """Take the place of `gsplat.distributed.cli`: run a function as the only process, on the CPU."""
    fn(0, 0, 1, args)
    return True
