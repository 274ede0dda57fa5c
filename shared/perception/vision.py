"""Result of a vision process for a target in a frame, and its message to fusion."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from penumbra.shared.contract.messages import VisionPose
from penumbra.shared.geometry import rigid

State = Literal["tracking", "occluded", "lost"]


@dataclass(frozen=True)
class VisionEstimate:
    """T_world_target, covariance (6, 6) along the world's axes, overlap and hidden share in [0, 1], state. The pose is based on
    the measurement alone. confidence: probability in [0, 1] that the pose is right, None if unknown."""

    T: NDArray[np.float64]
    covariance: NDArray[np.float64]
    overlap: float
    hidden: float
    state: State
    confidence: float | None = field(default=None, kw_only=True)

    def message(self, stamp_ns: int, target: str, camera: str, frame: str) -> VisionPose:
        """Message of the estimate for a frame exposed at a stamp."""
        position, orientation = rigid.position_orientation(self.T)
        return VisionPose(
            stamp_ns=stamp_ns,
            target=target,
            camera=camera,
            frame=frame,
            position=position,
            orientation=orientation,
            covariance=self.covariance,
            overlap=self.overlap,
            hidden=self.hidden,
            state=self.state,
            confidence=self.confidence,
        )
