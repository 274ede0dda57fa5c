"""Counters of the messages received and published on a key: number, rate and age."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from penumbra.shared.contract.report import TopicReport

RATE_WINDOW_S = 3.0
"""Time constant [s] of the mean rate."""


class Rate:
    """Event rate over about the last RATE_WINDOW_S. It is derived from a count that is read now and then, so that an event costs
    nothing: the exponentially weighted mean of the rates between two reads, divided by the total weight of the time since the
    first event. `hz`: the rate at the last read."""

    def __init__(self) -> None:
        self._first_s = self._last_s = math.nan
        self._count = 0
        self._mean_hz = 0.0
        self.hz = 0.0

    def look(self, count: int, now_s: float) -> None:
        """Reads the count of events so far. `now_s` must be monotonic."""
        if count and math.isnan(self._first_s):  # the time of the events before this read is unknown
            self._first_s = self._last_s = now_s
            self._count = count
        elif now_s > self._last_s:
            since_s = now_s - self._last_s
            share = -math.expm1(-since_s / RATE_WINDOW_S)
            self._mean_hz += share * ((count - self._count) / since_s - self._mean_hz)
            self.hz = self._mean_hz / -math.expm1((self._first_s - now_s) / RATE_WINDOW_S)
            self._last_s, self._count = now_s, count


@dataclass
class Traffic:
    """Counters of one key that is received or published. `stale_s`: age after which it is missing; `publishers`: the services
    that may publish it, where it is read; `bad`: refused messages by kind; `dropped`: gaps in the publishers' numbers, None where
    unknown; `delay_s`: from the last message's measurement to its arrival; `is_read`: whether this process reads it now; what
    another replica reads is never stale; `is_exclusive`: whether one publisher at a time is expected, rather than replicas that
    share the stream; `turns`: how often another publisher than before sent a message."""

    stale_s: float
    publishers: tuple[str, ...] = ()
    count: int = 0
    bad: dict[str, int] = field(default_factory=dict)
    dropped: int | None = None
    stamp_ns: int | None = None
    delay_s: float = math.nan
    is_read: bool = True
    is_exclusive: bool = False
    turns: int = 0
    rate: Rate = field(default_factory=Rate)

    def record(self, stamp_ns: int, now_ns: int | None) -> None:
        """Counts a good message. now_ns: time of its arrival by the clock of stamps, None where it is unknown."""
        self.count += 1
        self.stamp_ns = stamp_ns
        if now_ns is not None:
            self.delay_s = (now_ns - stamp_ns) * 1e-9

    def missed(self, count: int | None) -> None:
        """Counts messages that did not arrive; None where the publisher does not number them."""
        if count is not None:
            self.dropped = (self.dropped or 0) + count

    def age_s(self, now_ns: int) -> float | None:
        """Time since the newest measurement [s]; None before the first."""
        return None if self.stamp_ns is None else (now_ns - self.stamp_ns) * 1e-9

    def is_stale(self, now_ns: int) -> bool:
        age = self.age_s(now_ns)
        return self.is_read and math.isfinite(self.stale_s) and (age is None or age > self.stale_s)

    def report(self, now_ns: int) -> TopicReport:
        """The counters for the health report."""
        age = self.age_s(now_ns)
        return TopicReport(
            count=self.count,
            rate_hz=round(self.rate.hz, 2),
            age_s=None if age is None else round(age, 4),
            delay_s=None if math.isnan(self.delay_s) else round(self.delay_s, 5),
            dropped=self.dropped,
            bad=dict(self.bad),
            stale=self.is_stale(now_ns),
        )
