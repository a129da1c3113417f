"""Triton's interpreter without work that it repeats; a render with its gradients takes a third of the time."""

import functools

from triton.language import core, semantic
from triton.runtime import interpreter

_patch = getattr(interpreter, "_patch_lang", None)
_broadcast = semantic.TritonSemantic.broadcast_impl_value
_dtype = getattr(interpreter, "_get_np_dtype", None)
_dtypes = {}


@functools.cache
def _languages(fn):
    return [value for value in fn.__globals__.values() if value is interpreter.tl or value is core]


def _patch_once(fn):
    """Replace the language's functions for a kernel; not again at its calls of device functions."""
    if any(core.is_builtin(language.load) for language in _languages(fn)):
        return _patch(fn)
    return interpreter._LangPatchScope()


def _broadcast_where_shapes_differ(self, lhs, rhs):
    ours, other = lhs.type, rhs.type
    if ours.is_block() and other.is_block() and list(ours.shape) == list(other.shape):
        return lhs, rhs
    return _broadcast(self, lhs, rhs)


def _known_dtype(of):
    name = of.scalar.name
    if name not in _dtypes:
        _dtypes[name] = _dtype(of)
    return _dtypes[name]


def speed_up() -> None:
    """Replace the functions of the interpreter above by these, where this version of Triton has them."""
    if hasattr(interpreter, "_LangPatchScope"):
        interpreter._patch_lang, interpreter._get_np_dtype = _patch_once, _known_dtype
        semantic.TritonSemantic.broadcast_impl_value = _broadcast_where_shapes_differ
