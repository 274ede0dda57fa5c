"""What is known before the mask is looked at: where the target should be, and where the robot's joints were."""

from __future__ import annotations

from collections import deque

import numpy as np
from numpy.typing import NDArray

from shared import geometry
from shared.messages import FusedPose

Array = NDArray[np.float64]

LONGEST_S = 1.0
"""A fused pose further away in time than this predicts nothing."""
UNKNOWN_SPEED = (0.3, 1.5)
"""Standard deviations of what a constant velocity misses, [m/s] and [rad/s], grown over the time bridged."""


def extrapolate(T: Array, velocity: Array, covariance: Array, dt_s: float) -> tuple[Array, Array]:
    """Pose and covariance (6, 6) after `dt_s` (may be negative) at constant `velocity` (6,) [m/s, rad/s]."""
    growth = np.repeat(UNKNOWN_SPEED, 3) * dt_s
    return geometry.perturb(T, velocity * dt_s), covariance + np.diag(growth**2)


def predict(fused: FusedPose | None, stamp_ns: int) -> tuple[Array, Array] | tuple[None, None]:
    """T_world_target and covariance at a stamp by the last fused pose; None, None where it is absent, lost or too old."""
    if fused is None or fused.state == "lost" or abs(stamp_ns - fused.stamp_ns) * 1e-9 > LONGEST_S:
        return None, None
    T = geometry.transform(fused.position, fused.orientation)
    return extrapolate(T, fused.velocity, fused.covariance, (stamp_ns - fused.stamp_ns) * 1e-9)


class JointHistory:
    """The last joint angles of one robot, to be read at the stamp of a frame."""

    def __init__(self, size: int = 256):
        self._samples: deque[tuple[int, Array]] = deque(maxlen=size)

    def add(self, stamp_ns: int, q: Array) -> None:
        """Keeps the joints q (n,) of a stamp; one that is not newer than the last is left out."""
        if not self._samples or stamp_ns > self._samples[-1][0]:
            self._samples.append((stamp_ns, q))

    def at(self, stamp_ns: int, reach_s: float = 0.2) -> Array | None:
        """Joints (n,) at a stamp, interpolated, or the nearest sample's; None where none is within `reach_s`."""
        samples = list(self._samples)
        if not samples:
            return None
        stamps = np.array([stamp for stamp, _ in samples], np.int64)
        right = int(np.searchsorted(stamps, stamp_ns))
        if 0 < right < len(samples):
            (t0, q0), (t1, q1) = samples[right - 1], samples[right]
            if (t1 - t0) * 1e-9 <= reach_s and q0.shape == q1.shape:
                return q0 + (q1 - q0) * ((stamp_ns - t0) / (t1 - t0))
        nearest = samples[int(np.argmin(np.abs(stamps - stamp_ns)))]
        return nearest[1] if abs(nearest[0] - stamp_ns) * 1e-9 <= reach_s else None
