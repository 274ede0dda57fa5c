"""Averages the voltage batches of all pads to one mean per electrode and time window.

Windows do not overlap, so that the noise of successive estimates is independent, as the observer assumes. The clock is the
samples' own stamps: a replay gives the same windows at any speed.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from penumbra.shared.geometry.rigid import Array
from penumbra.shared.skin.faults import Watch
from penumbra.shared.skin.layout import Skin

NEVER = -(1 << 62)
"""Stamp [ns] of something that has not arrived yet; it is smaller than every other stamp."""
SATURATED = "saturated: it reads the end of its ADC"
"""`VoltageWindow.faults` of an electrode whose signal is clipped by its ADC."""


@dataclass(frozen=True)
class VoltageWindow:
    """Mean voltages of all electrodes over a time window. stamp_ns: mean of the samples' stamps; newest_ns: the last stamp;
    amplitude (n,) [V]: means; samples (n,): number of samples per electrode, zero for faulty electrodes; faults: reasons, by PAD
    or PAD/ELECTRODE; pressed (n,): electrodes that are left out because they read the end of their ADC towards which near objects
    drive them."""

    stamp_ns: int
    newest_ns: int
    amplitude: Array
    samples: NDArray[np.int64]
    faults: dict[str, str]
    pressed: NDArray[np.bool_]


class Backlog:
    """Detects that a reader has fallen behind its samples, so that it can skip outdated windows.

    Clocks may differ and transport takes time: a window is late if its lag exceeds the smallest lag of the last windows by
    patience_ns.
    """

    def __init__(self, patience_ns: int = 100_000_000, memory: int = 200):
        self.patience_ns = patience_ns
        self._lags: deque[int] = deque(maxlen=memory)

    def is_late(self, newest_ns: int, now_ns: int) -> bool:
        """Whether a window whose last sample has newest_ns comes too late at now_ns."""
        self._lags.append(now_ns - newest_ns)
        return self._lags[-1] > min(self._lags) + self.patience_ns


class _Batch(NamedTuple):
    """Samples (s, e), one every period_ns; stamp_ns is the last one's stamp."""

    stamp_ns: int
    period_ns: int
    volts: Array

    @property
    def before_ns(self) -> int:
        """The stamp one period before the first sample."""
        return self.stamp_ns - self.period_ns * len(self.volts)

    def after(self, stamp_ns: int) -> _Batch:
        """The samples later than stamp_ns."""
        early = (stamp_ns - self.before_ns) // self.period_ns
        return self if early <= 0 else self._replace(volts=self.volts[early:])

    def until(self, stamp_ns: int) -> _Batch:
        """The samples up to stamp_ns."""
        late = -((stamp_ns - self.stamp_ns) // self.period_ns)
        if late <= 0:
            return self
        return _Batch(self.stamp_ns - late * self.period_ns, self.period_ns, self.volts[: max(len(self.volts) - late, 0)])

    def total_ns(self, since_ns: int) -> int:
        """The sum of all stamps, counted from since_ns."""
        count = len(self.volts)
        return count * (self.stamp_ns - since_ns) - self.period_ns * (count * (count - 1) // 2)


class Collector:
    """Collects batches and returns a window when every live pad has filled it.

    length_ns: window length (one estimate per window); patience_ns: lag behind the newest pad from which a pad counts as silent
    and is no longer waited for. Raises ValueError for a length that is not positive.
    """

    def __init__(self, skin: Skin, length_ns: int, patience_ns: int = 100_000_000):
        if length_ns <= 0:
            raise ValueError(f"expected a window longer than nothing, got {length_ns} ns: give --window-ms above zero")
        self.skin, self.length_ns, self.patience_ns = skin, length_ns, patience_ns
        self._index = {name: k for k, name in enumerate(skin.pads)}
        self._own = [skin.of(k) for k in range(len(skin.pads))]
        self._watches = [Watch(skin, k) for k in range(len(skin.pads))]
        self._top, self._bottom = skin.full_scale - 0.5 * skin.lsb, 0.5 * skin.lsb
        self._waiting: list[list[_Batch]]  # batches by pad that no window has used yet
        self._newest: list[int]
        self._done_ns = self._born_ns = NEVER
        self._forget()

    def add(self, pad: str, stamp_ns: int, period_ns: int, volts: Array) -> VoltageWindow | None:
        """Take a batch (samples, electrodes) whose last row has stamp_ns; returns a window when one is complete.

        Raises ValueError for an unknown pad, another number of electrodes than the cell has, or a period that is not positive.
        """
        if pad not in self._index:
            raise ValueError(f"expected a pad of {', '.join(self._index)}, got {pad!r}: compare the cell files")
        k = self._index[pad]
        electrodes = self._own[k].stop - self._own[k].start
        if volts.ndim != 2 or volts.shape[1] != electrodes:
            raise ValueError(f"pad {pad}: expected rows of {electrodes} electrodes, got shape {volts.shape}")
        if period_ns <= 0:
            raise ValueError(f"pad {pad}: expected a positive period_ns, got {period_ns}")
        if stamp_ns <= self._newest[k]:
            if self._newest[k] - stamp_ns < self.patience_ns:
                return None  # a repeated or overtaken batch
            self._forget()  # time jumped back: the source started again
        if self._born_ns == NEVER:
            self._born_ns = stamp_ns
        self._watches[k].add(stamp_ns, period_ns, volts)
        batch = _Batch(stamp_ns, period_ns, volts)
        self._waiting[k].append(batch.after(max(self._newest[k], stamp_ns - 4 * self.length_ns)))
        self._newest[k] = stamp_ns
        return self._window()

    def _window(self) -> VoltageWindow | None:
        newest_ns = max(self._newest)
        if min(self._newest) == NEVER and newest_ns - self._born_ns < self.patience_ns:
            return None  # at the start, wait for the first batch of every pad
        heard = [k for k, stamp_ns in enumerate(self._newest) if stamp_ns >= newest_ns - self.patience_ns]
        end_ns = min(self._newest[k] for k in heard)
        if self._done_ns == NEVER:  # the first window begins where the slowest living pad begins
            self._done_ns = max(self._waiting[k][0].before_ns for k in heard)
        if end_ns - self._done_ns < self.length_ns:
            return None
        # After a gap only the newest samples are used: older ones would say little about the present.
        begin_ns = max(self._done_ns, end_ns - self.length_ns)
        self._done_ns = end_ns
        taken = [[batch.until(end_ns).after(begin_ns) for batch in waiting] for waiting in self._waiting]
        self._waiting = [[batch.after(end_ns) for batch in waiting if batch.stamp_ns > end_ns] for waiting in self._waiting]
        return self._means(taken, begin_ns, end_ns)

    def _means(self, taken: list[list[_Batch]], begin_ns: int, end_ns: int) -> VoltageWindow:
        """The means, counts and faults of a window, computed for all pads at once."""
        skin = self.skin
        counts = [sum(len(batch.volts) for batch in batches) for batches in taken]
        samples = np.array(counts)[skin.pad_of]
        volts, is_there = np.zeros((max(counts), len(skin))), np.arange(max(counts))[:, None] < samples
        for own, count, batches in zip(self._own, counts, taken, strict=True):
            if count:
                np.concatenate([batch.volts for batch in batches], out=volts[:count, own])
        amplitude = np.where(samples > 0, volts.sum(axis=0) / np.maximum(samples, 1), skin.a3)
        high, low = is_there & (volts >= self._top), is_there & (volts <= self._bottom)
        pressed = np.where(skin.polarity > 0.0, high, low).sum(axis=0) > 0.5 * samples
        faults = {skin.names[e]: SATURATED for e in np.flatnonzero((high | low).any(axis=0))}
        for name, count, watch in zip(skin.pads, counts, self._watches, strict=True):
            faults |= {f"{name}/{e}": fault.text for e, fault in watch.faults.items()} if count else {name: "silent"}
        if faults:
            samples[[name in faults for name in skin.names]] = 0
        totals = [sum(batch.total_ns(begin_ns) for batch in batches) for batches in taken]
        middles = [total / count for total, count in zip(totals, counts, strict=True) if count]
        middle = int(sum(middles) / len(middles)) if middles else self.length_ns // 2
        return VoltageWindow(begin_ns + middle, end_ns, amplitude, samples, faults, pressed)

    def _forget(self) -> None:
        self._waiting = [[] for _ in self.skin.pads]
        self._newest = [NEVER] * len(self.skin.pads)
        self._done_ns = self._born_ns = NEVER
