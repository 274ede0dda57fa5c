"""A filter that takes its measurements late and out of order: go back to the stamp, apply, replay what came after.

The result depends on the measurements and their stamps alone, never on the order of arrival (within the horizon): the whole
state of the filter, what it refused included, is a function of the state before and the measurement.
"""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections.abc import Callable
from typing import Generic, Protocol, TypeVar

State = TypeVar("State")


class Stamped(Protocol):
    """A measurement, in the order in which it has to be applied."""

    @property
    def key(self) -> tuple[int, str]:
        """Stamp [ns] and source; equal keys are the same measurement."""
        ...


M = TypeVar("M", bound=Stamped)


class History(Generic[State, M]):
    """The measurements of the last `horizon_s`, each with the state after it.

    `step(state, measurement)` returns the state after a measurement; `state` is None before the first.
    """

    def __init__(self, step: Callable[[State | None, M], State], horizon_s: float):
        self._step = step
        self._horizon_ns = int(horizon_s * 1e9)
        self._keys: list[tuple[int, str]] = []
        self._measurements: list[M] = []
        self._states: list[State] = []
        self._base: State | None = None  # the state after the newest measurement that has left the history
        self._base_key = (-(1 << 62), "")

    def insert(self, measurement: M) -> str:
        """'applied', 'late' (older than the history: not applied) or 'duplicate' (not applied)."""
        key = measurement.key
        if key <= self._base_key or (self._keys and key[0] < self._keys[-1][0] - self._horizon_ns):
            return "late"
        at = bisect_left(self._keys, key)
        if at < len(self._keys) and self._keys[at] == key:
            return "duplicate"
        self._keys.insert(at, key)
        self._measurements.insert(at, measurement)
        del self._states[at:]
        state = self._states[-1] if at else self._base
        for later in self._measurements[at:]:
            state = self._step(state, later)
            self._states.append(state)
        self._forget()
        return "applied"

    def before(self, stamp_ns: int) -> State | None:
        """The state after the newest measurement not after `stamp_ns`; the oldest one kept, if all are; None before the first."""
        at = bisect_right(self._keys, (stamp_ns, "\uffff"))
        if at:
            return self._states[at - 1]
        return self._base if self._base is not None else self._states[0] if self._states else None

    def after(self, key: tuple[int, str]) -> State:
        """The state just after the measurement with this key."""
        return self._states[bisect_left(self._keys, key)]

    def _forget(self) -> None:
        old = bisect_left(self._keys, (self._keys[-1][0] - self._horizon_ns, ""))
        if old:
            self._base, self._base_key = self._states[old - 1], self._keys[old - 1]
            del self._keys[:old], self._measurements[:old], self._states[:old]
