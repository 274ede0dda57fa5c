"""Least squares of limb pose and size on the voltages of all electrodes, through the field model's derivatives.

The unknowns are a pose error (6,) and the limb's size (2,): the logs of its length and girth. Residuals in volts keep the noise
white and Gaussian also where an electrode feels nothing. What keeps it honest and sure:

- the first steps compare logs of the signals where these stand out of the noise (an inverse hyperbolic sine does that): the log
  of a signal is smooth in the pose over centimetres, the signal itself is not;
- a step that makes the fit worse is halved;
- what the field model gets wrong counts as noise, a share of the signal;
- an electrode that feels something else, or is faulty, loses its weight as its residual grows.

A prior is inside the solve only to hold what the skin does not feel. What is handed on is the likelihood: J^T R^-1 J, and where
it peaks.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from shared.geometry.rigid import Array, perturb, pose_error
from shared.native import kernel
from shared.skin.layout import Skin
from shared.skin.response import Response

NEAR_ERROR = 0.06
"""What the response gets wrong grows, where an electrode is nearly touched, by this share with the signal over NEAR_SIGNAL."""
NEAR_SIGNAL = 1.0
"""[V]: a gap of half a centimetre."""
COARSE_ERROR = 0.3
"""The same share in the first steps: so long each step moves all electrodes alike, near and far."""
OUTLIER = 3.0
"""Residual, in standard deviations, from which an electrode loses weight as its square."""
FARTHEST_STEP = np.array([0.06, 0.5, 0.25])
"""Longest step: position [m], rotation [rad], log size."""
SAME_SLOPE = 0.3
"""After a step that changes no signal by a larger share the derivatives of the logs are still good for the next one."""
CONVERGED = 0.05
"""A step with a smaller expected gain in the log probability is the last one, and is taken on trust."""
FELT = 3.0
"""Standard deviations from which an electrode feels something."""
KNOWN = 4
"""Unknowns that the voltages usually decide on."""
LEVER = 0.1
"""Distance [m] at which a rotation counts like a displacement, where the two are compared."""
WORTHLESS = 0.15
"""A direction known no better than this [m, or rad times LEVER] is published as unknown: beyond, the linearisation that a
covariance stands for has no meaning."""
TOO_FAR = 0.1
"""The same for a direction along which the likelihood peaks this far [m, or rad times LEVER] from where it was linearised."""


@dataclass(frozen=True)
class Prior:
    """What is believed beforehand: T_world_target (4, 4) with its information (6, 6) about `geometry.perturb`, and the size (2,)
    with its information (2, 2)."""

    T: Array
    information: Array
    size: Array
    size_information: Array

    def cost(self, solution: Solution) -> float:
        """Its share of a solution's cost: the rest is the voltages'."""
        toward, toward_size = pose_error(self.T, solution.T), self.size - solution.size
        return 0.5 * float(toward @ self.information @ toward) + 0.5 * float(toward_size @ self.size_information @ toward_size)


@dataclass(frozen=True)
class Reading:
    """What is measured in one window: signal, variance (n,): mean voltage less its rest [V], positive near a person, and its
    variance, infinite for an electrode to leave out; T_world_pads (p, 4, 4); distrust (n,): a factor of at least one on all
    variances of an electrode, whose pad has not fitted lately; doubt (n,) [V]: standard deviation of a rest that was only
    predicted; joints (j,) [rad]: of the robots, which only the network reads."""

    signal: Array
    variance: Array
    T_world_pads: Array
    distrust: Array
    doubt: Array
    joints: ArrayLike = ()


@dataclass(frozen=True)
class Point:
    """T_world_target (4, 4), size (2,), the log signals (n,) [V] there and their derivatives (n, 8) by pose and size."""

    T: Array
    size: Array
    logs: Array
    rows: Array

    def moved(self, step: Array) -> Point:
        """The point a small step (8,) away, logs to first order."""
        return Point(perturb(self.T, step[:6]), self.size + step[6:], self.logs + self.rows @ step, self.rows)


@dataclass(frozen=True)
class Solution:
    """The most probable T_world_target (4, 4) and size (2,). cost: the robust negative log posterior, up to a constant; misfit:
    mean squared residual of what is felt [variances]; residuals (n,): in standard deviations, zero for electrodes left out;
    signal (n,) [V]: the predicted one; point: all that again for `Solver.likelihood`."""

    T: Array
    size: Array
    cost: float
    misfit: float
    residuals: Array
    signal: Array
    point: Point


class Solver:
    """The solve for the pads of one cell. skin, response: of the same cell."""

    def __init__(self, skin: Skin, response: Response):
        self.response = response
        self._pad_of = skin.pad_of
        self._scale = np.log(skin.gain * skin.sensitivity)

    def solve(self, window: Reading, prior: Prior, T: Array, size: Array, coarse: int = 12, fine: int = 8) -> Solution:
        """The most probable pose and size near a start T (4, 4), size (2,), by at most so many steps on logs and on volts."""
        here = self._point(window, T, size)
        for steps, is_coarse in ((coarse, True), (fine, False)):
            H, g, cost = self._posterior(window, prior, here, is_coarse)
            for _ in range(steps):
                step = np.asarray(np.linalg.solve(H, g), np.float64)
                lengths = np.array([np.linalg.norm(step[:3]), np.linalg.norm(step[3:6]), np.abs(step[6:]).max()])
                step *= min(1.0, float(np.min(FARTHEST_STEP / (lengths + 1e-12))))
                gain = float(step @ g) - 0.5 * float(step @ H @ step)
                if gain < CONVERGED:
                    if not is_coarse:
                        here = here.moved(step)
                    break
                for _ in range(4):
                    near = not is_coarse and np.abs(here.rows @ step).max() < SAME_SLOPE
                    there = self._point(window, perturb(here.T, step[:6]), here.size + step[6:], here.rows if near else None)
                    H_there, g_there, cost_there = self._posterior(window, prior, there, is_coarse)
                    if cost_there <= cost:
                        break
                    step *= 0.4
                else:
                    break
                here, H, g, cost = there, H_there, g_there, cost_there
        z = np.zeros(len(here.logs))
        *_, cost = self._posterior(window, prior, here, False, z)
        predicted = np.exp(here.logs)
        return Solution(here.T, here.size, cost, _misfit(window, predicted, z), z, predicted, here)

    def likelihood(self, window: Reading, solution: Solution, lasting: float = 1.0) -> tuple[Array, Array]:
        """Information (8, 8) and gradient (8,) of the voltages alone at a solution, by pose and size. lasting: the model's error
        counts with so many times its variance."""
        H, g = np.zeros((8, 8)), np.zeros(8)
        at, z = solution.point, np.zeros(len(self._scale))
        _normal_equations(*self._given(window), at.logs, at.rows, False, lasting, H, g, z)
        return H, g

    def _point(self, window: Reading, T: Array, size: Array, rows: Array | None = None) -> Point:
        """What is predicted at a pose and size; derivatives that are not given cost six times as much as all else."""
        T_world_pads = window.T_world_pads
        R = T_world_pads[:, :3, :3]
        T_pads_target = np.zeros((len(R), 4, 4))
        T_pads_target[:, :3, :3] = R.transpose(0, 2, 1) @ T[:3, :3]
        T_pads_target[:, :3, 3] = np.einsum("pij,pi->pj", R, T[:3, 3] - T_world_pads[:, :3, 3])
        T_pads_target[:, 3, 3] = 1.0
        if rows is not None:
            return Point(T, size, np.log(self.response.change(T_pads_target, size)) + self._scale, rows)
        logs, jacobian = self.response.logs(T_pads_target, size)
        rows = np.empty_like(jacobian)
        _to_world(T_world_pads, self._pad_of, jacobian, rows)
        return Point(T, size, logs + self._scale, rows)

    def _given(self, window: Reading) -> tuple[Array, Array, Array, Array, Array]:
        return window.signal, window.variance, window.distrust, window.doubt, self.response.error

    def _posterior(
        self, window: Reading, prior: Prior, at: Point, coarse: bool, z: Array | None = None
    ) -> tuple[Array, Array, float]:
        H, g = np.zeros((8, 8)), np.zeros(8)
        z = np.zeros(len(at.logs)) if z is None else z
        cost = _normal_equations(*self._given(window), at.logs, at.rows, coarse, 1.0, H, g, z)
        toward, toward_size = pose_error(prior.T, at.T), prior.size - at.size
        pull, pull_size = prior.information @ toward, prior.size_information @ toward_size
        H[:6, :6] += prior.information
        H[6:, 6:] += prior.size_information
        g[:6] += pull
        g[6:] += pull_size
        return H, g, cost + 0.5 * float(toward @ pull) + 0.5 * float(toward_size @ pull_size)


def _misfit(window: Reading, predicted: Array, z: Array) -> float:
    """Mean squared residual [variances] of the electrodes that feel something, or should; one faulty electrode counts no more
    than OUTLIER."""
    used = np.isfinite(window.variance)
    felt = used & (np.maximum(window.signal, predicted) > FELT * np.sqrt(window.variance))
    if felt.sum() < 2 * KNOWN:
        felt = used
    return float(np.minimum(z[felt] ** 2, OUTLIER**2).sum()) / max(int(felt.sum()) - KNOWN, 1)


@kernel("f8[p, 4, 4], i8[n], f8[n, 8], out f8[n, 8]")
def _to_world(T_world_pads, pad_of, jacobian, rows):  # type: ignore[no-untyped-def]
    """Derivatives (n, 8) by a pose error along each pad's own axes, along the world's."""
    for e in range(len(jacobian)):
        k = pad_of[e]
        for i in range(3):
            rows[e, i], rows[e, 3 + i] = 0.0, 0.0
            for j in range(3):
                rows[e, i] += T_world_pads[k, i, j] * jacobian[e, j]
                rows[e, 3 + i] += T_world_pads[k, i, j] * jacobian[e, 3 + j]
        rows[e, 6], rows[e, 7] = jacobian[e, 6], jacobian[e, 7]


@kernel("f8[n], f8[n], f8[n], f8[n], f8[n], f8[n], f8[n, 8], b1, f8, out f8[8, 8], out f8[8], out f8[n] -> f8")
def _normal_equations(signal, variance, distrust, doubt, error, logs, rows, coarse, lasting, H, g, z):  # type: ignore[no-untyped-def]
    """Adds the information (8, 8) and gradient (8,) about the target's pose error in the world and its size, writes residuals
    (n,) and returns the robust cost."""
    cost = 0.0
    for e in range(len(signal)):
        if not math.isfinite(variance[e]):
            z[e] = 0.0
            continue
        predicted, measured = math.exp(logs[e]), signal[e]
        at = max(measured, 0.0)
        if coarse:
            # residual and slope of asinh(v / 2 sigma): the log far above the noise, linear below it
            c = 2.0 * math.sqrt(variance[e])
            residual = math.asinh(measured / c) - math.asinh(predicted / c)
            slope = predicted / math.sqrt(predicted * predicted + c * c)
            total = (variance[e] + (COARSE_ERROR * at) ** 2) / (at * at + c * c)
        else:
            residual, slope = measured - predicted, predicted
            share = error[e] + NEAR_ERROR * at / NEAR_SIGNAL
            total = variance[e] + lasting * ((share * at) ** 2 + doubt[e] ** 2)
        z[e] = residual / math.sqrt(total)
        total *= distrust[e]
        square = residual * residual / total
        trust = 1.0
        if square > OUTLIER * OUTLIER and coarse:  # Huber's, which has no minima of its own
            cost += OUTLIER * (math.sqrt(square) - 0.5 * OUTLIER)
            trust = OUTLIER / math.sqrt(square)
        elif square > OUTLIER * OUTLIER:
            cost += 0.5 * OUTLIER * OUTLIER * (1.0 + math.log(square / (OUTLIER * OUTLIER)))
            trust = OUTLIER * OUTLIER / square
        else:
            cost += 0.5 * square
        weight = trust * slope / total
        for i in range(8):
            g[i] += weight * residual * rows[e, i]
            for j in range(8):
                H[i, j] += weight * slope * rows[e, i] * rows[e, j]
    return cost


def marginal(information: Array, gradient: Array, nuisance: Array) -> tuple[Array, Array]:
    """Information and gradient of a quadratic likelihood after a parameter's directions (m, k) were marginalised: zero along
    them. Directions that it says nothing about change nothing."""
    along = information @ nuisance
    strength = nuisance.T @ along
    strength += (1e-9 + 1e-12 * np.trace(strength)) * np.eye(len(strength))
    share = along @ np.linalg.inv(strength)
    return information - share @ along.T, gradient - share @ (nuisance.T @ gradient)


def peak(T: Array, information: Array, gradient: Array) -> tuple[Array, Array]:
    """The pose where a quadratic log-likelihood with this information (6, 6) and gradient (6,) at T is largest, and its
    information; negative and worthless directions (see WORTHLESS, TOO_FAR) carry none and are left as they are in T."""
    scale = np.array([1.0, 1.0, 1.0, 1.0 / LEVER, 1.0 / LEVER, 1.0 / LEVER])
    eigenvalues, directions = np.linalg.eigh(information * np.outer(scale, scale))
    steps = (directions.T @ (scale * gradient)) / np.maximum(eigenvalues, 1e-12)
    known = (eigenvalues > 1.0 / WORTHLESS**2) & (np.abs(steps) < TOO_FAR)
    directions = directions[:, known]
    step = scale * (directions @ steps[known])
    kept = (directions * eigenvalues[known]) @ directions.T / np.outer(scale, scale)
    return perturb(T, step), kept
