"""Compiled inner loops: functions in plain Python on numpy arrays that run as machine code, without a compiler at run time.

    @inner                                             # called by kernels only: compiled into each of them
    def _square(x): ...

    @kernel("f8[n, 3], f8[3], out f8[n] -> i8")        # called from Python
    def nearest(points, origin, distances): ...

`python -m penumbra.shared.native.build` compiles all kernels with numba and links them into one library per processor,
`lib/*.so`, which is part of the repository. A symbol's name contains the `fingerprint` of its sources, so compiled code that does
not match its sources is never called. Kernels that the library lacks (edited ones, or all on a machine without a library) are
compiled at run time, where numba is installed, and cached in `jit.folder()` under that fingerprint.

The environment variable PENUMBRA_NATIVE selects what runs: `library` (default; see above), `jit` (never the libraries) or
`python` (the functions themselves, interpreted: slow, but debuggers and tracebacks work).

Limits on kernels: arrays are C-contiguous. Arrays that are written to are marked `out`. The result is one number; everything else
goes into arrays. Kernels raise nothing; a division by zero gives infinity, as in numpy. BLAS and LAPACK are not available (`@`,
`np.dot`, `np.linalg`): write loops, since matrices are small here. Small arrays may be allocated.
"""

from __future__ import annotations

import ctypes
import functools
import os
import struct
import threading
from collections.abc import Callable
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from penumbra.shared.native.fingerprint import fingerprint
from penumbra.shared.native.signature import Signature

Function = TypeVar("Function", bound=Callable[..., Any])
Progress = Callable[[int, int], None]
"""Called with the number of the kernel that is compiled next, from 1, and the number of kernels to compile."""

WAYS = ("library", "jit", "python")
KERNELS: dict[str, Kernel] = {}
"""All kernels of the modules imported so far, by name."""
KNOWN_SHAPES = 1000
"""Maximum number of argument shapes that a kernel remembers as valid. A check costs ten times as much as a lookup, and the number
of points of a contour changes in every pass of a search."""
_DATA = object.__basicsize__
"""Offset in a numpy array object of the address of its data: the first field after the object's header (`PyArrayObject` of
numpy's C interface). Reading it there costs a tenth of `array.ctypes.data`; `_check_layout` compares the two."""


def kernel(signature: str, fastmath: bool = False, **records: np.dtype[Any]) -> Callable[[Callable[..., Any]], Kernel]:
    """Decorator that makes a function a kernel.

    signature: see `signature.Signature`; records: the structured dtypes that it names; fastmath: sums may be reordered, so the
    last digits differ between processors. Raises ValueError on a signature that does not fit the function.
    """
    return lambda function: Kernel(function, Signature(signature, records), fastmath)


def inner(function: Function | None = None, *, fastmath: bool = False) -> Any:
    """Decorator for a function that kernels call; it stays a Python function. fastmath: as for `kernel`."""
    if function is None:
        return functools.partial(inner, fastmath=fastmath)
    function.native_options = {"fastmath": fastmath}  # type: ignore[attr-defined]
    return function


class Kernel:
    """A compiled function, called with positional arguments. It checks the types, layouts and sizes of arrays (TypeError),
    because compiled code does not. It releases the GIL."""

    def __init__(self, function: Callable[..., Any], signature: Signature, fastmath: bool):
        functools.update_wrapper(self, function)
        self.function = function
        self.signature = signature
        self.native_options = {"fastmath": fastmath}
        self.name = f"{function.__module__}.{function.__qualname__}"
        names = function.__code__.co_varnames[: function.__code__.co_argcount]
        if len(names) != len(signature.parameters):
            raise ValueError(f"{self.name}: expected a signature of {len(names)} parameters, got {signature.text!r}")
        self._names = names
        self._count = len(names)
        self._arrays = tuple((each.dtype, each.flags) if each.is_array else None for each in signature.parameters)
        slots = [each.format for each in signature.parameters]
        self._pack = struct.Struct("=q" + "".join(slots) + "q" * bool(signature.result)).pack
        self._shapes: set[tuple[tuple[int, ...], ...]] = set()
        self._code: Callable[[bytes], int] | None = None
        KERNELS[self.name] = self

    @functools.cached_property
    def fingerprint(self) -> str:
        return fingerprint(self)

    @property
    def symbol(self) -> str:
        """The name of the compiled function."""
        return f"{self.name.replace('.', '_')}_{self.fingerprint}"

    def __call__(self, *arguments: Any) -> Any:
        if self._code is None and not self._load():
            return self.function(*(_with_attributes(each) for each in arguments))
        values: list[Any] = [_DATA]
        shapes = []
        try:
            for value, array in zip(arguments, self._arrays, strict=True):
                if array is None:
                    values.append(value)
                    continue
                dtype, flags = array
                if value.dtype is not dtype or value.flags.num & flags != flags:
                    self._check(arguments)
                shape = value.shape
                shapes.append(shape)
                values.append(id(value))
                values += shape
            fitting = tuple(shapes)
            if fitting not in self._shapes:
                self._check(arguments)
                if len(self._shapes) >= KNOWN_SHAPES:
                    self._shapes.clear()
                self._shapes.add(fitting)
            if self.signature.result is None:
                failed, result = self._code(self._pack(*values)), None  # type: ignore[misc]
            else:
                result = np.empty(1, self.signature.result)
                failed, result = self._code(self._pack(*values, id(result))), result.item()  # type: ignore[misc]
        except (AttributeError, ValueError, struct.error):
            self._check(arguments)
            raise
        if failed:
            raise RuntimeError(
                f"{self.name}: the compiled code failed (out of memory, or arrays inside it that do not fit together); "
                "set PENUMBRA_NATIVE=python to see where"
            )
        return result

    def _check(self, arguments: tuple[Any, ...]) -> None:
        """Raises TypeError that names the argument that does not fit the signature."""
        if len(arguments) != self._count:
            raise TypeError(f"{self.name}: expected {self._count} arguments ({', '.join(self._names)}), got {len(arguments)}")
        sizes: dict[str, tuple[int, str]] = {}
        for name, value, parameter in zip(self._names, arguments, self.signature.parameters, strict=True):
            fault = parameter.fault(name, value, sizes)
            if fault:
                raise TypeError(f"{self.name}: {name}: expected {parameter}, got {fault}")

    def _load(self) -> bool:
        """Loads or compiles the machine code; false where the Python function is to be called instead."""
        if _way() == "python":
            return False
        with _LOCK:
            if self._code is None:
                self._code = _in_library(self) or _compiled([self])[0]
        return True


def load() -> list[Kernel]:
    """Loads the kernels of all modules imported so far from the library, and returns those that the library lacks."""
    if _way() == "python":
        return []
    with _LOCK:
        for each in KERNELS.values():
            each._code = each._code or _in_library(each)
        return [each for each in KERNELS.values() if each._code is None]


def prepare(progress: Progress | None = None) -> None:
    """Loads the kernels of all modules imported so far and compiles those that the library lacks, so that no first call has to.
    Raises ImportError where this requires numba and it is not installed."""
    with _LOCK:
        missing = load()
        for each, code in zip(missing, _compiled(missing, progress), strict=True):
            each._code = code


def _with_attributes(value: Any) -> Any:
    """Structured arrays as record arrays, whose fields are attributes, as in compiled code."""
    return value.view(np.recarray) if isinstance(value, np.ndarray) and value.dtype.names else value


def _way() -> str:
    way = os.environ.get("PENUMBRA_NATIVE", "library")
    if way not in WAYS:
        raise ValueError(f"PENUMBRA_NATIVE: expected one of {', '.join(WAYS)}, got {way!r}")
    return way


def _in_library(kernel: Kernel) -> Callable[[bytes], int] | None:
    """Code of the kernel in this machine's library; None where the library lacks it."""
    library = _library() if _way() == "library" else None
    if library is None:
        return None
    try:
        code = library[kernel.symbol]
    except AttributeError:
        return None
    code.argtypes, code.restype = (ctypes.c_char_p,), ctypes.c_int
    return code


def _compiled(kernels: list[Kernel], progress: Progress | None = None) -> list[Callable[[bytes], int]]:
    """Code of kernels that the library lacks."""
    if not kernels:
        return []
    _check_layout()
    try:
        from penumbra.shared.native import jit
    except ImportError as error:
        raise ImportError(
            f"{kernels[0].name}: expected compiled code for this source and this machine in shared/native/lib, found none, and "
            f"{error.name} is not installed to compile it; do pip install 'penumbra[native]', or restore the source"
        ) from error
    return jit.load(kernels, progress)


@functools.cache
def _library() -> ctypes.CDLL | None:
    from penumbra.shared.native.machine import library

    path = library()
    if path is None:
        return None
    _check_layout()
    return ctypes.CDLL(str(path))


@functools.cache
def _check_layout() -> None:
    probe: NDArray[np.float64] = np.empty(1)
    address = ctypes.c_void_p.from_address(id(probe) + _DATA).value
    if address != probe.ctypes.data:
        raise RuntimeError(
            f"numpy {np.__version__}: expected an array to hold its data's address {_DATA} bytes from its beginning; "
            "set PENUMBRA_NATIVE=python, and report this interpreter"
        )


_LOCK = threading.RLock()

__all__ = ["KERNELS", "Kernel", "Progress", "inner", "kernel", "load", "prepare"]
