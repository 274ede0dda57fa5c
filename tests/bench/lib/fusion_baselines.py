"""Baselines for the observers, on the same messages: methods without a model, and a third-party smoother.

Each takes the messages as they arrive and gives the limb's current pose.
"""

from __future__ import annotations

from typing import SupportsFloat, SupportsIndex, SupportsInt

import gtsam
import numpy as np

from penumbra.shared.geometry import rigid
from penumbra.shared.geometry.rigid import Array
from penumbra.tests.bench.lib.fusion_runs import PERIOD_S, Message

FRESH_S = 0.25
"""Age [s] above which a measurement counts only where there is no newer one: `services.fusion.estimate.Limits.tracking_age`."""


class Newest:
    """The newest measurement of each sense: the two baselines without a model."""

    def __init__(self) -> None:
        self._newest: dict[str, Message] = {}
        self._average = np.eye(4)

    def take(self, message: Message) -> None:
        before = self._newest.get(message.source)
        if before is None or message.stamp > before.stamp:
            self._newest[message.source] = message

    def _fresh(self, now: float) -> list[Message]:
        return [m for m in self._newest.values() if now - m.stamp <= FRESH_S]

    def oracle(self, now: float, truth: Array) -> float:
        """Position error [m] of the sense that is nearest to the truth now: the best that choosing a sense could do."""
        candidates = self._fresh(now) or [max(self._newest.values(), key=lambda m: m.stamp)]
        return min(float(np.linalg.norm(truth[:3, 3] - m.T[:3, 3])) for m in candidates)

    def average(self, now: float) -> Array:
        """The pose (4, 4) weighted by the senses' information; the last one where none is fresh."""
        fresh = self._fresh(now)
        if fresh:
            reference = fresh[0].T
            total = sum((m.information for m in fresh), start=1e-9 * np.eye(6))
            pull = sum((m.information @ rigid.pose_error(m.T, reference) for m in fresh), start=np.zeros(6))
            self._average = rigid.perturb(reference, np.linalg.solve(total, pull))
        return self._average


class FixedLagSmoother:
    """gtsam's incremental fixed-lag smoother on position, rotation and velocity.

    Between nodes it assumes a constant linear velocity with white acceleration, and a rotation with white rate. Nodes lie at the
    senses' stamps, which are known before the measurements arrive: a late one is attached to its node. gtsam's priors need full
    information: a roll that a sense does not observe is taken from the smoother itself, with next to no weight. It models errors
    as white.

    lag : how far back measurements are taken and poses smoothed [s].
    acceleration, turning : densities of the white acceleration [m^2/s^3] and the white angular rate [rad^2/s].
    inflation : factors on the covariances of the senses, since errors that last are worth less than white ones.
    """

    def __init__(
        self,
        home: Array,
        spread: tuple[float, float],
        lag: float = 0.5,
        acceleration: float = 0.3,
        turning: float = 0.05,
        inflation: tuple[float, float] = (4.0, 2.0),
    ):
        parameters = gtsam.ISAM2Params()
        parameters.setFactorization("QR")  # without a measured roll, Cholesky may find a matrix not positive definite
        self._smoother = gtsam.IncrementalFixedLagSmoother(lag, parameters)
        self._acceleration, self._turning = acceleration, turning
        self._weight = dict(zip(PERIOD_S, (1.0 / each for each in inflation), strict=True))
        self._lag = lag
        self._ticks: list[int] = []
        self._last = gtsam.NavState(gtsam.Pose3(home), np.zeros(3))
        self._prior = np.diag(np.repeat([spread[1] ** -2, spread[0] ** -2, 0.4**-2], 3))

    def take(self, message: Message) -> None:
        tick = round(1000.0 * message.stamp)
        graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        stamps: dict[SupportsInt | SupportsIndex, SupportsFloat | SupportsIndex] = {}
        for node in self._missing(tick):
            if not self._ticks:
                graph.add(gtsam.PriorFactorNavState(node, self._last, gtsam.noiseModel.Gaussian.Information(self._prior)))
            else:
                before = self._ticks[-1]
                dt = 0.001 * (node - before)
                graph.add(gtsam.ConstantVelocityFactor(before, node, dt, self._motion(dt)))
                self._last = self._moved(dt)
            values.insert(node, self._last)
            stamps[node] = 0.001 * node
            self._ticks.append(node)
        if tick < self._ticks[-1] - 900.0 * self._lag:
            return
        graph.add(self._factor(tick, message, values))
        self._smoother.update(graph, values, stamps)
        self._last = self._smoother.calculateEstimateNavState(self._ticks[-1])

    def pose(self, now: float) -> Array:
        """The pose (4, 4) at a time not before the newest node."""
        return np.asarray(self._moved(now - 0.001 * self._ticks[-1]).pose().matrix())

    def _missing(self, tick: int) -> list[int]:
        """Ticks [ms] of the nodes up to a new one: all stamps of all senses."""
        if not self._ticks:
            return [tick]
        periods = [round(1000.0 * period) for period in PERIOD_S.values()]
        return [t for t in range(self._ticks[-1] + 1, tick + 1) if any(t % period == 0 for period in periods)]

    def _moved(self, dt: float) -> gtsam.NavState:
        return gtsam.NavState(self._last.attitude(), self._last.position() + dt * self._last.velocity(), self._last.velocity())

    def _motion(self, dt: float) -> gtsam.noiseModel.Base:
        """Noise of rotation, position and velocity over a step [s]: white rate and white acceleration."""
        Q, one = np.zeros((9, 9)), np.eye(3)
        Q[:3, :3] = self._turning * dt * one
        Q[3:6, 3:6] = self._acceleration * dt**3 / 3.0 * one
        Q[3:6, 6:] = Q[6:, 3:6] = self._acceleration * dt**2 / 2.0 * one
        Q[6:, 6:] = self._acceleration * dt * one
        return gtsam.noiseModel.Gaussian.Covariance(Q)

    def _factor(self, tick: int, message: Message, new: gtsam.Values) -> gtsam.PriorFactorNavState:
        known = new.atNavState(tick) if new.exists(tick) else self._smoother.calculateEstimateNavState(tick)
        T, information = message.T, self._weight[message.source] * message.information
        axis = T[:3, 0]
        if axis @ information[3:, 3:] @ axis < 1e-6 * information[3:, 3:].trace():  # the roll is not measured
            before = known.attitude().matrix()[:, 0]
            across = np.cross(before, axis)
            angle = np.arctan2(np.linalg.norm(across), before @ axis)
            swing = rigid.rotation(angle * across / max(float(np.linalg.norm(across)), 1e-12))
            T = rigid.transform(T[:3, 3])
            T[:3, :3] = swing @ known.attitude().matrix()
        A = np.kron(np.eye(2), T[:3, :3])  # gtsam's errors are along the body's axes, rotation first
        own = np.zeros((9, 9))
        own[:6, :6] = np.roll(A.T @ information @ A, 3, axis=(0, 1))
        own += 1e-6 * np.eye(9)
        pose = gtsam.NavState(gtsam.Pose3(T), known.velocity())
        return gtsam.PriorFactorNavState(tick, pose, gtsam.noiseModel.Gaussian.Information(own))
