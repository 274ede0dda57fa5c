"""Rotations and small matrices for inner loops. They are compiled into kernels and can be called from Python too.

Rotation vectors r (3,) are in [rad]; `exp(r)` rotates about the fixed axes. Results are written to the last argument, `out`,
because an allocation costs more than the computation. Formulas: Sola, Deray, Atchuthan, "A micro Lie theory for state estimation
in robotics" (2018), arXiv:1812.01537, appendix B.
"""

from __future__ import annotations

import math

from penumbra.shared.native import inner

SWEEPS = 16
"""Maximum number of sweeps of Jacobi's method over a matrix. It converges quadratically: a 6 x 6 matrix takes four to six."""
NEGLIGIBLE = 1e-32
"""Share of the sum of all squares below which the squares off the diagonal count as rounding errors."""


@inner
def dot(r, s):  # type: ignore[no-untyped-def]
    """The scalar product of two vectors (n,)."""
    out = 0.0
    for i in range(len(r)):
        out += r[i] * s[i]
    return out


@inner
def cross(r, s, out):  # type: ignore[no-untyped-def]
    """The cross product (3,)."""
    out[0] = r[1] * s[2] - r[2] * s[1]
    out[1] = r[2] * s[0] - r[0] * s[2]
    out[2] = r[0] * s[1] - r[1] * s[0]


@inner
def copy(A, out):  # type: ignore[no-untyped-def]
    """A matrix with the shape of `out` or a larger one, of which the upper left part is copied."""
    for i in range(out.shape[0]):
        for j in range(out.shape[1]):
            out[i, j] = A[i, j]


@inner
def product(A, B, out):  # type: ignore[no-untyped-def]
    """A @ B, for matrices so small that calling a library costs more than the sums."""
    for i in range(A.shape[0]):
        for j in range(B.shape[1]):
            out[i, j] = 0.0
            for k in range(A.shape[1]):
                out[i, j] += A[i, k] * B[k, j]


@inner
def product_transposed(A, B, out):  # type: ignore[no-untyped-def]
    """A @ B.T."""
    for i in range(A.shape[0]):
        for j in range(B.shape[0]):
            out[i, j] = 0.0
            for k in range(A.shape[1]):
                out[i, j] += A[i, k] * B[j, k]


@inner
def eigen(A, n, vectors):  # type: ignore[no-untyped-def]
    """Eigenvalues, ascending, of the symmetric matrix in the first n rows and columns of A: they take the place of its diagonal.
    The eigenvectors are written as columns.

    Jacobi's method, cyclic by rows: Golub, Van Loan, "Matrix Computations" (2013), section 8.5.
    """
    for i in range(n):
        for j in range(n):
            vectors[i, j] = 1.0 if i == j else 0.0
    for _ in range(SWEEPS):
        off, total = 0.0, 0.0
        for i in range(n):
            total += A[i, i] ** 2
            for j in range(i):
                off += 2.0 * A[i, j] ** 2
        if off <= NEGLIGIBLE * (total + off):
            break
        for p in range(n - 1):
            for q in range(p + 1, n):
                if A[p, q] != 0.0:
                    _rotate(A, n, p, q, vectors)
    for i in range(1, n):  # sorted by insertion
        j = i
        while j > 0 and A[j, j] < A[j - 1, j - 1]:
            A[j, j], A[j - 1, j - 1] = A[j - 1, j - 1], A[j, j]
            for k in range(n):
                vectors[k, j], vectors[k, j - 1] = vectors[k, j - 1], vectors[k, j]
            j -= 1


@inner
def _rotate(A, n, p, q, vectors):  # type: ignore[no-untyped-def]
    """One rotation of Jacobi's method, which makes A[p, q] zero."""
    cotangent = 0.5 * (A[q, q] - A[p, p]) / A[p, q]  # of twice the angle
    tangent = math.copysign(1.0, cotangent) / (abs(cotangent) + math.sqrt(1.0 + cotangent * cotangent))
    c = 1.0 / math.sqrt(1.0 + tangent * tangent)
    s = tangent * c
    A[p, p] -= tangent * A[p, q]
    A[q, q] += tangent * A[p, q]
    A[p, q] = A[q, p] = 0.0
    for i in range(n):
        if i != p and i != q:
            x, y = A[i, p], A[i, q]
            A[i, p] = A[p, i] = c * x - s * y
            A[i, q] = A[q, i] = s * x + c * y
        x, y = vectors[i, p], vectors[i, q]
        vectors[i, p], vectors[i, q] = c * x - s * y, s * x + c * y


@inner
def turn(R, A, first):  # type: ignore[no-untyped-def]
    """R @ A[first : first + 3] in place of these rows."""
    for j in range(A.shape[1]):
        x, y, z = A[first, j], A[first + 1, j], A[first + 2, j]
        for i in range(3):
            A[first + i, j] = R[i, 0] * x + R[i, 1] * y + R[i, 2] * z


@inner
def turn_columns(R, A, first):  # type: ignore[no-untyped-def]
    """A[:, first : first + 3] @ R.T in place of these columns."""
    for j in range(A.shape[0]):
        x, y, z = A[j, first], A[j, first + 1], A[j, first + 2]
        for i in range(3):
            A[j, first + i] = R[i, 0] * x + R[i, 1] * y + R[i, 2] * z


@inner
def turned(R, v, out):  # type: ignore[no-untyped-def]
    """R @ v (3,)."""
    for i in range(3):
        out[i] = R[i, 0] * v[0] + R[i, 1] * v[1] + R[i, 2] * v[2]


@inner
def exp(r, out):  # type: ignore[no-untyped-def]
    """The rotation matrix (3, 3) of a rotation vector (Rodrigues)."""
    x, y, z = r[0], r[1], r[2]
    square = x * x + y * y + z * z
    if square < 1e-8:  # the next terms are below 1e-17
        a, b = 1.0 - square / 6.0, 0.5 - square / 24.0
    else:
        angle = math.sqrt(square)
        a, b = math.sin(angle) / angle, (1.0 - math.cos(angle)) / square
    out[0, 0], out[0, 1], out[0, 2] = 1.0 - b * (y * y + z * z), b * x * y - a * z, b * x * z + a * y
    out[1, 0], out[1, 1], out[1, 2] = b * x * y + a * z, 1.0 - b * (x * x + z * z), b * y * z - a * x
    out[2, 0], out[2, 1], out[2, 2] = b * x * z - a * y, b * y * z + a * x, 1.0 - b * (x * x + y * y)


@inner
def log(R, out):  # type: ignore[no-untyped-def]
    """The rotation vector (3,) of a rotation matrix, its angle in [0, pi]."""
    x, y, z, w = quaternion(R)
    sine = math.sqrt(x * x + y * y + z * z)
    scale = 2.0 if sine < 1e-9 else 2.0 * math.atan2(sine, w) / sine
    out[0], out[1], out[2] = scale * x, scale * y, scale * z


@inner
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


@inner
def left_jacobian_inverse(r, out):  # type: ignore[no-untyped-def]
    """J (3, 3) with log(exp(d) @ exp(r)) = r + J @ d for a small d."""
    square = r[0] * r[0] + r[1] * r[1] + r[2] * r[2]
    if square < 1e-8:
        c = 1.0 / 12.0
    else:
        half = 0.5 * math.sqrt(square)
        c = (1.0 - half / math.tan(half)) / square
    for i in range(3):
        for j in range(3):  # the square of the skew matrix of r is r r' less its squared length
            out[i, j] = c * r[i] * r[j]
        out[i, i] += 1.0 - c * square
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        out[j, k] += 0.5 * r[i]
        out[k, j] -= 0.5 * r[i]


@inner
def swing(a, b, out):  # type: ignore[no-untyped-def]
    """The rotation vector (3,) of the shortest turn that takes the unit vector a (3,) to b (3,)."""
    cross(a, b, out)
    sine, cosine = math.sqrt(dot(out, out)), dot(a, b)
    scale = 1.0
    if sine >= 1e-9:
        scale = math.atan2(sine, cosine) / sine
    elif cosine < 0.0:  # opposite: half a turn about any axis across
        least = 0
        for i in range(1, 3):
            if abs(a[i]) < abs(a[least]):
                least = i
        j, k = (least + 1) % 3, (least + 2) % 3  # the cross product of a and the axis of its smallest entry
        out[least], out[j], out[k] = 0.0, a[k], -a[j]
        scale = math.pi / math.sqrt(dot(out, out))
    for i in range(3):
        out[i] *= scale


@inner
def orthonormalise(R):  # type: ignore[no-untyped-def]
    """One Newton step of R, in place, towards the nearest rotation: keeps rounding from piling up over a long run."""
    xx, xy, xz, yy, yz, zz = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0  # R.T @ R
    for i in range(3):
        x, y, z = R[i, 0], R[i, 1], R[i, 2]
        xx, xy, xz, yy, yz, zz = xx + x * x, xy + x * y, xz + x * z, yy + y * y, yz + y * z, zz + z * z
    for i in range(3):
        x, y, z = R[i, 0], R[i, 1], R[i, 2]
        R[i, 0] = 1.5 * x - 0.5 * (x * xx + y * xy + z * xz)
        R[i, 1] = 1.5 * y - 0.5 * (x * xy + y * yy + z * yz)
        R[i, 2] = 1.5 * z - 0.5 * (x * xz + y * yz + z * zz)
