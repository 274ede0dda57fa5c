"""Rigid-body geometry in the project's conventions.

A transform `T_a_b` is a 4 x 4 float64 matrix that maps coordinates in frame b to frame a. Quaternions are (x, y, z, w).
A pose error is a 6-vector (translation, rotation vector), both along the axes of the fixed frame: `T_true = perturb(T, error)`
adds the translation and applies the rotation from the left. Covariances (6 x 6) have the same order, as in ROS.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]


def transform(position: ArrayLike, orientation: ArrayLike = (0.0, 0.0, 0.0, 1.0)) -> Array:
    """The 4 x 4 transform of a position [m] (3,) and a unit quaternion (4,)."""
    T = np.eye(4)
    T[:3, :3] = _from_quaternion(orientation)
    T[:3, 3] = position
    return T


def from_rpy(position: ArrayLike, rpy: ArrayLike) -> Array:
    """The 4 x 4 transform of a position [m] (3,) and roll, pitch, yaw [rad] (3,) about the fixed x, y, z axes."""
    T = np.eye(4)
    roll, pitch, yaw = np.asarray(rpy, float).tolist()
    T[:3, :3] = rotation((0.0, 0.0, yaw)) @ rotation((0.0, pitch, 0.0)) @ rotation((roll, 0.0, 0.0))
    T[:3, 3] = position
    return T


def position_orientation(T: Array) -> tuple[Array, Array]:
    """Position [m] (3,) and unit quaternion (4,) with w >= 0 of a transform."""
    return T[:3, 3].copy(), np.array(_quaternion(T[:3, :3]))


def rpy(orientation: ArrayLike) -> Array:
    """Roll, pitch, yaw [rad] (3,) about the fixed x, y, z axes of a quaternion (4,). The pitch is within a quarter turn. At its
    limits only the sum or the difference of roll and yaw is defined; there the yaw is zero."""
    (a, b, _), (d, e, _), (g, h, i) = _from_quaternion(orientation).tolist()
    cosine = math.hypot(a, d)
    pitch = math.atan2(-g, cosine)
    if cosine < 1e-7:
        return np.array([math.atan2(b if g < 0.0 else -b, e), pitch, 0.0])
    return np.array([math.atan2(h, i), pitch, math.atan2(d, a)])


def inverse(T: Array) -> Array:
    """The inverse of a rigid transform."""
    R = T[:3, :3].T
    out = np.eye(4)
    out[:3, :3] = R
    out[:3, 3] = -R @ T[:3, 3]
    return out


def apply(T: Array, points: ArrayLike) -> Array:
    """Transforms points (..., 3) from frame b to frame a by T = T_a_b."""
    return np.asarray(points) @ T[:3, :3].T + T[:3, 3]


def perturb(T: Array, error: ArrayLike) -> Array:
    """Applies a pose error (6,) to T: adds the translation [m] and applies the rotation vector [rad] from the left (fixed
    axes)."""
    error = np.asarray(error, dtype=float)
    out = T.copy()
    out[:3, :3] = rotation(error[3:]) @ T[:3, :3]
    out[:3, 3] += error[:3]
    return out


def pose_error(T_true: Array, T: Array) -> Array:
    """Pose error (6,) for which `perturb(T, error) == T_true`."""
    offset = T_true[:3, 3] - T[:3, 3]
    return np.array([*offset.tolist(), *_rotation_vector(T_true[:3, :3] @ T[:3, :3].T)])


def rotation(vector: ArrayLike) -> Array:
    """The rotation matrix of a rotation vector (3,) [rad] (Rodrigues)."""
    x, y, z = np.asarray(vector, float).tolist()
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


def _rotation_vector(R: Array) -> tuple[float, float, float]:
    """The rotation vector [rad] of a rotation matrix (3, 3)."""
    x, y, z, w = _quaternion(R)
    sine = math.sqrt(x * x + y * y + z * z)
    scale = 2.0 * math.atan2(sine, w) / sine if sine > 1e-9 else 2.0
    return scale * x, scale * y, scale * z


def _from_quaternion(orientation: ArrayLike) -> Array:
    """Rotation matrix (3, 3) of a quaternion (4,) of any non-zero length. Raises ValueError for zero."""
    x, y, z, w = np.asarray(orientation, float).tolist()
    square = x * x + y * y + z * z + w * w
    if not square > 0.0:
        raise ValueError(f"orientation: expected a unit quaternion (x, y, z, w), got ({x}, {y}, {z}, {w})")
    s = 2.0 / square
    return np.array(
        [
            [1.0 - s * (y * y + z * z), s * (x * y - z * w), s * (x * z + y * w)],
            [s * (x * y + z * w), 1.0 - s * (x * x + z * z), s * (y * z - x * w)],
            [s * (x * z - y * w), s * (y * z + x * w), 1.0 - s * (x * x + y * y)],
        ]
    )


def _quaternion(R: Array) -> tuple[float, float, float, float]:
    """Unit quaternion with w >= 0 of a rotation matrix (3, 3). It is computed from its largest component, by which the others are
    divided (Shepperd 1978, doi:10.2514/3.55767b)."""
    (a, b, c), (d, e, f), (g, h, i) = R.tolist()
    w = a + e + i
    greatest = max(a, e, i, w)
    if greatest == w:
        x, y, z, w = h - f, c - g, d - b, 1.0 + w
    elif greatest == a:
        x, y, z, w = 1.0 + a - e - i, b + d, c + g, h - f
    elif greatest == e:
        x, y, z, w = b + d, 1.0 - a + e - i, f + h, c - g
    else:
        x, y, z, w = c + g, f + h, 1.0 - a - e + i, d - b
    length = math.copysign(math.sqrt(x * x + y * y + z * z + w * w), w)
    return x / length, y / length, z / length, w / length


def axis_angle_error(T_true: Array, T: Array, axis: int = 0) -> float:
    """Angle [rad] between the same body axis (0, 1, 2) of two poses. For a limb along x this is its orientation error without
    roll."""
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
