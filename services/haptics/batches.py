"""Voltage batches of all pads to one mean per electrode and time window.

Windows do not overlap, so that the noise of one estimate is independent of the next one's, as the observer assumes.
The clock is the samples' own stamps: a replay gives the same windows at any speed.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from penumbra.shared.geometry.rigid import Array
from penumbra.shared.skin.faults import Watch
from penumbra.shared.skin.layout import Skin

NEVER = -(1 << 62)
"""The stamp [ns] of something that has not come yet: before every other stamp."""
SATURATED = "saturated: it reads the end of its ADC"
"""`VoltageWindow.faults` of an electrode whose signal is cut off."""


@dataclass(frozen=True)
class VoltageWindow:
    """The mean voltages of all electrodes over a stretch of time. stamp_ns: the middle of the samples; newest_ns: the last one;
    amplitude (n,) [V]: means; samples (n,): how many are in each, none for electrodes that are not to be believed; faults: the
    reasons, by PAD or PAD/ELECTRODE; pressed (n,): electrodes that are left out because they read the end of their ADC that
    near things drive them to."""

    stamp_ns: int
    newest_ns: int
    amplitude: Array
    samples: NDArray[np.int64]
    faults: dict[str, str]
    pressed: NDArray[np.bool_]


class Backlog:
    """Tells when a reader has fallen behind its samples, so that it can leave out what is overtaken already.

    Clocks may differ and the way here takes time: late is what comes much later than the quickest of the last windows.
    """

    def __init__(self, patience_ns: int = 100_000_000, memory: int = 200):
        self.patience_ns = patience_ns
        self._lags: deque[int] = deque(maxlen=memory)

    def is_late(self, newest_ns: int, now_ns: int) -> bool:
        """Whether a window whose last sample has newest_ns comes too late at now_ns."""
        self._lags.append(now_ns - newest_ns)
        return self._lags[-1] > min(self._lags) + self.patience_ns


class Collector:
    """Gathers batches and hands out a window when every living pad has filled it.

    length_ns: window length (one estimate each); patience_ns: a pad this far behind the newest one is called silent and is
    no longer waited for. Raises ValueError for a length that is not positive.
    """

    def __init__(self, skin: Skin, length_ns: int, patience_ns: int = 100_000_000):
        if length_ns <= 0:
            raise ValueError(f"expected a window longer than nothing, got {length_ns} ns: give --window-ms above zero")
        self.skin, self.length_ns, self.patience_ns = skin, length_ns, patience_ns
        self._index = {name: k for k, name in enumerate(skin.pads)}
        self._stamps: list[NDArray[np.int64]] = [np.empty(0, np.int64) for _ in skin.pads]
        self._volts: list[Array] = [np.empty((0, skin.of(k).stop - skin.of(k).start)) for k in range(len(skin.pads))]
        self._watches = [Watch(skin, k) for k in range(len(skin.pads))]
        self._newest = np.full(len(skin.pads), NEVER, dtype=np.int64)
        self._done_ns = self._born_ns = NEVER

    def add(self, pad: str, stamp_ns: int, period_ns: int, volts: Array) -> VoltageWindow | None:
        """Take a batch (samples, electrodes) whose last row has stamp_ns; returns a window when one is complete.

        Raises ValueError for an unknown pad, another number of electrodes than the cell has, or a period that is not positive.
        """
        if pad not in self._index:
            raise ValueError(f"expected a pad of {', '.join(self._index)}, got {pad!r}: compare the cell files")
        k = self._index[pad]
        if volts.ndim != 2 or volts.shape[1] != self._volts[k].shape[1]:
            raise ValueError(f"pad {pad}: expected rows of {self._volts[k].shape[1]} electrodes, got shape {volts.shape}")
        if period_ns <= 0:
            raise ValueError(f"pad {pad}: expected a positive period_ns, got {period_ns}")
        if stamp_ns <= self._newest[k]:
            if self._newest[k] - stamp_ns < self.patience_ns:
                return None  # a repeated or overtaken batch
            self._forget()  # time jumped back: the source started again
        if self._born_ns == NEVER:
            self._born_ns = stamp_ns
        self._watches[k].add(stamp_ns, period_ns, volts)
        stamps = stamp_ns - period_ns * np.arange(len(volts) - 1, -1, -1, dtype=np.int64)
        fresh = stamps > max(self._newest[k], stamp_ns - 4 * self.length_ns)
        self._stamps[k] = np.concatenate([self._stamps[k], stamps[fresh]])
        self._volts[k] = np.concatenate([self._volts[k], volts[fresh]])
        self._newest[k] = stamp_ns
        return self._window(period_ns)

    def _window(self, period_ns: int) -> VoltageWindow | None:
        newest_ns = int(self._newest.max())
        if (self._newest == NEVER).any() and newest_ns - self._born_ns < self.patience_ns:
            return None  # at the start every pad has a chance to be heard
        heard = self._newest >= newest_ns - self.patience_ns
        end_ns = int(self._newest[heard].min())
        if self._done_ns == NEVER:  # the first window begins where the slowest living pad begins
            self._done_ns = max(int(s[0]) for s, ok in zip(self._stamps, heard, strict=True) if ok) - period_ns
        if end_ns - self._done_ns < self.length_ns:
            return None
        # After a cut only the newest stretch is used: an old one would say little about now.
        begin_ns = max(self._done_ns, end_ns - self.length_ns)
        skin = self.skin
        amplitude, samples, pressed = skin.a3.copy(), np.zeros(len(skin), np.int64), np.zeros(len(skin), np.bool_)
        faults: dict[str, str] = {}
        middles = []
        for k, name in enumerate(skin.pads):
            inside = (self._stamps[k] > begin_ns) & (self._stamps[k] <= end_ns)
            rows, stamps = self._volts[k][inside], self._stamps[k][inside]
            keep = self._stamps[k] > end_ns
            self._volts[k], self._stamps[k] = self._volts[k][keep], self._stamps[k][keep]
            if not len(rows):
                faults[name] = "silent"
                continue
            own = skin.of(k)
            high, low = rows >= skin.full_scale[own] - 0.5 * skin.lsb[own], rows <= 0.5 * skin.lsb[own]
            pressed[own] = np.where(skin.polarity[own] > 0.0, high, low).mean(axis=0) > 0.5
            ended = high.any(axis=0) | low.any(axis=0)
            reasons = dict.fromkeys(np.flatnonzero(ended).tolist(), SATURATED)
            reasons |= {self._watches[k].names.index(e): fault.text for e, fault in self._watches[k].faults.items()}
            faults |= {skin.names[own.start + e]: reason for e, reason in reasons.items()}
            amplitude[own] = rows.mean(axis=0)
            samples[own] = np.where(np.isin(np.arange(rows.shape[1]), list(reasons)), 0, len(rows))
            middles.append(float((stamps - begin_ns).mean()))
        self._done_ns = end_ns
        middle = int(np.mean(middles)) if middles else self.length_ns // 2
        return VoltageWindow(begin_ns + middle, end_ns, amplitude, samples, faults, pressed)

    def _forget(self) -> None:
        for k in range(len(self.skin.pads)):
            self._stamps[k], self._volts[k] = self._stamps[k][:0], self._volts[k][:0]
        self._newest[:] = NEVER
        self._done_ns = self._born_ns = NEVER
