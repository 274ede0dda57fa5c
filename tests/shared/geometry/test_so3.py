"""Rotations and small matrices, compiled."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from penumbra.shared.geometry import rigid, so3
from penumbra.shared.geometry.rigid import Array


def exp(r: Array) -> Array:
    """What `so3.exp` writes."""
    out = np.empty((3, 3))
    so3.exp(r, out)
    return out


def log(R: Array) -> Array:
    """What `so3.log` writes."""
    out = np.empty(3)
    so3.log(R, out)
    return out


@pytest.mark.parametrize("angle", [0.0, 1e-12, 1e-7, 9.9e-5, 1.01e-4, 0.5, 3.0, np.pi - 1e-7, np.pi - 1e-12, np.pi])
def test_exp_log_and_quaternion_agree_with_scipy_also_near_zero_and_pi(angle: float) -> None:
    rng = np.random.default_rng(0)
    for axis in [*np.eye(3), *-np.eye(3), *rng.normal(size=(20, 3))]:
        r = angle * axis / np.linalg.norm(axis)
        R = Rotation.from_rotvec(r).as_matrix()
        np.testing.assert_allclose(exp(r), R, atol=1e-14)
        np.testing.assert_allclose(rigid.rotation(r), R, atol=1e-14)
        found = log(exp(r))
        # at pi both signs are the same rotation
        np.testing.assert_allclose(exp(found), R, atol=1e-12)
        if angle < 3.1:
            np.testing.assert_allclose(found, r, atol=1e-14, rtol=1e-9)
        assert abs(np.dot(so3.quaternion(R), Rotation.from_matrix(R).as_quat())) == pytest.approx(1.0, abs=1e-14)


@pytest.mark.parametrize("angle", [0.0, 1e-5, 1.01e-4, 1.0, 3.0])
def test_left_jacobian_inverse_is_the_derivative_of_log(angle: float) -> None:
    r = angle * np.array([0.6, 0.0, 0.8])
    step = 1e-6
    columns = [(log(exp(d) @ exp(r)) - log(exp(-d) @ exp(r))) / (2 * step) for d in step * np.eye(3)]
    found = np.empty((3, 3))
    so3.left_jacobian_inverse(r, found)
    np.testing.assert_allclose(found, np.column_stack(columns), atol=1e-8)


def test_a_swing_takes_one_direction_to_another_the_short_way_also_to_its_opposite() -> None:
    rng = np.random.default_rng(0)
    for a, b in [*rng.normal(size=(20, 2, 3)), *((axis, sign * axis) for axis in np.eye(3) for sign in (1.0, -1.0))]:
        a, b = a / np.linalg.norm(a), b / np.linalg.norm(b)
        found = np.empty(3)
        so3.swing(a, b, found)
        np.testing.assert_allclose(exp(found) @ a, b, atol=1e-12)
        assert np.linalg.norm(found) == pytest.approx(np.arccos(np.clip(a @ b, -1.0, 1.0)), abs=1e-7)


@pytest.mark.parametrize("n", [1, 2, 3, 5, 6])
def test_eigenvalues_and_eigenvectors_are_those_of_lapack_also_of_matrices_without_full_rank(n: int) -> None:
    rng = np.random.default_rng(n)
    for rank in range(n + 1):
        root = rng.normal(size=(n, rank)) * 10.0 ** rng.uniform(-4.0, 4.0, (n, 1))
        A = root @ root.T
        found, vectors = np.full((6, 6), np.nan), np.full((6, 6), np.nan)
        found[:n, :n] = A
        so3.eigen(found, n, vectors)
        values, vectors, size = np.diag(found)[:n], vectors[:n, :n], max(float(np.abs(A).max()), 1e-300)
        np.testing.assert_allclose(values, np.linalg.eigvalsh(A), atol=1e-13 * size)
        np.testing.assert_allclose(vectors.T @ vectors, np.eye(n), atol=1e-13)
        np.testing.assert_allclose(vectors * values @ vectors.T, A, atol=1e-13 * size)
