"""When a picture was exposed: conversions between clocks, and the time of a stream by its quickest pictures. Numbers only."""

from __future__ import annotations

import math

from penumbra.shared.runtime.lowest import Lowest

OLDEST_S = 5.0
"""Age [s] of a driver's stamp above which it belongs to another clock."""
AHEAD_S = 0.01
"""How far [s] a driver's stamp may be ahead of the clock that it is compared with."""
WINDOW_S = 60.0
"""Time [s] for which a quick picture counts: clocks drift by a few milliseconds in it."""
CALM_S = 0.3
"""Time [s] without a quicker picture after which a stream has settled."""
QUICKER_S = 0.005
"""By how much [s] a picture must be quicker than all before it to show that the stream has not settled."""
SETTLES_S = 3.0
"""Time [s] after which a stream counts as settled in any case."""
BACK_S = 1.0
"""A stream's clock that goes back by more [s] was set anew."""


def of_driver(stamp_ns: int, monotonic_ns: int, epoch_ns: int) -> int | None:
    """A driver's stamp in nanoseconds since the epoch, given what both clocks of this host show now.

    Drivers of V4L2 stamp by CLOCK_MONOTONIC, old ones by the time of day. None where the stamp belongs to neither.
    """
    for now_ns in (monotonic_ns, epoch_ns):
        if -AHEAD_S <= (now_ns - stamp_ns) * 1e-9 <= OLDEST_S:
            return epoch_ns - (now_ns - stamp_ns)
    return None


class StreamClock:
    """This host's time of a stream's own stamps, which count from an unknown moment.

    A picture arrives late by what sender, network and decoder take, and never early: the smallest difference between arrival
    and stamp, that of the quickest picture, is the moment at which the stream's clock began and the latency that all have in
    common. The first pictures of a stream come in a burst; `is_settled` tells when it is over.
    """

    def __init__(self) -> None:
        self._begin()

    def _begin(self) -> None:
        self._lowest = Lowest(WINDOW_S)
        self._began_s: float | None = None
        self._quick: tuple[float, float] = (0.0, float("inf"))  # when the last picture came that was quicker, and its difference
        self._last_ns = 0

    def stamp(self, own_ns: int, arrival_ns: int, now_s: float) -> int:
        """When a picture left its sender [ns since the epoch], late by the latency that all have in common.

        own_ns: its stamp in the stream. arrival_ns: since the epoch. now_s: the same time by a steady clock.
        """
        if self._began_s is not None and (self._last_ns - own_ns) * 1e-9 > BACK_S:
            self._begin()
        if self._began_s is None:
            self._began_s, self._first_ns = now_s, own_ns
        self._last_ns = own_ns
        difference = now_s - self._began_s - (own_ns - self._first_ns) * 1e-9  # by the steady clock: the other one may be set
        if difference < self._quick[1] - QUICKER_S:
            self._quick = (now_s, difference)
        return arrival_ns - round(1e9 * (difference - self._lowest.add(difference, now_s)))

    def is_settled(self, now_s: float) -> bool:
        """Whether the burst at the beginning is over."""
        if self._began_s is None:
            return False
        return now_s - self._quick[0] > CALM_S or now_s - self._began_s > SETTLES_S


class Backlog:
    """Tells old pictures of a camera without a clock: after a pause, those that need not be waited for have waited themselves."""

    GAP_S, GAP_PERIODS = 0.3, 3.0
    """A longer time [s], in periods too, between two pictures is a pause."""
    QUICK = 0.25
    """A picture that comes in less than this share of a period was there already."""
    DRAINED_S = 1.0
    """Time [s] after which what comes is taken for new in any case: no queue is longer."""

    FOLLOW = 0.1
    """Weight of the newest picture in the usual time between two."""

    def __init__(self, period_s: float):
        self._period_s = self._usual_s = period_s
        self._came_s: float | None = None
        self._since_s: float | None = None

    def is_old(self, asked_s: float, came_s: float) -> bool:
        """Whether the picture that was asked for and came at these times of a steady clock [s] may be old."""
        gap_s = math.inf if self._came_s is None else came_s - self._came_s
        self._came_s = came_s
        if self._since_s is not None:
            if came_s - asked_s < self.QUICK * self._period_s and came_s - self._since_s < self.DRAINED_S:
                return True
            self._since_s = None
        elif gap_s > max(self.GAP_S, self.GAP_PERIODS * self._usual_s):  # it may have come long ago: what comes next shows
            self._since_s = came_s
            return True
        self._usual_s += self.FOLLOW * (gap_s - self._usual_s)
        return False
