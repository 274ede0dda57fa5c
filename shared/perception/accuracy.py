"""Error of a pose against the ground truth of an emulated cell."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from penumbra.shared.contract.messages import FusedPose, Truth
from penumbra.shared.geometry import rigid


@dataclass(frozen=True)
class Accuracy:
    """A fused pose with its errors of position [m] and limb axis [rad]; NaN where the truth is unknown."""

    pose: FusedPose
    position: float = math.nan
    axis: float = math.nan


def accuracy(pose: FusedPose, truths: Iterable[Truth]) -> Accuracy:
    """Error of a pose against the truth nearest in time, extrapolated to the pose's stamp with its velocity."""
    truth = min(truths, key=lambda truth: abs(truth.stamp_ns - pose.stamp_ns), default=None)
    if truth is None:
        return Accuracy(pose)
    elapsed_s = (pose.stamp_ns - truth.stamp_ns) * 1e-9
    T_true = rigid.perturb(rigid.transform(truth.position, truth.orientation), truth.velocity * elapsed_s)
    T = rigid.transform(pose.position, pose.orientation)
    return Accuracy(pose, float(np.linalg.norm(T_true[:3, 3] - T[:3, 3])), rigid.axis_angle_error(T_true, T))
