"""Rotations for the observer's inner loop, compiled; each may be called from Python too.

Rotation vectors r (3,) [rad]; `exp(r)` turns about the fixed axes. Formulas: Sola, Deray, Atchuthan, "A micro Lie theory for
state estimation in robotics" (2018), arXiv:1812.01537, appendix B.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit


@njit(cache=True)
def hat(r):  # type: ignore[no-untyped-def]
    """The skew matrix (3, 3) with hat(r) @ s == cross(r, s)."""
    return np.array([[0.0, -r[2], r[1]], [r[2], 0.0, -r[0]], [-r[1], r[0], 0.0]])


@njit(cache=True)
def cross(r, s):  # type: ignore[no-untyped-def]
    """The cross product (3,)."""
    return np.array([r[1] * s[2] - r[2] * s[1], r[2] * s[0] - r[0] * s[2], r[0] * s[1] - r[1] * s[0]])


@njit(cache=True)
def dot(r, s):  # type: ignore[no-untyped-def]
    """The scalar product of two vectors (n,)."""
    out = 0.0
    for i in range(len(r)):
        out += r[i] * s[i]
    return out


@njit(cache=True)
def product(A, B):  # type: ignore[no-untyped-def]
    """A @ B, for matrices so small that calling a library costs more than the sums."""
    out = np.zeros((A.shape[0], B.shape[1]))
    for i in range(A.shape[0]):
        for k in range(A.shape[1]):
            for j in range(B.shape[1]):
                out[i, j] += A[i, k] * B[k, j]
    return out


@njit(cache=True)
def product_transposed(A, B):  # type: ignore[no-untyped-def]
    """A @ B.T."""
    out = np.zeros((A.shape[0], B.shape[0]))
    for i in range(A.shape[0]):
        for j in range(B.shape[0]):
            for k in range(A.shape[1]):
                out[i, j] += A[i, k] * B[j, k]
    return out


@njit(cache=True)
def eigen(A):  # type: ignore[no-untyped-def]
    """Eigenvalues (n,), ascending, and eigenvectors (n, n), as columns, of a symmetric matrix."""
    return np.linalg.eigh(A)


@njit(cache=True)
def turn(R, A):  # type: ignore[no-untyped-def]
    """R @ A in place of A (3, n)."""
    for j in range(A.shape[1]):
        x, y, z = A[0, j], A[1, j], A[2, j]
        for i in range(3):
            A[i, j] = R[i, 0] * x + R[i, 1] * y + R[i, 2] * z


@njit(cache=True)
def turned(R, v):  # type: ignore[no-untyped-def]
    """R @ v (3,)."""
    out = np.empty(3)
    for i in range(3):
        out[i] = R[i, 0] * v[0] + R[i, 1] * v[1] + R[i, 2] * v[2]
    return out


@njit(cache=True)
def exp(r):  # type: ignore[no-untyped-def]
    """The rotation matrix (3, 3) of a rotation vector (Rodrigues)."""
    x, y, z = r[0], r[1], r[2]
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


@njit(cache=True)
def log(R):  # type: ignore[no-untyped-def]
    """The rotation vector (3,) of a rotation matrix, its angle in [0, pi]."""
    x, y, z, w = quaternion(R)
    sine = math.sqrt(x * x + y * y + z * z)
    scale = 2.0 if sine < 1e-9 else 2.0 * math.atan2(sine, w) / sine
    return np.array([scale * x, scale * y, scale * z])


@njit(cache=True)
def quaternion(R):  # type: ignore[no-untyped-def]
    """(x, y, z, w) with w >= 0 of a rotation matrix.

    Computed from the largest of the four (Shepperd 1978): no loss of digits near an angle of pi.
    """
    a, e, i = R[0, 0], R[1, 1], R[2, 2]
    if a + e + i > 0.0:
        w, x, y, z = 1.0 + a + e + i, R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]
    elif a >= e and a >= i:
        w, x, y, z = R[2, 1] - R[1, 2], 1.0 + a - e - i, R[0, 1] + R[1, 0], R[0, 2] + R[2, 0]
    elif e >= i:
        w, x, y, z = R[0, 2] - R[2, 0], R[0, 1] + R[1, 0], 1.0 + e - a - i, R[1, 2] + R[2, 1]
    else:
        w, x, y, z = R[1, 0] - R[0, 1], R[0, 2] + R[2, 0], R[1, 2] + R[2, 1], 1.0 + i - a - e
    scale = math.copysign(1.0 / math.sqrt(w * w + x * x + y * y + z * z), w)
    return x * scale, y * scale, z * scale, w * scale


@njit(cache=True)
def left_jacobian_inverse(r):  # type: ignore[no-untyped-def]
    """J (3, 3) with log(exp(d) @ exp(r)) = r + J @ d for a small d."""
    square = r[0] * r[0] + r[1] * r[1] + r[2] * r[2]
    if square < 1e-8:
        c = 1.0 / 12.0
    else:
        half = 0.5 * math.sqrt(square)
        c = (1.0 - half / math.tan(half)) / square
    K = hat(r)
    J = c * product(K, K) - 0.5 * K
    for i in range(3):
        J[i, i] += 1.0
    return J


@njit(cache=True)
def swing(a, b):  # type: ignore[no-untyped-def]
    """The rotation vector (3,) of the shortest turn that takes the unit vector a (3,) to b (3,)."""
    axis = cross(a, b)
    sine, cosine = math.sqrt(dot(axis, axis)), dot(a, b)
    if sine < 1e-9 and cosine < 0.0:  # opposite: half a turn about any axis across
        other = np.zeros(3)
        other[np.argmin(np.abs(a))] = 1.0
        axis = cross(a, other)
        return math.pi / math.sqrt(dot(axis, axis)) * axis
    return math.atan2(sine, cosine) / sine * axis if sine > 1e-9 else axis


@njit(cache=True)
def orthonormalise(R):  # type: ignore[no-untyped-def]
    """One Newton step of R, in place, towards the nearest rotation: keeps rounding from piling up over a long run."""
    near = product(product_transposed(R, R), R)
    for i in range(3):
        for j in range(3):
            R[i, j] = 1.5 * R[i, j] - 0.5 * near[i, j]
