"""Signature of a kernel in one line: `f8[n, 3], i4[m, 3], f8, out f8[n] -> i8`."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

SCALARS = {"f8": "d", "f4": "d", "i8": "q", "b1": "q"}
"""Types of numbers in numpy's notation, each with its `struct` format. Arrays may have any numpy type."""
_PARAMETER = re.compile(r"(out )?(\w+)(?:\[([^\]]*)\])?$")
_CONTIGUOUS, _ALIGNED, _WRITEABLE = 0x1, 0x100, 0x400  # bits of numpy's ndarray.flags.num


@dataclass(frozen=True)
class Parameter:
    """One parameter. dtype: its type; sizes: a number or a name for each dimension of an array, empty for a number; equal names
    in a signature stand for equal sizes; is_out: whether the kernel writes to it."""

    text: str
    dtype: np.dtype[Any]
    sizes: tuple[int | str, ...] = ()
    is_out: bool = False

    def __str__(self) -> str:
        return self.text

    @property
    def is_array(self) -> bool:
        return bool(self.sizes)

    @property
    def flags(self) -> int:
        """Bits of `ndarray.flags.num` that an array must have."""
        return _CONTIGUOUS | _ALIGNED | (_WRITEABLE if self.is_out else 0)

    @property
    def format(self) -> str:
        """Its `struct` format: an array is passed as the object's address and its sizes."""
        return "q" * (1 + len(self.sizes)) if self.sizes else SCALARS[self.dtype.str[1:]]

    def fault(self, name: str, value: Any, sizes: dict[str, tuple[int, str]]) -> str | None:
        """Description of a value that does not fit, else None. sizes: named sizes so far, with their parameters; extended by the
        call."""
        if not self.sizes:
            kinds: tuple[type, ...] = (int, np.integer, bool, np.bool_) if self.dtype.kind != "f" else (int, float, np.number)
            return None if isinstance(value, kinds) and not isinstance(value, complex) else f"{value!r}"
        if not isinstance(value, np.ndarray):
            return f"{type(value).__name__}"
        if value.dtype != self.dtype or value.ndim != len(self.sizes):
            return _described(value)
        for expected, size in zip(self.sizes, value.shape, strict=True):
            if isinstance(expected, int):
                if size != expected:
                    return _described(value)
            else:
                known, where = sizes.setdefault(expected, (size, name))
                if known != size:
                    return f"{_described(value)}, with {expected} = {known} from {where}"
        if not value.flags.c_contiguous or not value.flags.aligned:
            return f"{_described(value)} that is not contiguous (or not aligned); do np.ascontiguousarray"
        if self.is_out and not value.flags.writeable:
            return f"{_described(value)} that is read-only"
        return None


def _described(value: np.ndarray[Any, Any]) -> str:
    """Type and shape of an array. For faults only: shapes are checked in every pass of a search, and numpy formats dtypes
    slowly."""
    return f"an array {value.dtype} {value.shape}"


class Signature:
    """The parameters of a kernel, in order, and its result: a number of type `result`, or None.

    A parameter is a type (f8, f4, i8, i4, u1, b1, the name of a structured type in `records`, ...), followed by its sizes if it
    is an array. Raises ValueError on any other text.
    """

    def __init__(self, text: str, records: Mapping[str, np.dtype[Any]] | None = None):
        self.text = text
        self.records = dict(records or {})
        given, _, result = (part.strip() for part in text.partition("->"))
        self.result = self._number(result) if result else None
        self.parameters = tuple(self._parameter(each.strip()) for each in re.split(r",(?![^\[]*\])", given)) if given else ()

    def _parameter(self, text: str) -> Parameter:
        found = _PARAMETER.match(text)
        if found is None:
            raise ValueError(f"expected a type such as f8 or out f8[n, 3], got {text!r} in {self.text!r}")
        out, kind, sizes = found.groups()
        if sizes is None:
            return Parameter(text, self._number(kind))
        names = tuple(int(each) if each.strip().isdigit() else each.strip() for each in sizes.split(","))
        return Parameter(text, self._type(kind), names, bool(out))

    def _number(self, kind: str) -> np.dtype[Any]:
        if kind not in SCALARS:
            raise ValueError(f"expected a number of type {', '.join(SCALARS)}, got {kind!r} in {self.text!r}")
        return np.dtype(kind)

    def _type(self, kind: str) -> np.dtype[Any]:
        try:
            return self.records[kind] if kind in self.records else np.dtype(kind)
        except TypeError:
            raise ValueError(f"expected one of numpy's types, or one given by name, got {kind!r} in {self.text!r}") from None
