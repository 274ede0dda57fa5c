"""Minimum of recent values, used for the offset between two clocks: every message is delayed, none is early."""

from __future__ import annotations

from collections import deque


class Lowest:
    """Minimum of the values of the last `window_s` seconds."""

    def __init__(self, window_s: float):
        self._window_s = window_s
        self._kept: deque[tuple[float, float]] = deque()  # time and value, in increasing order of both

    def add(self, value: float, now_s: float) -> float:
        """Adds a value at a monotonic time [s]; returns the minimum of the window, this value included."""
        while self._kept and self._kept[-1][1] >= value:
            self._kept.pop()
        self._kept.append((now_s, value))
        while now_s - self._kept[0][0] > self._window_s:
            self._kept.popleft()
        return self._kept[0][1]
