"""Turns at fixed instants: data due at an instant is prepared before it and sent at it."""

from __future__ import annotations

import math
import time
from collections.abc import Callable

SMOOTHING = 0.25
"""Weight of the newest turn in the mean preparation time: a single slow turn must not reduce the rate of the next ones."""

SET_NS = 1_000_000
"""Difference [ns] of the wall clock from the steady one above which it was set."""


class Time:
    """The time of the world: it begins now and runs steadily, even if the wall clock wall_ns() is set, as reality does.

    began_ns: start by the steady clock, which all processes of the machine share.
    """

    def __init__(self, wall_ns: Callable[[], int]):
        self._wall_ns = wall_ns
        self.began_ns = time.monotonic_ns()
        self._epoch_ns = wall_ns()

    def now_ns(self) -> int:
        """Time [ns] since the start."""
        return time.monotonic_ns() - self.began_ns

    def epoch_ns(self) -> int:
        """The start by the wall clock as currently set."""
        epoch_ns = self._wall_ns() - self.now_ns()
        if abs(epoch_ns - self._epoch_ns) > SET_NS:
            self._epoch_ns = epoch_ns
        return self._epoch_ns


class Pacer:
    """Counts the ticks of a stream: tick k is due at epoch_ns + k * period_ns by the clock now_ns().

    Ticks that would be ready more than `late_ns` late, by the recent preparation times, are dropped: on a busy machine the stream
    becomes thinner, not later, and nothing queues.
    """

    def __init__(self, epoch_ns: int, period_ns: float, now_ns: Callable[[], int], late_ns: float):
        self._epoch_ns, self._period_ns, self._now_ns, self._late_ns = epoch_ns, period_ns, now_ns, late_ns
        self._last: int | None = None
        self._begun_ns = 0
        self._takes_ns = 0.0
        self.dropped = 0

    def next(self) -> int:
        """The tick to prepare now, at least 1: the one after the last, or the first that can be ready in time."""
        self._begun_ns = self._now_ns()
        ready_ns = self._begun_ns + self._takes_ns - self._late_ns
        in_time = max(1, math.ceil((ready_ns - self._epoch_ns) / self._period_ns))
        if self._last is None:
            self._last = in_time
        else:
            self.dropped += max(0, in_time - self._last - 1)
            self._last = max(self._last + 1, in_time)
        return self._last

    def ready(self) -> float:
        """Seconds until the prepared tick is due, zero if it is overdue; ends the preparation begun by `next`."""
        now_ns = self._now_ns()
        self._takes_ns += SMOOTHING * (now_ns - self._begun_ns - self._takes_ns)
        return max(0.0, (self._epoch_ns + (self._last or 0) * self._period_ns - now_ns) * 1e-9)
