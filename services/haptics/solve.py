"""Solves limb pose and size by least squares on the voltages of all electrodes, with the field model's derivatives.

The unknowns are a pose error (6,) and the limb's size (2,): the logs of its length and girth. Residuals in volts keep the noise
white and Gaussian even where an electrode feels nothing. Consistency and convergence rest on these measures:

- the first steps compare the signals' logs where they exceed the noise (an inverse hyperbolic sine does that): a signal's log is
  smooth in the pose over centimetres, the signal itself is not;
- a step that worsens the fit is shortened;
- the field model's error counts as noise, a share of the signal;
- an electrode that feels something else, or is faulty, loses weight as its residual grows.

The prior only holds the directions that the skin does not observe. The result is the likelihood: J^T R^-1 J, and its peak.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from penumbra.shared.geometry import so3
from penumbra.shared.geometry.rigid import Array, perturb, pose_error
from penumbra.shared.native import inner, kernel
from penumbra.shared.skin.layout import Skin
from penumbra.shared.skin.response import ARRAYS, Response, derivatives, values

NEAR_ERROR = 0.06
"""Growth of the response's error near touch: this share of the signal per NEAR_SIGNAL is added to the error."""
NEAR_SIGNAL = 1.0
"""Signal [V] at a gap of half a centimetre."""
COARSE_ERROR = 0.3
"""Error share in the first steps: it makes near and far electrodes weigh alike."""
OUTLIER = 3.0
"""Residual, in standard deviations, above which an electrode's weight falls as its square."""
FARTHEST_STEP = (0.06, 0.5, 0.25)
"""Maximum step: position [m], rotation [rad], log size."""
SAME_SLOPE = 0.3
"""Change of the log signals below which a step keeps the derivatives of the previous one."""
CONVERGED = 0.05
"""Expected gain in log probability below which a step is the last one, taken without evaluating the cost."""
AVERAGED = 25.0
"""Number of windows over which noise is averaged to separate it from lasting errors, see `Solver.free`."""
FELT = 3.0
"""Signal, in standard deviations, above which an electrode feels something."""
KNOWN = 4
"""Number of unknowns that the voltages usually determine."""
LEVER = 0.1
"""Distance [m] by which rotations are scaled where they are compared with displacements."""
SCALE = np.repeat([1.0, 1.0 / LEVER], 3)
SCALES = np.outer(SCALE, SCALE)
"""Factors on a pose error's gradient (6,) and information (6, 6) that give rotations and displacements the same unit."""
WORTHLESS = 0.15
"""Standard deviation [m, or rad times LEVER] above which a direction is published as unknown: beyond it, the linearisation behind
a covariance does not hold."""
TOO_FAR = 0.1
"""Distance [m, or rad times LEVER] from the point of linearisation to the peak above which a direction is published as
unknown."""


@dataclass(frozen=True)
class Prior:
    """Prior of a solve: T_world_target (4, 4) with its information (6, 6) about `geometry.perturb`, and the size (2,) with its
    information (2, 2)."""

    T: Array
    information: Array
    size: Array
    size_information: Array

    def cost(self, solution: Solution) -> float:
        """The prior's part of a solution's cost; the rest is the voltages' part."""
        toward, toward_size = pose_error(self.T, solution.T), self.size - solution.size
        return 0.5 * float(toward @ self.information @ toward) + 0.5 * float(toward_size @ self.size_information @ toward_size)


@dataclass(frozen=True)
class Reading:
    """Measurements of one window. signal, variance (n,): mean voltage less its rest [V], positive near a person, and its
    variance, infinite for an electrode to leave out; T_world_pads (p, 4, 4); distrust (n,): factor >= 1 on an electrode's
    variances, for a pad that has not fitted lately; doubt (n,) [V]: standard deviation of the predicted rest; error (n,): error
    of field model and gain, as a share of the signal; joints (j,) [rad]: of the robots, which only the network reads."""

    signal: Array
    variance: Array
    T_world_pads: Array
    distrust: Array
    doubt: Array
    error: Array
    joints: ArrayLike = ()


@dataclass(frozen=True)
class Point:
    """Linearisation point: T_world_target (4, 4), size (2,), the log signals (n,) [V] there and their derivatives (n, 8) by pose
    and size."""

    T: Array
    size: Array
    logs: Array
    rows: Array


@dataclass(frozen=True)
class Solution:
    """The most probable T_world_target (4, 4) and size (2,). cost: the robust negative log posterior, up to a constant; misfit:
    mean squared residual of the electrodes that feel something [variances]; residuals (n,): in standard deviations, zero for
    electrodes left out; signal (n,) [V]: predicted; point: the linearisation for `Solver.likelihood`."""

    T: Array
    size: Array
    cost: float
    misfit: float
    residuals: Array
    signal: Array
    point: Point


class Solver:
    """Solver for the pads of one cell. skin, response: of the same cell."""

    def __init__(self, skin: Skin, response: Response):
        self.response = response
        self._pad_of = skin.pad_of
        self._scale = np.log(skin.gain * skin.sensitivity)

    def solve(self, window: Reading, prior: Prior, T: Array, size: Array, coarse: int = 12, fine: int = 8) -> Solution:
        """The most probable pose and size near a start T (4, 4), size (2,). coarse, fine: maximum numbers of steps on logs and on
        volts."""
        n = len(self._scale)
        at = Point(np.array(T, order="C"), np.array(size), np.empty(n), np.empty((n, 8)))
        z = np.empty(n)
        believed = np.ascontiguousarray(prior.T), np.ascontiguousarray(prior.information), prior.size, prior.size_information
        pads = self.response.size, self._scale, self._pad_of, window.T_world_pads
        found = at.T, at.size, at.logs, at.rows, z
        cost = _descend(*self.response.arrays, *pads, *self._given(window), *believed, coarse, fine, *found)
        predicted = np.exp(at.logs)
        return Solution(at.T, at.size, cost, _misfit(window, predicted, z), z, predicted, at)

    def likelihood(self, window: Reading, solution: Solution, lasting: float = 1.0) -> tuple[Array, Array]:
        """Information (8, 8) and gradient (8,) of the voltages alone at a solution, by pose and size. lasting: factor on the
        variance of errors that last longer than a window."""
        H, g = np.zeros((8, 8)), np.zeros(8)
        at, z = solution.point, np.zeros(len(self._scale))
        _normal_equations(*self._given(window), at.logs, at.rows, False, lasting, H, g, z)
        return H, g

    def free(self, window: Reading, solution: Solution, prior: Prior) -> Array:
        """The share (n,) of an electrode's error that stays in its residual after a solve with this prior, with noise averaged
        out: one less its leverage. Close to zero where few electrodes feel anything and pose and size fit them."""
        J = solution.signal[:, None] * solution.point.rows
        weight = 1.0 / (window.variance / AVERAGED + (window.error * solution.signal) ** 2)
        A = J.T @ (weight[:, None] * J)
        A[:6, :6] += prior.information
        A[6:, 6:] += prior.size_information
        return np.minimum(np.maximum(1.0 - weight * np.einsum("ni,in->n", J, np.linalg.solve(A, J.T)), 0.0), 1.0)

    def _given(self, window: Reading) -> tuple[Array, Array, Array, Array, Array]:
        return window.signal, window.variance, window.distrust, window.doubt, window.error


def _misfit(window: Reading, predicted: Array, z: Array) -> float:
    """Mean squared residual [variances] of the electrodes that feel something, or should; each is capped at OUTLIER."""
    used = np.isfinite(window.variance)
    felt = used & (np.maximum(window.signal, predicted) > FELT * np.sqrt(window.variance))
    if np.count_nonzero(felt) < 2 * KNOWN:
        felt = used
    squares = np.minimum(z[felt] ** 2, OUTLIER**2)
    return float(squares.sum()) / max(len(squares) - KNOWN, 1)


@kernel(
    f"""{ARRAYS}, f8[2], f8[n], i8[n], f8[p, 4, 4], f8[n], f8[n], f8[n], f8[n], f8[n],
    f8[4, 4], f8[6, 6], f8[2], f8[2, 2], i8, i8, out f8[4, 4], out f8[2], out f8[n], out f8[n, 8], out f8[n] -> f8"""
)
def _descend(  # type: ignore[no-untyped-def]
    index, points, ends, mean, scaling, w0, b0, w1, b1, w2, b2, skip, own_size, scale, pad_of, T_world_pads,
    signal, variance, distrust, doubt, error, T_prior, information, size_prior, size_information, coarse, fine,
    T, size, logs, rows, z,
):  # fmt: skip
    """The steps of `Solver.solve`, from the pose T and size that are given to those that are found, with the logs, derivatives
    and residuals there; returns the cost."""
    network = (index, points, ends, mean, scaling, w0, b0, w1, b1, w2, b2, skip)
    pads, given = (own_size, scale, pad_of, T_world_pads), (signal, variance, distrust, doubt, error)
    prior = (T_prior, information, size_prior, size_information)
    n = len(scale)
    T_there, size_there, logs_there, rows_there = np.empty((4, 4)), np.empty(2), np.empty(n), np.empty((n, 8))
    H, g, H_there, g_there, step = np.empty((8, 8)), np.empty(8), np.empty((8, 8)), np.empty(8), np.empty(8)
    _predict(network, pads, T, size, True, logs, rows)
    for stage in range(2):
        is_coarse = stage == 0
        cost = _posterior(given, prior, T, size, logs, rows, is_coarse, H, g, z)
        for _ in range(coarse if is_coarse else fine):
            _step(H, g, step)
            gain = 0.0
            for i in range(8):
                gain += step[i] * g[i]
                for j in range(8):
                    gain -= 0.5 * step[i] * H[i, j] * step[j]
            if gain < CONVERGED:
                if not is_coarse:  # to first order
                    for e in range(n):
                        for i in range(8):
                            logs[e] += rows[e, i] * step[i]
                    _move(T, size, step, T_there, size_there)
                    T[:], size[:] = T_there, size_there
                break
            improves = False
            for _ in range(4):
                largest = 0.0
                for e in range(n):
                    change = 0.0
                    for i in range(8):
                        change += rows[e, i] * step[i]
                    largest = max(largest, abs(change))
                has_rows = is_coarse or largest >= SAME_SLOPE
                _move(T, size, step, T_there, size_there)
                if not has_rows:
                    rows_there[:] = rows
                _predict(network, pads, T_there, size_there, has_rows, logs_there, rows_there)
                cost_there = _posterior(given, prior, T_there, size_there, logs_there, rows_there, is_coarse, H_there, g_there, z)
                improves = cost_there <= cost
                if improves:
                    break
                for i in range(8):
                    step[i] *= 0.4
            if not improves:
                break
            T[:], size[:], logs[:], rows[:] = T_there, size_there, logs_there, rows_there
            H[:], g[:], cost = H_there, g_there, cost_there
    return _posterior(given, prior, T, size, logs, rows, False, H, g, z)


@inner
def _predict(network, pads, T, size, has_rows, logs, rows):  # type: ignore[no-untyped-def]
    """The logs (n,) of the signals at a pose (4, 4) and size (2,), and with has_rows their derivatives (n, 8) along the world's
    axes, which cost four times as much."""
    index, points, ends, mean, scaling, w0, b0, w1, b1, w2, b2, skip = network
    own_size, scale, pad_of, T_world_pads = pads
    T_pads_target = np.zeros((len(T_world_pads), 4, 4))
    for k in range(len(T_world_pads)):
        for i in range(3):
            for j in range(3):
                T_pads_target[k, i, 3] += T_world_pads[k, j, i] * (T[j, 3] - T_world_pads[k, j, 3])
                for m in range(3):
                    T_pads_target[k, i, j] += T_world_pads[k, m, i] * T[m, j]
    whole = own_size + size
    if has_rows:
        by_pads = np.empty_like(rows)
        derivatives(index, points, ends, mean, scaling, w0, b0, w1, b1, w2, b2, skip, T_pads_target, whole, logs, by_pads)
        for e in range(len(logs)):
            k = pad_of[e]
            for i in range(3):
                rows[e, i], rows[e, 3 + i] = 0.0, 0.0
                for j in range(3):
                    rows[e, i] += T_world_pads[k, i, j] * by_pads[e, j]
                    rows[e, 3 + i] += T_world_pads[k, i, j] * by_pads[e, 3 + j]
            rows[e, 6], rows[e, 7] = by_pads[e, 6], by_pads[e, 7]
    else:
        values(index, points, ends, mean, scaling, w0, b0, w1, b1, w2, b2, skip, T_pads_target, whole, logs)
    for e in range(len(logs)):
        logs[e] += scale[e]


@inner
def _move(T, size, step, T_there, size_there):  # type: ignore[no-untyped-def]
    """Writes the pose (4, 4) and size (2,) a step (8,) away, as `geometry.perturb` moves a pose."""
    turn = np.empty((3, 3))
    so3.exp(step[3:6], turn)
    T_there[:] = T
    so3.turn(turn, T_there, 0)
    for i in range(3):
        T_there[i, 3] = T[i, 3] + step[i]
    size_there[0], size_there[1] = size[0] + step[6], size[1] + step[7]


@inner
def _step(H, g, step):  # type: ignore[no-untyped-def]
    """Writes the step (8,) with H step = g, for a symmetric positive definite H (Cholesky without square roots), no longer than
    FARTHEST_STEP."""
    L, d = np.empty((8, 8)), np.empty(8)
    for j in range(8):
        d[j] = H[j, j]
        for k in range(j):
            d[j] -= L[j, k] * L[j, k] * d[k]
        for i in range(j + 1, 8):
            L[i, j] = H[i, j]
            for k in range(j):
                L[i, j] -= L[i, k] * L[j, k] * d[k]
            L[i, j] /= d[j]
    for i in range(8):
        step[i] = g[i]
        for k in range(i):
            step[i] -= L[i, k] * step[k]
    for i in range(8):
        step[i] /= d[i]
    for i in range(7, -1, -1):
        for k in range(i + 1, 8):
            step[i] -= L[k, i] * step[k]
    position = math.sqrt(step[0] * step[0] + step[1] * step[1] + step[2] * step[2])
    rotation = math.sqrt(step[3] * step[3] + step[4] * step[4] + step[5] * step[5])
    size = max(abs(step[6]), abs(step[7]))
    share = max(1.0, position / FARTHEST_STEP[0], rotation / FARTHEST_STEP[1], size / FARTHEST_STEP[2])
    for i in range(8):
        step[i] /= share


@inner
def _posterior(given, prior, T, size, logs, rows, is_coarse, H, g, z):  # type: ignore[no-untyped-def]
    """Writes the information (8, 8) and gradient (8,) of voltages and prior, and the residuals (n,); returns the cost."""
    signal, variance, distrust, doubt, error = given
    T_prior, information, size_prior, size_information = prior
    H[:], g[:] = 0.0, 0.0
    cost = _normal_equations(signal, variance, distrust, doubt, error, logs, rows, is_coarse, 1.0, H, g, z)
    turn, toward = np.empty((3, 3)), np.empty(8)
    so3.product_transposed(T_prior[:3, :3], T[:3, :3], turn)
    so3.log(turn, toward[3:6])
    for i in range(3):
        toward[i] = T_prior[i, 3] - T[i, 3]
    toward[6], toward[7] = size_prior[0] - size[0], size_prior[1] - size[1]
    for first, part in ((0, information), (6, size_information)):
        for i in range(len(part)):
            for j in range(len(part)):
                H[first + i, first + j] += part[i, j]
                g[first + i] += part[i, j] * toward[first + j]
                cost += 0.5 * toward[first + i] * part[i, j] * toward[first + j]
    return cost


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
    """Marginalise a parameter with directions (m, k) out of a quadratic likelihood: returns information and gradient, zero along
    these directions. Directions without information change nothing."""
    along = information @ nuisance
    strength = nuisance.T @ along
    strength += (1e-9 + 1e-12 * np.trace(strength)) * np.eye(len(strength))
    share = along @ np.linalg.inv(strength)
    return information - share @ along.T, gradient - share @ (nuisance.T @ gradient)


def peak(T: Array, information: Array, gradient: Array) -> tuple[Array, Array]:
    """The pose at the peak of a quadratic log-likelihood with this information (6, 6) and gradient (6,) at T, and its
    information. Negative and worthless directions (see WORTHLESS, TOO_FAR) get zero information and keep T's values."""
    eigenvalues, directions = np.linalg.eigh(information * SCALES)
    steps = (directions.T @ (SCALE * gradient)) / np.maximum(eigenvalues, 1e-12)
    known = (eigenvalues > 1.0 / WORTHLESS**2) & (np.abs(steps) < TOO_FAR)
    directions = directions[:, known]
    step = SCALE * (directions @ steps[known])
    kept = (directions * eigenvalues[known]) @ directions.T / SCALES
    return perturb(T, step), kept
