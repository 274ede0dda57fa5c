"""Counters of what is received and published on a key: how many messages, how often, how old."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass, field

from shared.contract.report import TopicReport

RATE_WINDOW_S = 3.0
"""Time over which a rate is averaged."""


class Rate:
    """Events per second over about the last RATE_WINDOW_S, at a constant cost per event: an exponentially weighted count,
    divided by the weight that the time since the first event can have."""

    def __init__(self) -> None:
        self._first = self._last = math.nan
        self._weight = 0.0

    def add(self, now_s: float) -> None:
        if math.isnan(self._first):
            self._first = self._last = now_s  # one event has no rate: it only starts the clock
            return
        self._weight = self._weight * math.exp((self._last - now_s) / RATE_WINDOW_S) + 1.0
        self._last = now_s

    def hz(self, now_s: float) -> float:
        elapsed = now_s - self._first
        if not elapsed > 0:
            return 0.0
        weight = self._weight * math.exp((self._last - now_s) / RATE_WINDOW_S)
        return weight / (RATE_WINDOW_S * -math.expm1(-elapsed / RATE_WINDOW_S))


@dataclass
class Traffic:
    """What came (or went) on one key. `stale_s`: the age after which it is missing; `publishers`: the services that may publish
    it, where it is read; `bad`: refused messages by kind; `dropped`: gaps in the publishers' own count, None for what cannot be
    known; `delay_s`: from the measurement to here, of the last message; `is_read`: whether anybody here reads it
    now: what another replica reads is never stale."""

    stale_s: float
    publishers: tuple[str, ...] = ()
    count: int = 0
    bad: dict[str, int] = field(default_factory=dict)
    dropped: int | None = None
    stamp_ns: int | None = None
    delay_s: float = math.nan
    is_read: bool = True
    rate: Rate = field(default_factory=Rate)

    def took(self, stamp_ns: int, now_ns: int | None, now_s: float | None = None) -> None:
        """Counts a good message. now_ns: when it came by the clock of stamps, None where that is not known. now_s: the same by a
        steady clock, now where it is left out."""
        self.count += 1
        self.stamp_ns = stamp_ns
        if now_ns is not None:
            self.delay_s = (now_ns - stamp_ns) * 1e-9
        self.rate.add(time.monotonic() if now_s is None else now_s)

    def missed(self, count: int | None) -> None:
        """Counts messages that did not come; None where the publisher does not number them."""
        if count is not None:
            self.dropped = (self.dropped or 0) + count

    def age_s(self, now_ns: int) -> float | None:
        """Seconds since the newest measurement; None where none ever came."""
        return None if self.stamp_ns is None else (now_ns - self.stamp_ns) * 1e-9

    def is_stale(self, now_ns: int) -> bool:
        age = self.age_s(now_ns)
        return self.is_read and math.isfinite(self.stale_s) and (age is None or age > self.stale_s)

    def report(self, now_ns: int) -> TopicReport:
        """The counters for the health report."""
        age = self.age_s(now_ns)
        return TopicReport(
            count=self.count,
            rate_hz=round(self.rate.hz(time.monotonic()), 2),
            age_s=None if age is None else round(age, 4),
            delay_s=None if math.isnan(self.delay_s) else round(self.delay_s, 5),
            dropped=self.dropped,
            bad=dict(self.bad),
            stale=self.is_stale(now_ns),
        )
