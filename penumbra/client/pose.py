"""The pose of a target, as the client returns it."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal, cast

import numpy as np

from penumbra.shared.contract.messages import FusedPose, Source
from penumbra.shared.geometry import rigid
from penumbra.shared.geometry.rigid import Array

State = Literal["tracking", "coasting", "lost"]
"""`tracking`: a sense measures the target, and three standard deviations of its position are within the `tracking_bound` of the
cell file. `coasting`: no sense measures the target now, the newest measurement contradicts the pose, a camera that saw the
target until recently does not see it there, or the pose is less certain than that bound. `lost`: the pose is unknown."""


@dataclass(frozen=True, eq=False)
class Pose:
    """Pose and motion of a target at one moment. All arrays are float64 and read-only.

    Attributes:
        target: Name of the target.
        frame: Name of the fixed frame of all quantities.
        stamp_ns: The time of the pose, in nanoseconds since the epoch.
        state: `tracking`, `coasting` or `lost`. Do not use the numbers of a lost pose: they are the target's home
            or an extrapolation.
        T: (4, 4), T_frame_target: maps coordinates of the target to the frame [m].
        orientation: (4,), the same rotation as a unit quaternion x, y, z, w.
        velocity: (6,), linear [m/s] and angular [rad/s], along the axes of the frame.
        covariance: (6, 6), in the order x, y, z [m], rotation about x, y, z of the frame [rad], as in ROS.
        sources: For each sense (`vision`, `haptic`) the age of its last measurement and its share of the information.
    """

    target: str
    frame: str
    stamp_ns: int
    state: State
    T: Array
    orientation: Array
    velocity: Array
    covariance: Array
    sources: Mapping[str, Source]

    @property
    def position(self) -> Array:
        """Position (3,) of the target's origin in the frame [m]."""
        return self.T[:3, 3]

    @property
    def rpy(self) -> Array:
        """Roll, pitch, yaw (3,) [rad] about the fixed x, y, z axes of the frame."""
        return rigid.rpy(self.orientation)

    @property
    def sigma(self) -> Array:
        """Standard deviations (6,) [m, rad]: the square roots of the covariance's diagonal."""
        return cast(Array, np.sqrt(np.maximum(self.covariance.diagonal(), 0.0)))

    @property
    def age_s(self) -> float:
        """Time since the stamp [s] by this machine's clock."""
        return (time.time_ns() - self.stamp_ns) * 1e-9

    def __str__(self) -> str:
        x, y, z = self.position
        spread = self.sigma[:3].max()
        return f"{self.target} {self.state} at [{x:.4f} {y:.4f} {z:.4f}] m, sigma {spread:.4f} m, {1e3 * self.age_s:.0f} ms old"

    @classmethod
    def of(cls, message: FusedPose) -> Pose:
        """The pose in a message."""
        T = rigid.transform(message.position, message.orientation)
        T.flags.writeable = False
        return cls(
            target=message.target,
            frame=message.frame,
            stamp_ns=message.stamp_ns,
            state=message.state,
            T=T,
            orientation=message.orientation,
            velocity=message.velocity,
            covariance=message.covariance,
            sources=message.sources,
        )
