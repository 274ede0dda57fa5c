"""When a controller's clock says that something was measured, by this host's clock."""

from __future__ import annotations

from penumbra.shared.runtime.lowest import Lowest

WINDOW_S = 10.0
"""Offsets of the last so many seconds count: clocks drift by some parts in a hundred thousand, 0.5 ms in this time."""
BACK_S = 0.5
"""A clock that goes back by more has begun anew: the controller was started again."""


class ControllerClock:
    """The offset of a controller's clock, from when its messages arrive: a message arrives late by what line and threads take,
    and never early, so that the smallest difference is nearest to the offset. What the quickest takes stays in the stamps."""

    def __init__(self) -> None:
        self._begin()

    def _begin(self) -> None:
        self._lowest = Lowest(WINDOW_S)
        self._last_s: float | None = None

    def stamp(self, clock_s: float | None, arrival_ns: int) -> int:
        """The stamp [ns since the epoch] of a measurement at a time of the controller's clock [s], None where it says none, that
        arrived then [ns since the epoch]."""
        if clock_s is None:
            return arrival_ns
        if self._last_s is not None and clock_s < self._last_s - BACK_S:
            self._begin()
        self._last_s = clock_s
        own_ns = round(1e9 * clock_s)
        return own_ns + int(self._lowest.add(arrival_ns - own_ns, clock_s))
