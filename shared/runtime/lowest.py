"""The lowest of recent values: how two clocks differ, of which messages tell, each of them late and none early."""

from __future__ import annotations

from collections import deque


class Lowest:
    """The lowest of the values of the last `window_s` seconds."""

    def __init__(self, window_s: float):
        self._window_s = window_s
        self._kept: deque[tuple[float, float]] = deque()  # time and value, each value above the one before

    def add(self, value: float, now_s: float) -> float:
        """Takes a value at a time of a steady clock [s]; the lowest of those that count, this one among them."""
        while self._kept and self._kept[-1][1] >= value:
            self._kept.pop()
        self._kept.append((now_s, value))
        while now_s - self._kept[0][0] > self._window_s:
            self._kept.popleft()
        return self._kept[0][1]
