"""Faults of a cell file as text: file, line, place, what was expected, what was found, and what to do."""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any


class CellError(ValueError):
    """A cell file that cannot be used. The text names the file, the line, what was expected and what was found."""


@dataclass(frozen=True)
class Fault:
    """A fault of a cell file. place: the keys that lead to it, joined by dots; empty where it concerns the whole file. A warning
    does not prevent a start."""

    path: Path
    line: int
    place: str
    reason: str
    is_warning: bool = False

    def __str__(self) -> str:
        return ": ".join(filter(None, (f"{self.path}:{self.line}", f"{self.place:.200}", f"{self.reason:.600}")))


class Faulty(ValueError):
    """Raised by a model's validator: places below the model, each with what was expected and found there."""

    def __init__(self, faults: Iterable[tuple[str, str]]):
        self.faults = tuple(faults)
        super().__init__("; ".join(f"{place}: {reason}" for place, reason in self.faults))


def refuse(faults: Sequence[tuple[str, str]]) -> None:
    """Raises Faulty where there are faults."""
    if faults:
        raise Faulty(faults)


def meant(name: str, known: Iterable[str]) -> str:
    """The hint `; did you mean NAME` where a known name resembles this one; else empty."""
    close = close_to(name, known)
    return f"; did you mean {close}" if close else ""


def close_to(name: str, known: Iterable[str]) -> str:
    """The known name that resembles a name; empty where none does."""
    known = list(known)
    close = difflib.get_close_matches(name[:60], known, 1, 0.6) or [each for each in known if each.lower() == name.lower()]
    return close[0] if close else ""


def short(value: Any) -> str:
    """A value in an error, shortened. Python refuses to print very long integers."""
    if isinstance(value, int) and not isinstance(value, bool) and value.bit_length() > 64:
        return f"an integer of {value.bit_length()} bits"
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, Mapping):
        return f"a map with {', '.join(f'{key!s:.40}' for key in list(value)[:5]) or 'nothing'}"
    if isinstance(value, list | tuple):
        return f"a list of {len(value)}"
    return "nothing" if value is None else f"{value!r:.100}"
