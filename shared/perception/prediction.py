"""Predicted pose of a target at the stamp of a measurement, from the last fused pose: the prior of vision and skin."""

from __future__ import annotations

import numpy as np

from penumbra.shared.contract.messages import FusedPose
from penumbra.shared.geometry import rigid
from penumbra.shared.geometry.rigid import Array
from penumbra.shared.perception.intrinsics import Intrinsics

LONGEST_S = 0.5
"""Maximum time [s] between a fused pose and the stamp of a prediction."""
UNKNOWN_SPEED = (0.3, 1.5)
"""Standard deviations of the error of a constant velocity, [m/s] and [rad/s], multiplied by the time bridged."""


def extrapolate(T: Array, velocity: Array, covariance: Array, dt_s: float) -> tuple[Array, Array]:
    """Pose and covariance (6, 6) after `dt_s` (may be negative) at constant `velocity` (6,) [m/s, rad/s]."""
    growth = np.repeat(UNKNOWN_SPEED, 3) * dt_s
    return rigid.perturb(T, velocity * dt_s), covariance + np.diag(growth**2)


def predict(fused: FusedPose | None, stamp_ns: int) -> tuple[Array, Array] | tuple[None, None]:
    """T_world_target and covariance at a stamp from the last fused pose; None, None where the pose is absent, lost or too old."""
    if fused is None or fused.state == "lost" or abs(stamp_ns - fused.stamp_ns) * 1e-9 > LONGEST_S:
        return None, None
    T = rigid.transform(fused.position, fused.orientation)
    return extrapolate(T, fused.velocity, fused.covariance, (stamp_ns - fused.stamp_ns) * 1e-9)


def deviation(points: Array, origin: Array, covariance: Array, k: Intrinsics) -> tuple[float, float]:
    """Standard deviations [px] in x and y of a body in a picture, as root mean squares over its points (n, 3) [m] in the camera's
    frame, from the covariance (6, 6) of its pose (rotations about its origin (3,)) along the camera's axes."""
    X, Y, Z = points.T
    zero = np.zeros_like(Z)
    out = []
    for by_point in (np.column_stack([k.fx / Z, zero, -k.fx * X / Z**2]), np.column_stack([zero, k.fy / Z, -k.fy * Y / Z**2])):
        by_pose = np.hstack([by_point, np.cross(points - origin, by_point)])
        out.append(float(np.sqrt(np.mean(np.sum((by_pose @ covariance) * by_pose, axis=1)))))
    return out[0], out[1]
