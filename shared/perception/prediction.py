"""Where a target should be at the stamp of a measurement, by the last fused pose: what vision and skin know before they look."""

from __future__ import annotations

import numpy as np

from penumbra.shared.contract.messages import FusedPose
from penumbra.shared.geometry import rigid
from penumbra.shared.geometry.rigid import Array

LONGEST_S = 0.5
"""A fused pose further away in time than this predicts nothing."""
UNKNOWN_SPEED = (0.3, 1.5)
"""Standard deviations of what a constant velocity misses, [m/s] and [rad/s], grown over the time bridged."""


def extrapolate(T: Array, velocity: Array, covariance: Array, dt_s: float) -> tuple[Array, Array]:
    """Pose and covariance (6, 6) after `dt_s` (may be negative) at constant `velocity` (6,) [m/s, rad/s]."""
    growth = np.repeat(UNKNOWN_SPEED, 3) * dt_s
    return rigid.perturb(T, velocity * dt_s), covariance + np.diag(growth**2)


def predict(fused: FusedPose | None, stamp_ns: int) -> tuple[Array, Array] | tuple[None, None]:
    """T_world_target and covariance at a stamp by the last fused pose; None, None where it is absent, lost or too old."""
    if fused is None or fused.state == "lost" or abs(stamp_ns - fused.stamp_ns) * 1e-9 > LONGEST_S:
        return None, None
    T = rigid.transform(fused.position, fused.orientation)
    return extrapolate(T, fused.velocity, fused.covariance, (stamp_ns - fused.stamp_ns) * 1e-9)
