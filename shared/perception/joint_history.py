"""Joint angles of robots at a stamp: when a frame was exposed, or voltages were sampled."""

from __future__ import annotations

import threading
from bisect import bisect_left
from collections import deque
from collections.abc import Mapping

from penumbra.shared.geometry.rigid import Array


class JointHistory:
    """The latest joint angles of one robot, interpolated at a stamp. Messages and queries may come from different threads.

    tolerance_ns: maximum distance in time from the nearest message; is_carried_on: whether the angles after the newest message
    are extrapolated with the last velocity, or held; size: number of messages kept.
    """

    def __init__(self, tolerance_ns: int, is_carried_on: bool = False, size: int = 256):
        self._tolerance_ns, self._is_carried_on = tolerance_ns, is_carried_on
        self._samples: deque[tuple[int, Array]] = deque(maxlen=size)
        self._lock = threading.Lock()

    def add(self, stamp_ns: int, joints: Array) -> None:
        """Adds joint angles (n,) [rad] at a stamp. A stamp that is not newer than the last one is ignored. One that is older by
        more than the tolerance starts a new history, because the clock of the robot's source was set back."""
        with self._lock:
            if self._samples and stamp_ns < self._samples[-1][0] - self._tolerance_ns:
                self._samples.clear()
            if not self._samples or stamp_ns > self._samples[-1][0]:
                self._samples.append((stamp_ns, joints))

    def at(self, stamp_ns: int) -> Array | None:
        """Joint angles (n,) [rad] at a stamp: linear between the messages before and after it, constant before the first. None
        where no message is within the tolerance."""
        with self._lock:
            samples = list(self._samples)
        after = bisect_left(samples, stamp_ns, key=lambda sample: sample[0])
        around = samples[max(after - 1, 0) : after + 1]
        if not around or min(abs(stamp_ns - stamp) for stamp, _ in around) > self._tolerance_ns:
            return None
        if after == len(samples) and self._is_carried_on and len(samples) > 1:
            after -= 1  # extrapolates from the last two messages
        elif after in (0, len(samples)):
            return around[0][1]
        (t0, q0), (t1, q1) = samples[after - 1], samples[after]
        return q0 + (q1 - q0) * ((stamp_ns - t0) / (t1 - t0))


class RobotJoints:
    """Joint angles of all robots of a cell at a stamp: one `JointHistory` per robot, with these settings. counts: numbers of
    joints by robot."""

    def __init__(self, counts: Mapping[str, int], tolerance_ns: int, is_carried_on: bool = False):
        self._counts = counts
        self._history = {name: JointHistory(tolerance_ns, is_carried_on) for name in counts}

    def add(self, robot: str, stamp_ns: int, joints: Array) -> None:
        """Adds joint angles (n,) [rad] at a stamp. Raises ValueError for an unknown robot or a wrong number of joints."""
        if robot not in self._counts:
            raise ValueError(f"expected a robot of {', '.join(self._counts) or 'none'}, got {robot!r}: compare the cell files")
        if joints.shape != (self._counts[robot],):
            raise ValueError(f"robot {robot}: expected {self._counts[robot]} joint angles, got shape {joints.shape}")
        self._history[robot].add(stamp_ns, joints)

    def at(self, stamp_ns: int) -> dict[str, Array]:
        """Joint angles (n,) [rad] at a stamp, by robot, where they are known."""
        return {robot: q for robot, history in self._history.items() if (q := history.at(stamp_ns)) is not None}
