"""From a pad's voltages to the relative position of the nearest surface point (paper, "Haptic-based Pose Estimation").

Around a pad the distance to the skin is a field whose gradient has length one. With distance d at the pad's origin and
the gradient's part g in the pad's plane, an electrode at centroid p sees the gap

    d(p) = d + g.p + (|p|^2 - (g.p)^2) / (4 (d + r)),

the last term for a limb of radius r that is round one way and straight the other. d and g are fitted to the voltages
themselves (not to inverted gaps, which noise biases), and the nearest point is -d (g, -sqrt(1 - |g|^2)).
"""

from __future__ import annotations

import math

import numpy as np

from penumbra.shared.geometry.rigid import Array
from penumbra.shared.native import inner, kernel
from penumbra.shared.skin.layout import Skin

LIMB_RADIUS = 0.045
"""r [m]: halfway between a wrist and an elbow."""
EXPECTED_GAP = 0.15
"""Expected distance [m] of the skin from a pad that feels nothing, with a factor of e either way: the end of the paper's
range."""
EXPECTED_TILT = 0.4
"""Standard deviation of each component of g before any measurement."""
ITERATIONS = 6
"""Number of Gauss-Newton steps of the fit."""


def nearest_points(skin: Skin, signal: Array, variance: Array) -> tuple[Array, Array]:
    """The nearest surface point per pad, in the pad's frame.

    signal, variance: mean voltage less its rest [V] and its variance [V^2] per electrode (..., n), infinite for electrodes to
    leave out. Returns points (..., p, 3) [m] and their covariances (..., p, 3, 3) [m^2]; a pad without electrodes gets the prior.
    """
    shape, pads = np.shape(signal)[:-1], len(skin.pads)
    signal = np.ascontiguousarray(signal, dtype=np.float64).reshape(-1, len(skin))
    precision = 1.0 / np.broadcast_to(np.asarray(variance, dtype=np.float64), signal.shape)
    points, covariances = np.empty((len(signal), pads, 3)), np.empty((len(signal), pads, 3, 3))
    _fit(signal, np.ascontiguousarray(precision), skin.first, skin.centroids, skin.peak, skin.a2, points, covariances)
    return points.reshape(*shape, pads, 3), covariances.reshape(*shape, pads, 3, 3)


@inner
def _solve(H, b, x):  # type: ignore[no-untyped-def]
    """Fills x (3,) with H x = b, for a symmetric positive definite H (Cholesky without square roots)."""
    l1, l2 = H[1, 0] / H[0, 0], H[2, 0] / H[0, 0]
    d1, rest = H[1, 1] - l1 * H[1, 0], H[2, 1] - l2 * H[1, 0]
    l3 = rest / d1
    d2 = H[2, 2] - l2 * H[2, 0] - l3 * rest
    y1 = b[1] - l1 * b[0]
    x[2] = (b[2] - l2 * b[0] - l3 * y1) / d2
    x[1] = y1 / d1 - l3 * x[2]
    x[0] = b[0] / H[0, 0] - l1 * x[1] - l2 * x[2]


@kernel("f8[s, n], f8[s, n], i8[q], f8[n, 3], f8[n], f8[n], out f8[s, p, 3], out f8[s, p, 3, 3]")
def _fit(signal, precision, first, centroids, peak, a2, points, covariances):  # type: ignore[no-untyped-def]
    """Gauss-Newton on (log d, g_x, g_y), pad by pad."""
    prior = np.array([1.0, 1.0 / EXPECTED_TILT**2, 1.0 / EXPECTED_TILT**2])
    H, J = np.empty((3, 3)), np.empty((3, 3))
    x, b, row, step = np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    for s in range(len(signal)):
        for k in range(len(first) - 1):
            # Start at the gap that the strongest electrode has by itself.
            d = EXPECTED_GAP
            for e in range(first[k], first[k + 1]):
                if precision[s, e] > 0.0 and signal[s, e] * math.sqrt(precision[s, e]) > 3.0:
                    d = min(d, math.sqrt(max(peak[e] / signal[s, e] - 1.0, 0.01) / a2[e]))
            x[0], x[1], x[2] = math.log(d), 0.0, 0.0
            for _ in range(ITERATIONS):
                H[:] = 0.0
                H[0, 0], H[1, 1], H[2, 2] = prior[0], prior[1], prior[2]
                b[0] = prior[0] * (math.log(EXPECTED_GAP) - x[0])
                b[1], b[2] = -prior[1] * x[1], -prior[2] * x[2]
                d = math.exp(x[0])
                for e in range(first[k], first[k + 1]):
                    px, py = centroids[e, 0], centroids[e, 1]
                    along, square = x[1] * px + x[2] * py, px * px + py * py
                    bend = 0.25 / (d + LIMB_RADIUS)
                    gap = max(d + along + bend * (square - along * along), 1e-4)
                    denominator = 1.0 + a2[e] * gap * gap
                    slope = -2.0 * peak[e] * a2[e] * gap / denominator**2
                    row[0] = slope * d
                    row[1] = slope * (px - 2.0 * bend * along * px)
                    row[2] = slope * (py - 2.0 * bend * along * py)
                    residual = signal[s, e] - peak[e] / denominator
                    for i in range(3):
                        b[i] += precision[s, e] * row[i] * residual
                        for j in range(3):
                            H[i, j] += precision[s, e] * row[i] * row[j]
                _solve(H, b, step)
                x[0] = min(max(x[0] + min(max(step[0], -0.7), 0.7), -6.0), 0.0)
                x[1] += min(max(step[1], -0.3), 0.3)
                x[2] += min(max(step[2], -0.3), 0.3)
                tilt = math.sqrt(x[1] ** 2 + x[2] ** 2)
                if tilt > 0.99:  # the skin lies in front of the pad
                    x[1] *= 0.99 / tilt
                    x[2] *= 0.99 / tilt
            d = math.exp(x[0])
            rise = math.sqrt(1.0 - x[1] ** 2 - x[2] ** 2)
            points[s, k, 0], points[s, k, 1], points[s, k, 2] = -d * x[1], -d * x[2], d * rise
            J[:, 0] = points[s, k]
            J[0, 1], J[1, 1], J[2, 1] = -d, 0.0, -d * x[1] / rise
            J[0, 2], J[1, 2], J[2, 2] = 0.0, -d, -d * x[2] / rise
            for i in range(3):  # J H^-1 J'
                _solve(H, J[i], step)
                for j in range(3):
                    covariances[s, k, i, j] = J[j, 0] * step[0] + J[j, 1] * step[1] + J[j, 2] * step[2]
