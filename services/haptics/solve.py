"""Least squares of the pose on the voltages themselves, through the response law and the target's surface.

Each electrode's gap is its distance to the target's mesh; its derivative by the pose is the unit direction from the nearest
surface point, so a Gauss-Newton step costs one nearest-point query. Residuals in volts keep the noise white and Gaussian
also where an electrode feels nothing. Three things keep it honest:

- the first steps use the secant of the law between the measured and the predicted gap instead of its tangent: the gap is
  nearly linear in the pose, the voltage is not;
- what the model gets wrong counts as noise, a fraction of the signal;
- an electrode that feels something else (an upper arm, a torso) loses its weight.

What is handed on is the likelihood alone, J^T R^-1 J and the point where it peaks: a prior is inside the solve only to
hold the directions that the skin does not see.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from shared.geometry import perturb
from shared.skin import Skin
from shared.surface import Surface, nearest_points

Array = NDArray[np.float64]

MODEL_ERROR = 0.03
"""Standard deviation of what mesh and law get wrong, as a fraction of the signal."""
OUTLIER = 3.0
"""Residual, in standard deviations, from which an electrode loses weight as its square."""
LEVER = 0.1
"""Distance [m] at which a rotation counts like a displacement, where the two are compared."""
WORTHLESS = 0.15
"""A direction known no better than this [m, or rad times LEVER] is published as unknown: beyond, the linearisation that a
covariance stands for has no meaning."""

TOO_FAR = 0.1
"""The same for a direction along which the likelihood peaks this far [m, or rad times LEVER] from where it was linearised."""


@dataclass(frozen=True)
class Solution:
    """T_world_target (4, 4): the most probable pose; information (6, 6) and gradient (6,): the likelihood there, about
    `geometry.perturb`; cost: the robust negative log posterior, up to a constant;
    evidence: its part that comes from the voltages; misfit: mean squared residual [variances]; gap [m]: the
    smallest predicted one."""

    T: Array
    information: Array
    gradient: Array
    cost: float
    evidence: float
    misfit: float
    gap: float

    def likelihood(self) -> tuple[Array, Array]:
        """T_world_target at the peak of the likelihood, and its information (6, 6): zero in worthless directions."""
        return peak(self.T, self.information, self.gradient)


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


def solve(
    skin: Skin,
    surface: Surface,
    electrodes: Array,
    amplitude: Array,
    variance: Array,
    T_start: Array,
    T_prior: Array,
    prior_information: Array,
    coarse: int = 4,
    fine: int = 3,
) -> Solution:
    """The most probable T_world_target.

    electrodes (n, 3) [m] in the world; amplitude, variance (n,): mean voltages and their variances, infinite for an
    electrode to leave out; T_prior with prior_information (6, 6): what is believed beforehand; coarse, fine: steps with
    the secant and with the tangent of the law.
    """
    T = np.ascontiguousarray(T_start, dtype=np.float64).copy()
    information, gradient, numbers = np.empty((6, 6)), np.empty(6), np.empty(4)
    _solve(
        np.ascontiguousarray(electrodes), skin.signal(amplitude), 1.0 / np.asarray(variance), skin.peak, skin.a2,
        *surface.arrays, T, T_prior, np.ascontiguousarray(prior_information), coarse, fine, information, gradient, numbers,
    )  # fmt: skip
    return Solution(T, information, gradient, *map(float, numbers))


@njit(cache=True, nogil=True)
def _rotation(vector):  # type: ignore[no-untyped-def]
    """The matrix of a rotation vector (Rodrigues)."""
    angle = math.sqrt(vector[0] ** 2 + vector[1] ** 2 + vector[2] ** 2)
    K = np.array([[0.0, -vector[2], vector[1]], [vector[2], 0.0, -vector[0]], [-vector[1], vector[0], 0.0]])
    if angle < 1e-8:
        return np.eye(3) + K
    return np.eye(3) + (math.sin(angle) / angle) * K + ((1.0 - math.cos(angle)) / angle**2) * (K @ K)


@njit(cache=True, nogil=True)
def _rotation_vector(R):  # type: ignore[no-untyped-def]
    """The rotation vector of a matrix, for angles well below pi."""
    x, y, z = R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]
    sine = 0.5 * math.sqrt(x * x + y * y + z * z)
    angle = math.atan2(sine, 0.5 * (R[0, 0] + R[1, 1] + R[2, 2] - 1.0))
    factor = 0.5 if sine < 1e-8 else 0.5 * angle / sine
    return factor * np.array([x, y, z])


@njit(cache=True, nogil=True)
def _solve(electrodes, signal, weight, law_peak, a2, corners, centers, radii, normals,
           T, T_prior, prior, coarse, fine, information, gradient, numbers):  # type: ignore[no-untyped-def]  # fmt: skip
    n = len(electrodes)
    distance, nearest, slope_gap = np.empty(n), np.empty((n, 3)), np.empty((n, 3))
    row, toward = np.empty(6), np.empty(6)
    for iteration in range(coarse + fine + 1):
        R, t = np.ascontiguousarray(T[:3, :3]), T[:3, 3].copy()
        nearest_points((electrodes - t) @ R, corners, centers, radii, normals, distance, nearest, slope_gap)
        information[:] = 0.0
        gradient[:] = 0.0
        cost, misfit, used, gap = 0.0, 0.0, 0.0, np.inf
        for e in range(n):
            if weight[e] <= 0.0:
                continue
            d = max(distance[e], 0.0)
            gap = min(gap, d)
            predicted = law_peak[e] / (1.0 + a2[e] * d * d)
            slope = -2.0 * a2[e] * d * predicted**2 / law_peak[e]
            expected = predicted
            measured = law_peak[e] / signal[e] - 1.0 if signal[e] > 0.0 else np.inf
            if iteration < coarse and measured < a2[e] * 0.25:  # it feels something within half a metre
                expected = max(predicted, min(signal[e], law_peak[e]))
                apart = distance[e] - math.sqrt(max(measured, 0.0) / a2[e])
                if abs(apart) > 1e-4:
                    slope = min((predicted - signal[e]) / apart, 0.0)
            residual = signal[e] - predicted
            inverse_variance = 1.0 / (1.0 / weight[e] + (MODEL_ERROR * expected) ** 2)
            square = residual * residual * inverse_variance
            trust = 1.0
            if square > OUTLIER**2:
                cost += 0.5 * OUTLIER**2 * (1.0 + math.log(square / OUTLIER**2))
                if iteration >= coarse:
                    trust = OUTLIER**2 / square
            else:
                cost += 0.5 * square
            misfit += trust * square
            used += trust
            for i in range(3):
                row[i] = -(R[i, 0] * slope_gap[e, 0] + R[i, 1] * slope_gap[e, 1] + R[i, 2] * slope_gap[e, 2])
            ax, ay, az = electrodes[e, 0] - t[0], electrodes[e, 1] - t[1], electrodes[e, 2] - t[2]
            row[3] = ay * row[2] - az * row[1]
            row[4] = az * row[0] - ax * row[2]
            row[5] = ax * row[1] - ay * row[0]
            factor = trust * inverse_variance * slope
            for i in range(6):
                gradient[i] += factor * residual * row[i]
                for j in range(6):
                    information[i, j] += factor * slope * row[i] * row[j]
        toward[:3] = T_prior[:3, 3] - t
        toward[3:] = _rotation_vector(np.ascontiguousarray(T_prior[:3, :3]) @ np.ascontiguousarray(R.T))
        pull = prior @ toward
        numbers[0] = cost + 0.5 * np.dot(toward, pull)
        numbers[1] = cost
        numbers[2] = misfit / max(used - 4.0, 1.0)
        numbers[3] = gap
        if iteration == coarse + fine:
            break
        step = np.linalg.solve(information + prior, gradient + pull)
        shrink = min(1.0, 0.06 / (math.sqrt(np.sum(step[:3] ** 2)) + 1e-12), 0.5 / (math.sqrt(np.sum(step[3:] ** 2)) + 1e-12))
        T[:3, 3] += shrink * step[:3]
        T[:3, :3] = _rotation(shrink * step[3:]) @ R
