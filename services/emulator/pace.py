"""Turns at fixed instants: what is due at an instant is prepared before it and sent at it."""

from __future__ import annotations

import math
from collections.abc import Callable


class Pacer:
    """Counts the ticks of a stream: tick k is due at epoch_ns + k * period_ns by the clock now_ns(). After a delay the ticks that
    are more than `late_ns` overdue are dropped, none is queued, and the rhythm stays."""

    def __init__(self, epoch_ns: int, period_ns: float, now_ns: Callable[[], int], late_ns: float):
        self._epoch_ns, self._period_ns, self._now_ns, self._late_ns = epoch_ns, period_ns, now_ns, late_ns
        self._last: int | None = None
        self.dropped = 0

    def next(self) -> int:
        """The tick to prepare now, at least 1: the one after the last, or the first that is not too late."""
        in_time = max(1, math.ceil((self._now_ns() - self._late_ns - self._epoch_ns) / self._period_ns))
        if self._last is None:
            self._last = in_time
        else:
            self.dropped += max(0, in_time - self._last - 1)
            self._last = max(self._last + 1, in_time)
        return self._last

    def remaining_s(self, k: int) -> float:
        """Seconds until tick k is due, zero where it is past."""
        return max(0.0, (self._epoch_ns + k * self._period_ns - self._now_ns()) * 1e-9)
