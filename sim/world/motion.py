"""Motion of the world: reaches of the limb, sway of the robot, and the clock that drives them.

Everything is a function of time and seed, so that a run can be repeated sample by sample.
"""

from __future__ import annotations

import bisect
import threading
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from penumbra.shared.cell import description as cells
from penumbra.shared.geometry.rigid import Array

PEAK = 1.875
"""Ratio of peak to mean speed of a minimum-jerk reach."""
ANGULAR_SPEED = 1.2
"""Maximum rate of roll, pitch or yaw [rad/s]."""
STEP_S = 0.04
"""Interval [s] between the poses of a planned reach that are checked: at the default speed the limb moves at most 1 cm in it."""
OUTLOOK_S = 3.0
"""Time [s] for which the goal of a reach must stay allowed: the robot must not drive the limb into a corner."""


@dataclass(frozen=True)
class Reach:
    """A point-to-point movement with the minimum-jerk profile (Flash & Hogan 1985, DOI 10.1523/JNEUROSCI.05-07-01688.1985),
    then a rest until `end_s`. Poses (6,): x, y, z [m], roll, pitch, yaw [rad]."""

    begin_s: float
    duration_s: float
    end_s: float
    start: Array
    goal: Array

    def at(self, time_s: ArrayLike) -> tuple[Array, Array]:
        """Pose (..., 6) and its rate (..., 6) [1/s] at times (...)."""
        s = np.clip((np.asarray(time_s) - self.begin_s) / self.duration_s, 0.0, 1.0)[..., None]
        way = self.goal - self.start
        pose = self.start + way * (s**3 * (10.0 - 15.0 * s + 6.0 * s**2))
        return pose, way * (30.0 * s**2 * (1.0 - s) ** 2) / self.duration_s


class LimbMotion:
    """Reaches between poses drawn uniformly from a region, planned up to the latest time that was asked for.

    clearance(times (k,), poses (k, 6)): minimum distance [m] of the person from all obstacles in excess of the demanded one,
    negative where a pose is not allowed. A reach with a negative clearance is drawn again, up to TRIES times.
    Raises CellError where the region holds no allowed pose.
    """

    TRIES = 200

    def __init__(self, region: cells.Motion, seed: int, clearance: Callable[[Array, Array], float]):
        self._low = np.array([*region.low, *region.rpy_low])
        self._high = np.array([*region.high, *region.rpy_high])
        self._speed = region.speed
        self._clearance = clearance
        self._rng = np.random.default_rng([seed, 1])
        self._lock = threading.Lock()
        stay = np.arange(0.0, OUTLOOK_S, 2 * STEP_S)
        start = next((pose for pose in (self._draw() for _ in range(10 * self.TRIES)) if self._may_stay(pose, stay)), None)
        if start is None:
            low, high = (", ".join(f"{value:.4g}" for value in corner) for corner in (region.low, region.high))
            raise cells.CellError(
                "sim.motion: expected a region with a pose that keeps the person clear of robot, pads and table, got none from "
                f"[{low}] to [{high}] m; move or widen the region"
            )
        self._reaches = [Reach(0.0, 0.5, 0.5, start, start)]
        self._ends = [0.5]

    def at(self, time_s: float) -> tuple[Array, Array]:
        """Pose (6,) and rate (6,) at a time >= 0; plans missing reaches first (up to 0.1 s of computing each)."""
        self.plan(time_s)
        return self._reaches[bisect.bisect_left(self._ends, time_s)].at(time_s)

    def plan(self, until_s: float) -> None:
        """Plan all reaches that begin before a time, so that `at` answers at once up to there."""
        if self._ends[-1] > until_s:
            return
        with self._lock:
            while self._ends[-1] <= until_s:
                reach = self._next(self._reaches[-1])
                self._reaches.append(reach)
                self._ends.append(reach.end_s)

    def _may_stay(self, pose: Array, times: Array) -> bool:
        """Whether a pose is allowed at all times. The first time is checked alone, as it rejects most poses at a lower cost."""
        return all(self._clearance(at, np.tile(pose, (len(at), 1))) >= 0.0 for at in (times[:1], times))

    def _draw(self) -> Array:
        return self._rng.uniform(self._low, self._high)

    def _next(self, last: Reach) -> Reach:
        best, best_clearance = last, -np.inf
        for _ in range(self.TRIES):
            reach = self._candidate(last.end_s, last.goal)
            times = np.concatenate(
                [np.arange(reach.begin_s, reach.end_s, STEP_S), np.arange(reach.end_s, reach.end_s + OUTLOOK_S, 2 * STEP_S)]
            )
            clearance = self._clearance(times, reach.at(times)[0])
            if clearance > best_clearance:
                best, best_clearance = reach, clearance
            if clearance >= 0.0:
                break
        return best  # the best of all tries where none was allowed

    def _candidate(self, begin_s: float, start: Array) -> Reach:
        goal = self._draw()
        way = goal - start
        least = PEAK * max(np.linalg.norm(way[:3]) / self._speed, np.abs(way[3:]).max() / ANGULAR_SPEED, 0.2)
        duration = least * self._rng.uniform(1.0, 1.6)
        rest = max(0.0, self._rng.uniform(-0.4, 0.6))
        return Reach(begin_s, duration, begin_s + duration + rest, start, goal)


class JointMotion:
    """A slow sway of the robot's joints around the middle of their bounds: three sines per joint, of periods from 9 to 30 s."""

    def __init__(self, low: ArrayLike, high: ArrayLike, seed: int):
        low, high = np.asarray(low, float), np.asarray(high, float)
        rng = np.random.default_rng([seed, 2])
        self._middle, n = (low + high) / 2.0, len(low)
        amplitude = rng.uniform(0.4, 1.0, (3, n))
        self._amplitude = amplitude / amplitude.sum(axis=0) * (high - low) / 2.0
        self._omega = 2.0 * np.pi / rng.uniform(9.0, 30.0, (3, n))
        self._phase = rng.uniform(0.0, 2.0 * np.pi, (3, n))

    def at(self, time_s: ArrayLike) -> Array:
        """Joint values (..., n) at times (...)."""
        t = np.asarray(time_s, float)[..., None, None]
        return self._middle + (self._amplitude * np.sin(self._omega * t + self._phase)).sum(axis=-2)


class Clock:
    """Scene time as a function of real time. Its rate can be changed, and reaches the new value along a ramp of RAMP_S."""

    RAMP_S = 0.3

    def __init__(self, rate: float = 1.0):
        self._changes = [(0.0, 0.0, rate, rate)]  # from when [s], scene time there [s], rate before, rate after

    def set_rate(self, time_s: float, rate: float) -> None:
        """Change to a rate from a time on, which must not lie before the last change."""
        self._changes.append((time_s, self.at(time_s), self.rate(time_s), rate))

    def _change(self, time_s: float) -> tuple[float, float, float, float]:
        return next(c for c in reversed(self._changes) if c[0] <= time_s or c is self._changes[0])

    def rate(self, time_s: float) -> float:
        """Scene seconds per second at a time."""
        begin, _, before, after = self._change(time_s)
        return before + (after - before) * min((time_s - begin) / self.RAMP_S, 1.0)

    def at(self, time_s: float) -> float:
        """Scene time [s] at a time."""
        begin, scene, before, after = self._change(time_s)
        ramp = min(time_s - begin, self.RAMP_S)
        gained = before * ramp + (after - before) * ramp**2 / (2.0 * self.RAMP_S)
        return scene + gained + after * (time_s - begin - ramp)


def angular_velocity(rpy: Array, rate: Array) -> Array:
    """Angular velocity [rad/s] (3,) along the fixed axes, from roll, pitch, yaw [rad] and their rates: R = Rz Ry Rx."""
    _, pitch, yaw = rpy
    c, s = np.cos(yaw), np.sin(yaw)
    x_axis = np.array([c * np.cos(pitch), s * np.cos(pitch), -np.sin(pitch)])
    return rate[0] * x_axis + rate[1] * np.array([-s, c, 0.0]) + rate[2] * np.array([0.0, 0.0, 1.0])


def joint_motions(cell: cells.Cell, sim: cells.Sim, seed: int) -> dict[str, JointMotion]:
    """A motion for every robot; the cell's bounds hold all robots' joints in their order, one after the other."""
    total = sum(len(robot.joints) for robot in cell.robots.values())
    if not len(sim.joints_low) == len(sim.joints_high) == total:
        raise cells.CellError(
            f"sim.joints_low and sim.joints_high: expected {total} values, one per joint of "
            f"{', '.join(cell.robots) or 'no robot'}, got {len(sim.joints_low)} and {len(sim.joints_high)}"
        )
    motions, first = {}, 0
    for i, (name, robot) in enumerate(cell.robots.items()):
        last = first + len(robot.joints)
        motions[name] = JointMotion(sim.joints_low[first:last], sim.joints_high[first:last], seed + 1000 * i)
        first = last
    return motions
