"""Solves limb pose and body by least squares on the voltages of all electrodes, with the field model's derivatives.

The unknowns are a pose error (6,) and the body (5,): the logs of the limb's length and girth, and the offset of the shoulder from
where the posture has it [m], on which the part of the signals by upper arm and torso depends. Residuals in volts keep the noise
white and Gaussian even where an electrode feels nothing. Consistency and convergence rest on these measures:

- the first steps compare the signals' logs where they exceed the noise (an inverse hyperbolic sine does that): a signal's log is
  smooth in the pose over centimetres, the signal itself is not;
- a step that worsens the fit is shortened;
- the field model's error counts as noise, a share of the signal, and so does that of upper arm and torso;
- an electrode that feels something else, or is faulty, loses weight as its residual grows.

The prior only holds the directions that the skin does not observe. The result is the likelihood: J^T R^-1 J, and its peak.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from penumbra.shared.body.posture import Posture
from penumbra.shared.geometry import so3
from penumbra.shared.geometry.rigid import Array, perturb, pose_error
from penumbra.shared.native import inner, kernel
from penumbra.shared.skin import bearer
from penumbra.shared.skin.layout import Skin
from penumbra.shared.skin.response import ARRAYS, Response, derivatives, values

BODY = 5
UNKNOWNS = 6 + BODY
NEAR_ERROR = 0.06
"""Growth of the response's error near touch: this share of the signal per NEAR_SIGNAL is added to the error."""
NEAR_SIGNAL = 1.0
"""Signal [V] at a gap of half a centimetre."""
BEARER_ERROR = 0.13
"""Error of the part of upper arm and torso, as a share of its logarithm. Measured: the networks' cards have medians of 0.4, 0.7,
1.5 and 2 % where leaving it out costs 1, 4, 10 and 15 %."""
COARSE_ERROR = 0.3
"""Error share in the first steps: it makes near and far electrodes weigh alike."""
OUTLIER = 3.0
"""Residual, in standard deviations, above which an electrode's weight falls as its square."""
FARTHEST_STEP = (0.06, 0.5, 0.25, 0.1)
"""Maximum step: position [m], rotation [rad], log size, shoulder [m]."""
NUDGE = (1e-4, 1e-4, 1e-4, 1e-3, 1e-3, 1e-3, 0.0, 0.0, 1e-4, 1e-4, 1e-4)
"""Steps of the derivatives of where upper arm and torso are: position [m], rotation [rad], shoulder [m]. The limb's size moves
neither."""
FAINT = 0.1
"""Signal, in standard deviations of the noise, below which these derivatives are left out: they change nothing there."""
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
    """Prior of a solve: T_world_target (4, 4) with its information (6, 6) about `geometry.perturb`, and the body (5,) with its
    information (5, 5)."""

    T: Array
    information: Array
    body: Array
    body_information: Array

    def cost(self, solution: Solution) -> float:
        """The prior's part of a solution's cost; the rest is the voltages' part."""
        toward, toward_body = pose_error(self.T, solution.T), self.body - solution.body
        return 0.5 * float(toward @ self.information @ toward) + 0.5 * float(toward_body @ self.body_information @ toward_body)


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
    """Linearisation point: T_world_target (4, 4), body (5,), the log signals (n,) [V] there and their derivatives (n, 11) by pose
    and body, and the error (n,) of field model and gain where the solve began, as a share of the signal."""

    T: Array
    body: Array
    logs: Array
    rows: Array
    error: Array


@dataclass(frozen=True)
class Solution:
    """The most probable T_world_target (4, 4) and body (5,). cost: the robust negative log posterior, up to a constant; misfit:
    mean squared residual of the electrodes that feel something [variances]; residuals (n,): in standard deviations, zero for
    electrodes left out; signal (n,) [V]: predicted; point: the linearisation for `Solver.likelihood`."""

    T: Array
    body: Array
    cost: float
    misfit: float
    residuals: Array
    signal: Array
    point: Point


class Solver:
    """Solver for the pads of one cell. skin, response: of the same cell. posture: where the rest of the person is; None for a
    limb without one."""

    def __init__(self, skin: Skin, response: Response, posture: Posture | None = None):
        self.response = response
        self._bearer: tuple[Array, ...] = (np.empty(0), *bearer.nobody(response.electrodes))
        if posture is not None and response.bearers is not None:
            self._bearer = posture.numbers, *response.bearers.arrays
        self._pad_of = skin.pad_of
        self._scale = np.log(skin.gain * skin.sensitivity)

    def solve(self, window: Reading, prior: Prior, T: Array, body: Array, coarse: int = 12, fine: int = 8) -> Solution:
        """The most probable pose and body near a start T (4, 4), body (5,). coarse, fine: maximum numbers of steps on logs and on
        volts; without any, the solution has no derivatives."""
        n = len(self._scale)
        at = Point(np.array(T, order="C"), np.array(body), np.empty(n), np.zeros((n, UNKNOWNS)), np.empty(n))
        z = np.empty(n)
        believed = np.ascontiguousarray(prior.T), np.ascontiguousarray(prior.information), prior.body, prior.body_information
        pads = self.response.size, self._scale, self._pad_of, window.T_world_pads
        found = at.T, at.body, at.logs, at.rows, at.error, z
        cost = _descend(*self.response.arrays, *self._bearer, *pads, *_given(window), *believed, coarse, fine, *found)
        predicted = np.exp(at.logs)
        return Solution(at.T, at.body, cost, _misfit(window, predicted, z), z, predicted, at)

    def likelihood(self, window: Reading, solution: Solution, lasting: float = 1.0) -> tuple[Array, Array]:
        """Information (11, 11) and gradient (11,) of the voltages alone at a solution, by pose and body. lasting: factor on the
        variance of errors that last longer than a window."""
        H, g = np.zeros((UNKNOWNS, UNKNOWNS)), np.zeros(UNKNOWNS)
        at, z = solution.point, np.zeros(len(self._scale))
        signal, variance, distrust, doubt, _ = _given(window)
        _normal_equations(signal, variance, distrust, doubt, at.error, at.logs, at.rows, False, lasting, H, g, z)
        return H, g

    def free(self, window: Reading, solution: Solution, prior: Prior) -> Array:
        """The share (n,) of an electrode's error that stays in its residual after a solve with this prior, with noise averaged
        out: one less its leverage. Close to zero where few electrodes feel anything and pose and body fit them."""
        J = solution.signal[:, None] * solution.point.rows
        weight = 1.0 / (window.variance / AVERAGED + (solution.point.error * solution.signal) ** 2)
        A = J.T @ (weight[:, None] * J)
        A[:6, :6] += prior.information
        A[6:, 6:] += prior.body_information
        return np.minimum(np.maximum(1.0 - weight * np.einsum("ni,in->n", J, np.linalg.solve(A, J.T)), 0.0), 1.0)


def _given(window: Reading) -> tuple[Array, Array, Array, Array, Array]:
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
    f"""{ARRAYS}, f8[r], {bearer.ARRAYS}, f8[2], f8[n], i8[n], f8[p, 4, 4], f8[n], f8[n], f8[n], f8[n], f8[n],
    f8[4, 4], f8[6, 6], f8[{BODY}], f8[{BODY}, {BODY}], i8, i8,
    out f8[4, 4], out f8[{BODY}], out f8[n], out f8[n, {UNKNOWNS}], out f8[n], out f8[n] -> f8"""
)
def _descend(  # type: ignore[no-untyped-def]
    index, points, ends, mean, scaling, w0, b0, w1, b1, w2, b2, skip,
    posture, pieces, b_mean, b_scale, v0, c0, v1, c1, v2, c2,
    own_size, scale, pad_of, T_world_pads, signal, variance, distrust, doubt, error,
    T_prior, information, body_prior, body_information, coarse, fine, T, body, logs, rows, error_there, z,
):  # fmt: skip
    """The steps of `Solver.solve`, from the pose T and body that are given to those that are found, with the logs, derivatives,
    errors and residuals there; returns the cost."""
    network = (index, points, ends, mean, scaling, w0, b0, w1, b1, w2, b2, skip)
    bearers = (posture, (pieces, b_mean, b_scale, v0, c0, v1, c1, v2, c2))
    pads, given = (own_size, scale, pad_of, T_world_pads), (signal, variance, distrust, doubt, error_there)
    prior = (T_prior, information, body_prior, body_information)
    n = len(scale)
    T_next, body_next, logs_next, rows_next = np.empty((4, 4)), np.empty(BODY), np.empty(n), np.empty((n, UNKNOWNS))
    H, g, H_next, g_next = np.empty((UNKNOWNS, UNKNOWNS)), np.empty(UNKNOWNS), np.empty((UNKNOWNS, UNKNOWNS)), np.empty(UNKNOWNS)
    step, added = np.empty(UNKNOWNS), np.empty(n)
    _predict(network, bearers, pads, variance, T, body, coarse + fine > 0, logs, rows, added)
    for e in range(n):
        error_there[e] = math.sqrt(error[e] * error[e] + (BEARER_ERROR * added[e]) ** 2)
    for stage in range(2):
        is_coarse = stage == 0
        cost = _posterior(given, prior, T, body, logs, rows, is_coarse, H, g, z)
        for _ in range(coarse if is_coarse else fine):
            _step(H, g, step)
            gain = 0.0
            for i in range(UNKNOWNS):
                gain += step[i] * g[i]
                for j in range(UNKNOWNS):
                    gain -= 0.5 * step[i] * H[i, j] * step[j]
            if gain < CONVERGED:
                if not is_coarse:  # to first order
                    for e in range(n):
                        for i in range(UNKNOWNS):
                            logs[e] += rows[e, i] * step[i]
                    _move(T, body, step, T_next, body_next)
                    T[:], body[:] = T_next, body_next
                break
            improves = False
            for _ in range(4):
                largest = 0.0
                for e in range(n):
                    change = 0.0
                    for i in range(UNKNOWNS):
                        change += rows[e, i] * step[i]
                    largest = max(largest, abs(change))
                has_rows = is_coarse or largest >= SAME_SLOPE
                _move(T, body, step, T_next, body_next)
                if not has_rows:
                    rows_next[:] = rows
                _predict(network, bearers, pads, variance, T_next, body_next, has_rows, logs_next, rows_next, added)
                cost_next = _posterior(given, prior, T_next, body_next, logs_next, rows_next, is_coarse, H_next, g_next, z)
                improves = cost_next <= cost
                if improves:
                    break
                for i in range(UNKNOWNS):
                    step[i] *= 0.4
            if not improves:
                break
            T[:], body[:], logs[:], rows[:] = T_next, body_next, logs_next, rows_next
            H[:], g[:], cost = H_next, g_next, cost_next
    return _posterior(given, prior, T, body, logs, rows, False, H, g, z)


@inner
def _predict(network, bearers, pads, variance, T, body, has_rows, logs, rows, added):  # type: ignore[no-untyped-def]
    """The logs (n,) of the signals at a pose (4, 4) and body (5,), and the part of upper arm and torso in them, added (n,); with
    has_rows also their derivatives (n, 11) along the world's axes, which cost several times as much."""
    index, points, ends, mean, scaling, w0, b0, w1, b1, w2, b2, skip = network
    own_size, scale, pad_of, T_world_pads = pads
    T_pads_target = np.zeros((len(T_world_pads), 4, 4))
    for k in range(len(T_world_pads)):
        _seen_from(T_world_pads[k], T, T_pads_target[k])
    whole = own_size + body[:2]
    if has_rows:
        by_pads = np.empty((len(logs), 8))
        derivatives(index, points, ends, mean, scaling, w0, b0, w1, b1, w2, b2, skip, T_pads_target, whole, logs, by_pads)
        rows[:, 8:] = 0.0
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
    added[:] = 0.0
    if len(bearers[0]) > 0:
        _add_bearer(index, bearers, scale, T_world_pads, variance, T, body, has_rows, logs, rows, added)
    for e in range(len(logs)):
        logs[e] += scale[e]


@inner
def _add_bearer(index, bearers, scale, T_world_pads, variance, T, body, has_rows, logs, rows, added):  # type: ignore[no-untyped-def]
    """Adds what upper arm and torso add to the logs (n,) of the limb's own changes, and with has_rows to their derivatives."""
    posture, networks = bearers
    size, units = len(logs) // len(index), networks[5].shape[1]
    x, sums = np.empty(networks[1].shape[1]), np.empty((2, 4))
    change, slopes = np.empty(len(x)), np.empty((size, len(x)))
    first, second = np.empty(units, np.float32), np.empty(units, np.float32)
    parts, moved, before = np.empty((3, 4, 4)), np.empty((UNKNOWNS, 3, 4, 4)), np.zeros((3, 4, 4))
    step, T_there, body_there = np.zeros(UNKNOWNS), np.empty((4, 4)), np.empty(BODY)
    _behind(posture, T, body, parts)
    if has_rows:
        for k in range(UNKNOWNS):
            step[k] = NUDGE[k]
            _move(T, body, step, T_there, body_there)
            _behind(posture, T_there, body_there, moved[k])
            step[k] = 0.0
    for p in range(len(index)):
        own, out = logs[p * size : (p + 1) * size], added[p * size : (p + 1) * size]
        for part in range(3):
            _seen_from(T_world_pads[p], parts[part], before[part])
        bearer.described(networks[0], before, own, sums, x)
        bearer.factors(networks, index[p], x, first, second, out)
        is_felt = False
        for e in range(size):
            predicted = math.exp(own[e] + out[e] + scale[p * size + e])
            is_felt |= predicted * predicted > FAINT * FAINT * variance[p * size + e]
        if has_rows and is_felt:
            by = rows[p * size : (p + 1) * size]
            bearer.slopes(networks, index[p], first, second, slopes)
            for k in range(UNKNOWNS):
                change[:] = 0.0
                if NUDGE[k] > 0.0:
                    for part in range(3):
                        _seen_from(T_world_pads[p], moved[k, part], before[part])
                    bearer.described(networks[0], before, own, sums, change)
                    for i in range(size, len(x)):
                        change[i] = (change[i] - x[i]) / NUDGE[k]
                for e in range(size):
                    change[e] = by[e, k]
                for i in range(len(x)):
                    for e in range(size):
                        by[e, k] += slopes[e, i] * change[i]
        for e in range(size):
            own[e] += out[e]


@inner
def _behind(posture, T, body, parts):  # type: ignore[no-untyped-def]
    """Writes T_world_part (3, 4, 4) of limb, upper arm and torso: see `shared.body.posture`."""
    parts[:] = 0.0
    parts[0] = T
    away = 0.0
    for i in range(3):
        parts[1, i, 0] = T[i, 3] - T[i, 0] * posture[12] - posture[i] - body[2 + i]  # from the shoulder to the elbow
        away += parts[1, i, 0] ** 2
    for i in range(3):
        parts[1, i, 0] /= math.sqrt(away)
        parts[1, i, 3] = T[i, 3] - T[i, 0] * posture[12] - posture[13] * parts[1, i, 0]
        parts[2, i, 3] = parts[1, i, 3]
        for j in range(3):
            parts[2, i, j] = posture[3 + 3 * i + j]
    x0, x1, x2 = parts[1, 0, 0], parts[1, 1, 0], parts[1, 2, 0]
    level = math.sqrt(x0 * x0 + x1 * x1)
    y0, y1 = -x1 / level, x0 / level
    parts[1, 0, 1], parts[1, 1, 1] = y0, y1
    parts[1, 0, 2], parts[1, 1, 2], parts[1, 2, 2] = -x2 * y1, x2 * y0, x0 * y1 - x1 * y0


@inner
def _seen_from(T_world_pad, T_world, out):  # type: ignore[no-untyped-def]
    """Writes a pose (4, 4) in the world as seen from a pad; its last row is not written."""
    for i in range(3):
        for j in range(4):
            out[i, j] = 0.0
            for m in range(3):
                out[i, j] += T_world_pad[m, i] * (T_world[m, j] - (T_world_pad[m, 3] if j == 3 else 0.0))


@inner
def _move(T, body, step, T_next, body_next):  # type: ignore[no-untyped-def]
    """Writes the pose (4, 4) and body (5,) a step (11,) away, as `geometry.perturb` moves a pose."""
    turn = np.empty((3, 3))
    so3.exp(step[3:6], turn)
    T_next[:] = T
    so3.turn(turn, T_next, 0)
    for i in range(3):
        T_next[i, 3] = T[i, 3] + step[i]
    for i in range(BODY):
        body_next[i] = body[i] + step[6 + i]


@inner
def _step(H, g, step):  # type: ignore[no-untyped-def]
    """Writes the step (11,) with H step = g, for a symmetric positive definite H (Cholesky without square roots), no longer than
    FARTHEST_STEP."""
    L, d = np.empty((UNKNOWNS, UNKNOWNS)), np.empty(UNKNOWNS)
    for j in range(UNKNOWNS):
        d[j] = H[j, j]
        for k in range(j):
            d[j] -= L[j, k] * L[j, k] * d[k]
        for i in range(j + 1, UNKNOWNS):
            L[i, j] = H[i, j]
            for k in range(j):
                L[i, j] -= L[i, k] * L[j, k] * d[k]
            L[i, j] /= d[j]
    for i in range(UNKNOWNS):
        step[i] = g[i]
        for k in range(i):
            step[i] -= L[i, k] * step[k]
    for i in range(UNKNOWNS):
        step[i] /= d[i]
    for i in range(UNKNOWNS - 1, -1, -1):
        for k in range(i + 1, UNKNOWNS):
            step[i] -= L[k, i] * step[k]
    position = math.sqrt(step[0] * step[0] + step[1] * step[1] + step[2] * step[2])
    rotation = math.sqrt(step[3] * step[3] + step[4] * step[4] + step[5] * step[5])
    size = max(abs(step[6]), abs(step[7]))
    shoulder = math.sqrt(step[8] * step[8] + step[9] * step[9] + step[10] * step[10])
    share = max(1.0, position / FARTHEST_STEP[0], rotation / FARTHEST_STEP[1], size / FARTHEST_STEP[2])
    share = max(share, shoulder / FARTHEST_STEP[3])
    for i in range(UNKNOWNS):
        step[i] /= share


@inner
def _posterior(given, prior, T, body, logs, rows, is_coarse, H, g, z):  # type: ignore[no-untyped-def]
    """Writes the information (11, 11) and gradient (11,) of voltages and prior, and the residuals (n,); returns the cost."""
    signal, variance, distrust, doubt, error = given
    T_prior, information, body_prior, body_information = prior
    H[:], g[:] = 0.0, 0.0
    cost = _normal_equations(signal, variance, distrust, doubt, error, logs, rows, is_coarse, 1.0, H, g, z)
    turn, toward = np.empty((3, 3)), np.empty(UNKNOWNS)
    so3.product_transposed(T_prior[:3, :3], T[:3, :3], turn)
    so3.log(turn, toward[3:6])
    for i in range(3):
        toward[i] = T_prior[i, 3] - T[i, 3]
    for i in range(BODY):
        toward[6 + i] = body_prior[i] - body[i]
    for first, part in ((0, information), (6, body_information)):
        for i in range(len(part)):
            for j in range(len(part)):
                H[first + i, first + j] += part[i, j]
                g[first + i] += part[i, j] * toward[first + j]
                cost += 0.5 * toward[first + i] * part[i, j] * toward[first + j]
    return cost


@kernel(
    f"""f8[n], f8[n], f8[n], f8[n], f8[n], f8[n], f8[n, {UNKNOWNS}], b1, f8,
    out f8[{UNKNOWNS}, {UNKNOWNS}], out f8[{UNKNOWNS}], out f8[n] -> f8"""
)
def _normal_equations(signal, variance, distrust, doubt, error, logs, rows, coarse, lasting, H, g, z):  # type: ignore[no-untyped-def]
    """Adds the information (11, 11) and gradient (11,) about the target's pose error in the world and its body, writes residuals
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
        for i in range(UNKNOWNS):
            g[i] += weight * residual * rows[e, i]
            for j in range(UNKNOWNS):
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
