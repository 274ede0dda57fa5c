"""Rotations for the observer's inner loop: scipy's Rotation costs 5 to 20 us a call, which a replay makes hundreds of times.

Rotation vectors r (3,) [rad]; `exp(r)` turns about the fixed axes. Formulas: Sola, Deray, Atchuthan, "A micro Lie theory for
state estimation in robotics" (2018), arXiv:1812.01537, appendix B.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.floating[Any]]


def hat(r: Array) -> Array:
    """The skew matrix (3, 3) with hat(r) @ s == cross(r, s)."""
    x, y, z = float(r[0]), float(r[1]), float(r[2])
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def exp(r: Array) -> Array:
    """The rotation matrix (3, 3) of a rotation vector (Rodrigues)."""
    x, y, z = float(r[0]), float(r[1]), float(r[2])
    square = x * x + y * y + z * z
    if square < 1e-8:  # the next terms are below 1e-17
        a, b = 1.0 - square / 6.0, 0.5 - square / 24.0
    else:
        angle = math.sqrt(square)
        a, b = math.sin(angle) / angle, (1.0 - math.cos(angle)) / square
    return np.array(
        [
            [1.0 - b * (y * y + z * z), b * x * y - a * z, b * x * z + a * y],
            [b * x * y + a * z, 1.0 - b * (x * x + z * z), b * y * z - a * x],
            [b * x * z - a * y, b * y * z + a * x, 1.0 - b * (x * x + y * y)],
        ]
    )


def log(R: Array) -> Array:
    """The rotation vector of a rotation matrix, its angle in [0, pi]."""
    x, y, z, w = quaternion(R)
    sine = math.sqrt(x * x + y * y + z * z)
    scale = 2.0 if sine < 1e-9 else 2.0 * math.atan2(sine, w) / sine
    return np.array([scale * x, scale * y, scale * z])


def quaternion(R: Array) -> tuple[float, float, float, float]:
    """(x, y, z, w) with w >= 0 of a rotation matrix.

    Computed from the largest of the four (Shepperd 1978): no loss of digits near an angle of pi.
    """
    (a, b, c), (d, e, f), (g, h, i) = R.tolist()
    if a + e + i > 0.0:
        q = (1.0 + a + e + i, h - f, c - g, d - b)
    elif a >= e and a >= i:
        q = (h - f, 1.0 + a - e - i, b + d, c + g)
    elif e >= i:
        q = (c - g, b + d, 1.0 + e - a - i, f + h)
    else:
        q = (d - b, c + g, f + h, 1.0 + i - a - e)
    scale = math.copysign(1.0 / math.sqrt(sum(v * v for v in q)), q[0])
    return q[1] * scale, q[2] * scale, q[3] * scale, q[0] * scale


def left_jacobian_inverse(r: Array) -> Array:
    """J (3, 3) with log(exp(d) @ exp(r)) = r + J @ d for a small d."""
    square = float(r @ r)
    if square < 1e-8:
        c = 1.0 / 12.0
    else:
        half = 0.5 * math.sqrt(square)
        c = (1.0 - half / math.tan(half)) / square
    K = hat(r)
    return np.eye(3) - 0.5 * K + c * (K @ K)


def swing(a: Array, b: Array) -> Array:
    """The rotation vector of the shortest turn that takes the unit vector a (3,) to b (3,)."""
    cross = hat(a) @ b
    sine, cosine = math.sqrt(float(cross @ cross)), float(a @ b)
    if sine > 1e-9:
        return math.atan2(sine, cosine) / sine * cross
    if cosine > 0.0:
        return cross
    across = hat(a) @ np.eye(3)[np.argmin(np.abs(a))]  # opposite: half a turn about any axis across
    return math.pi / math.sqrt(float(across @ across)) * across


def orthonormal(R: Array) -> Array:
    """R after one Newton step towards the nearest rotation: keeps rounding from piling up over a long run."""
    return 1.5 * R - 0.5 * (R @ R.T @ R)
