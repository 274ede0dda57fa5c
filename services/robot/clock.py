"""Converts the times of a controller's clock to this host's clock."""

from __future__ import annotations

from penumbra.shared.runtime.lowest import Lowest

WINDOW_S = 10.0
"""Time [s] for which an offset counts: clocks drift by some parts in a hundred thousand, 0.5 ms in this time."""
BACK_S = 0.5
"""Backward step [s] of a clock above which the controller has restarted."""


class ControllerClock:
    """Offset of a controller's clock, from the arrival of its messages. A message arrives late by the delays of line and threads,
    and never early, so the smallest difference is nearest to the offset. The delay of the quickest message remains in the
    stamps."""

    def __init__(self) -> None:
        self._begin()

    def _begin(self) -> None:
        self._lowest = Lowest(WINDOW_S)
        self._last_s: float | None = None

    def stamp(self, clock_s: float | None, arrival_ns: int) -> int:
        """The stamp [ns since the epoch] of a measurement at clock_s by the controller's clock [s] (None if unknown) that arrived
        at arrival_ns [ns since the epoch]."""
        if clock_s is None:
            return arrival_ns
        if self._last_s is not None and clock_s < self._last_s - BACK_S:
            self._begin()
        self._last_s = clock_s
        own_ns = round(1e9 * clock_s)
        return own_ns + int(self._lowest.add(arrival_ns - own_ns, clock_s))
