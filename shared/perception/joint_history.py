"""Where the robot's joints were when a frame was exposed."""

from __future__ import annotations

from collections import deque

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

STALE_NS = 200_000_000
"""Joints further than this from the stamp that is asked for are not used."""


class JointHistory:
    """The last joint angles of one robot, to be read at the stamp of a frame. One thread adds; others may ask, as what they look
    through is a copy."""

    def __init__(self, size: int = 256):
        self._samples: deque[tuple[int, Array]] = deque(maxlen=size)

    def add(self, stamp_ns: int, q: Array) -> None:
        """Keeps the joints q (n,) of a stamp; one that is not newer than the last is left out, one that is much older begins
        anew: the clock of the robot's source was set back."""
        if self._samples and stamp_ns < self._samples[-1][0] - STALE_NS:
            self._samples.clear()
        if not self._samples or stamp_ns > self._samples[-1][0]:
            self._samples.append((stamp_ns, q))

    def at(self, stamp_ns: int) -> Array | None:
        """Joints (n,) at a stamp, interpolated, or the nearest sample's; None where none is within STALE_NS."""
        samples = list(self._samples)
        if not samples:
            return None
        stamps = np.array([stamp for stamp, _ in samples], np.int64)
        right = int(np.searchsorted(stamps, stamp_ns))
        if 0 < right < len(samples):
            (t0, q0), (t1, q1) = samples[right - 1], samples[right]
            if t1 - t0 <= STALE_NS and q0.shape == q1.shape:
                return q0 + (q1 - q0) * ((stamp_ns - t0) / (t1 - t0))
        nearest = samples[int(np.argmin(np.abs(stamps - stamp_ns)))]
        return nearest[1] if abs(nearest[0] - stamp_ns) <= STALE_NS else None
