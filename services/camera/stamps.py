"""Exposure times of pictures: conversions between clocks, and the clock of a stream from its quickest pictures. Numbers only."""

from __future__ import annotations

import math

from penumbra.shared.runtime.lowest import Lowest

OLDEST_S = 5.0
"""Age [s] of a driver's stamp above which it belongs to another clock."""
AHEAD_S = 0.01
"""Maximum time [s] by which a driver's stamp may be ahead of the clock with which it is compared."""
WINDOW_S = 60.0
"""Time [s] for which a quick picture counts: clocks drift by a few milliseconds meanwhile."""
CALM_S = 0.3
"""Time [s] without a quicker picture after which a stream has settled."""
QUICKER_S = 0.005
"""Time [s] by which a picture must be quicker than all before it to show that the stream has not settled."""
SETTLES_S = 3.0
"""Time [s] after which a stream counts as settled in any case."""
BACK_S = 1.0
"""A stream's clock that goes back by more than this [s] has restarted."""


def of_driver(stamp_ns: int, monotonic_ns: int, epoch_ns: int) -> int | None:
    """A driver's stamp in nanoseconds since the epoch, given the current readings of both clocks of this host.

    Drivers of V4L2 stamp by CLOCK_MONOTONIC, old ones by the time of day. None if the stamp belongs to neither.
    """
    for now_ns in (monotonic_ns, epoch_ns):
        if -AHEAD_S <= (now_ns - stamp_ns) * 1e-9 <= OLDEST_S:
            return epoch_ns - (now_ns - stamp_ns)
    return None


class StreamClock:
    """This host's time of a stream's own stamps, which count from an unknown moment.

    A picture arrives late by the delays of sender, network and decoder, and never early. So the smallest difference between
    arrival and stamp, that of the quickest picture, is the start of the stream's clock plus the latency common to all pictures.
    The first pictures of a stream arrive in a burst; `is_settled` says when it is over.
    """

    def __init__(self) -> None:
        self._begin()

    def _begin(self) -> None:
        self._lowest = Lowest(WINDOW_S)
        self._began_s: float | None = None
        self._quick: tuple[float, float] = (0.0, float("inf"))  # time of the last quicker picture, and its difference
        self._last_ns = 0

    def stamp(self, own_ns: int, arrival_ns: int, now_s: float) -> int:
        """Time at which a picture left its sender [ns since the epoch], late by the latency common to all pictures.

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
        """Whether the initial burst is over."""
        if self._began_s is None:
            return False
        return now_s - self._quick[0] > CALM_S or now_s - self._began_s > SETTLES_S


class Backlog:
    """Detects old pictures of a camera without a clock: after a pause, a picture that arrives without waiting was queued."""

    GAP_S, GAP_PERIODS = 0.3, 3.0
    """Minimum time between two pictures that counts as a pause, in seconds and in periods (the larger one)."""
    QUICK = 0.25
    """Share of a period below which the wait for a picture shows that it was queued."""
    DRAINED_S = 1.0
    """Time [s] after which pictures count as new in any case: no queue is longer."""

    FOLLOW = 0.1
    """Weight of the newest picture in the usual time between two pictures."""

    def __init__(self, period_s: float):
        self._period_s = self._usual_s = period_s
        self._came_s: float | None = None
        self._since_s: float | None = None

    def is_old(self, asked_s: float, came_s: float) -> bool:
        """Whether the picture that was requested and arrived at these times of a steady clock [s] may be old."""
        gap_s = math.inf if self._came_s is None else came_s - self._came_s
        self._came_s = came_s
        if self._since_s is not None:
            if came_s - asked_s < self.QUICK * self._period_s and came_s - self._since_s < self.DRAINED_S:
                return True
            self._since_s = None
        elif gap_s > max(self.GAP_S, self.GAP_PERIODS * self._usual_s):  # it may have been queued: the next ones show
            self._since_s = came_s
            return True
        self._usual_s += self.FOLLOW * (gap_s - self._usual_s)
        return False
