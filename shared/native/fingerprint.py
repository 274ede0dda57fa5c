"""Fingerprint of a kernel, sixteen hexadecimal digits: a hash of its source lines, those of all functions that it calls, and the
values of all constants that they read. Kernels with equal fingerprints have the same machine code."""

from __future__ import annotations

import functools
import hashlib
import linecache
from collections.abc import Callable, Iterator
from types import CodeType, ModuleType
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from penumbra.shared.native import Kernel

FORMAT = "1"
"""Version of the code around a kernel (`compiler._entry`). A change invalidates everything that was compiled before."""


def fingerprint(kernel: Kernel) -> str:
    """Fingerprint of a kernel. The sources are those on disk at the first call in the process."""
    records = {name: _constant(kind) for name, kind in sorted(kernel.signature.records.items())}
    return _digest(FORMAT, _of(kernel.function), repr(records))


@functools.cache
def _of(function: Callable[..., Any]) -> str:
    parts = [_source(function.__code__)]
    for name, value in used(function):
        if is_native(value):
            parts.append(f"{name} {'itself' if plain(value) is function else _of(plain(value))}")
        else:
            parts.append(f"{name} {_constant(value)}")
    return _digest(*parts)


def used(function: Callable[..., Any]) -> Iterator[tuple[str, Any]]:
    """Functions and constants that a function reads from its module and from the modules imported there, with their names."""
    names = sorted({name for code in _codes(function.__code__) for name in code.co_names})
    for name in names:
        value = function.__globals__.get(name)
        if isinstance(value, ModuleType):
            for attribute in names:
                of = getattr(value, attribute, None)
                if is_native(of) or _is_constant(of):
                    yield f"{name}.{attribute}", of
        elif is_native(value) or _is_constant(value):
            yield name, value


def is_native(value: Any) -> bool:
    """Whether a value is a kernel or a function decorated with `inner`."""
    return hasattr(value, "native_options")


def plain(value: Any) -> Callable[..., Any]:
    """Python function of a kernel or of a function decorated with `inner`."""
    return getattr(value, "function", value)  # type: ignore[no-any-return]


def _codes(code: CodeType) -> Iterator[CodeType]:
    yield code
    for value in code.co_consts:
        if isinstance(value, CodeType):
            yield from _codes(value)


def _source(code: CodeType) -> str:
    """Source lines of a function, with its decorators."""
    last = max(end or first or 0 for each in _codes(code) for first, end, _, _ in each.co_positions())
    return "".join(linecache.getlines(code.co_filename)[code.co_firstlineno - 1 : last])


def _is_constant(value: Any) -> bool:
    if isinstance(value, tuple):
        return all(_is_constant(each) for each in value)
    if isinstance(value, type):
        return issubclass(value, tuple) and hasattr(value, "_fields")  # a NamedTuple
    return isinstance(value, (bool, int, float, np.generic, np.ndarray, np.dtype))


def _constant(value: Any) -> str:
    """Text of a value, the same for all versions of Python and numpy."""
    if isinstance(value, type):
        return f"{value.__name__}{value._fields}"  # type: ignore[attr-defined]
    if isinstance(value, tuple):
        return f"({', '.join(_constant(each) for each in value)})"
    if isinstance(value, np.dtype):
        return f"{np.lib.format.dtype_to_descr(value)} {value.itemsize}"
    if isinstance(value, np.ndarray):
        return f"{value.dtype.str} {value.shape} {value.tobytes().hex()}"
    if isinstance(value, np.generic):
        return f"{value.dtype.str} {value.item()!r}"
    return repr(int(value) if isinstance(value, int) and not isinstance(value, bool) else value)


def _digest(*parts: str) -> str:
    return hashlib.sha256("\0".join(parts).encode()).hexdigest()[:16]
