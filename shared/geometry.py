"""Rigid-body geometry in the house's conventions.

A transform `T_a_b` is a 4 x 4 float64 matrix that maps coordinates in frame b to frame a. Quaternions are (x, y, z, w).
A pose error is a 6-vector (translation, rotation vector), both along the axes of the fixed frame: `T_true = perturb(T, error)`
adds the translation and applies the rotation from the left. Covariances (6 x 6) have the same order, as in ROS.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

Array = NDArray[np.float64]


def transform(position: ArrayLike, orientation: ArrayLike = (0.0, 0.0, 0.0, 1.0)) -> Array:
    """The 4 x 4 transform of a position [m] (3,) and a unit quaternion (4,)."""
    T = np.eye(4)
    T[:3, :3] = Rotation.from_quat(orientation).as_matrix()
    T[:3, 3] = position
    return T


def from_rpy(position: ArrayLike, rpy: ArrayLike) -> Array:
    """The 4 x 4 transform of a position [m] (3,) and roll, pitch, yaw [rad] (3,) about the fixed x, y, z axes."""
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler("xyz", rpy).as_matrix()
    T[:3, 3] = position
    return T


def position_orientation(T: Array) -> tuple[Array, Array]:
    """Position [m] (3,) and unit quaternion (4,) with w >= 0 of a transform."""
    return T[:3, 3].copy(), Rotation.from_matrix(T[:3, :3]).as_quat(canonical=True)


def rpy(orientation: ArrayLike) -> Array:
    """Roll, pitch, yaw [rad] (3,) about the fixed x, y, z axes of a quaternion (4,)."""
    return Rotation.from_quat(orientation).as_euler("xyz")


def inverse(T: Array) -> Array:
    """The inverse of a rigid transform."""
    R = T[:3, :3].T
    out = np.eye(4)
    out[:3, :3] = R
    out[:3, 3] = -R @ T[:3, 3]
    return out


def apply(T: Array, points: ArrayLike) -> Array:
    """Points (..., 3) of frame b in frame a, for T_a_b."""
    return np.asarray(points) @ T[:3, :3].T + T[:3, 3]


def perturb(T: Array, error: ArrayLike) -> Array:
    """T moved by a pose error (6,): translation [m] added, rotation vector [rad] applied from the left (fixed axes)."""
    error = np.asarray(error, dtype=float)
    out = T.copy()
    out[:3, :3] = _rotation(error[3:]) @ T[:3, :3]
    out[:3, 3] += error[:3]
    return out


def pose_error(T_true: Array, T: Array) -> Array:
    """The error (6,) with `perturb(T, error) == T_true`."""
    return np.concatenate([T_true[:3, 3] - T[:3, 3], _rotation_vector(T_true[:3, :3] @ T[:3, :3].T)])


def _rotation(vector: Array) -> Array:
    """The rotation matrix of a rotation vector (3,) [rad] (Rodrigues). A search calls it thousands of times a second, and
    it takes a tenth of what scipy's does."""
    x, y, z = vector.tolist()
    square = x * x + y * y + z * z
    angle = math.sqrt(square)
    a, b = (
        (math.sin(angle) / angle, (1.0 - math.cos(angle)) / square) if angle > 1e-4 else (1.0 - square / 6.0, 0.5 - square / 24.0)
    )
    return np.array(
        [
            [1.0 - b * (y * y + z * z), b * x * y - a * z, b * x * z + a * y],
            [b * x * y + a * z, 1.0 - b * (x * x + z * z), b * y * z - a * x],
            [b * x * z - a * y, b * y * z + a * x, 1.0 - b * (x * x + y * y)],
        ]
    )


def _rotation_vector(R: Array) -> Array:
    """The rotation vector (3,) [rad] of a rotation matrix; near a half turn, where the formula is ill conditioned, by scipy."""
    (a, b, c), (d, e, f), (g, h, i) = R.tolist()
    x, y, z = h - f, c - g, d - b  # twice the axis times the sine
    sine, cosine = 0.5 * math.sqrt(x * x + y * y + z * z), 0.5 * (a + e + i - 1.0)
    angle = math.atan2(sine, cosine)
    if angle > 3.0:
        return Rotation.from_matrix(R).as_rotvec()
    scale = 0.5 * angle / sine if sine > 1e-6 else 0.5
    return np.array([scale * x, scale * y, scale * z])


def axis_angle_error(T_true: Array, T: Array, axis: int = 0) -> float:
    """The angle [rad] between the same body axis (0, 1, 2) of two poses: for a limb along x, its error without the roll."""
    return float(np.arccos(np.clip(T_true[:3, axis] @ T[:3, axis], -1.0, 1.0)))


def look_at(eye: ArrayLike, point: ArrayLike, up: ArrayLike = (0.0, 0.0, 1.0)) -> Array:
    """T_world_camera of a camera at `eye` that looks at `point` (OpenCV axes: x right, y down, z forward)."""
    eye, point = np.asarray(eye, float), np.asarray(point, float)
    z = (point - eye) / np.linalg.norm(point - eye)
    x = np.cross(z, np.asarray(up, float))
    x /= np.linalg.norm(x)
    T = np.eye(4)
    T[:3, :3] = np.column_stack([x, np.cross(z, x), z])
    T[:3, 3] = eye
    return T
