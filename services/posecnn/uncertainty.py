"""How far off a pose may be, learned from held-out pictures: standard deviations as functions of what the network saw.

Errors are split along the directions in which they are about independent: along the ray to the target (relative to its
distance), across it (relative to the target's length), and the rotation about three axes: the turn of the limb as it is seen, its
tilt towards the camera, which changes little of what is seen, and its roll. The logarithm of each deviation is linear in features
of the estimate; its coefficients are those of the greatest likelihood under normal errors.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from penumbra.services.posecnn.patch import facing
from penumbra.shared.geometry import rigid
from penumbra.shared.geometry.rigid import Array

KINDS = ("depth", "lateral", "turn", "tilt", "roll")
"""Depth by the distance, lateral by the target's length, the others in radians."""
BOUNDS = {"depth": (0.01, 0.5), "lateral": (0.005, 1.0), "turn": (0.01, 1.0), "tilt": (0.02, 1.0), "roll": (0.05, 1.5)}
"""Bounds of the standard deviations: a few hundred pictures say nothing about smaller and larger ones."""
LENGTH_PX = 100.0
"""Apparent length [px] to which others are compared: there its logarithm is zero."""


@dataclass(frozen=True)
class Signs:
    """Signs of how good an estimate is. hidden: share of the target that is not seen; length_px: its apparent length in the
    image; spread [rad]: of the votes for its centre; share: of its pixels that agree with the vote."""

    hidden: float
    length_px: float
    spread: float
    share: float

    @property
    def features(self) -> Array:
        """(6,)."""
        hidden = min(max(self.hidden, 0.0), 1.0)
        size = np.log(max(self.length_px, 1.0) / LENGTH_PX)
        return np.array([1.0, hidden, hidden**4, min(size, 0.0), np.log(max(self.spread, 0.01) / 0.1), 1.0 - self.share])


@dataclass(frozen=True)
class Uncertainty:
    """coefficients: (6,) of the logarithm of each kind's standard deviation."""

    coefficients: dict[str, tuple[float, ...]]

    def deviations(self, signs: Signs) -> dict[str, float]:
        """The standard deviation of each kind."""
        features = signs.features
        return {kind: float(np.clip(np.exp(features @ np.array(self.coefficients[kind])), *BOUNDS[kind])) for kind in KINDS}

    def covariance(self, T: Array, length: float, signs: Signs) -> Array:
        """(6, 6) in the camera's frame of a pose T_camera_target of a target of this length [m]."""
        sigma = self.deviations(signs)
        distance, ray = float(np.linalg.norm(T[:3, 3])), facing(T[:3, 3])
        across, along = sigma["lateral"] * length, sigma["depth"] * distance
        position = ray @ np.diag(np.square([across, across, along])) @ ray.T
        axes = rotation_axes(T)
        rotation = axes @ np.diag(np.square([sigma["roll"], sigma["tilt"], sigma["turn"]])) @ axes.T
        covariance = np.zeros((6, 6))
        covariance[:3, :3], covariance[3:, 3:] = position, rotation
        return (covariance + covariance.T) / 2.0


def rotation_axes(T: Array) -> Array:
    """The axes (3, 3), as columns in the camera's frame, of the roll, tilt and turn of a limb along x at T_camera_target."""
    limb, ray = T[:3, 0], T[:3, 3] / np.linalg.norm(T[:3, 3])
    tilt = np.cross(limb, ray)
    if np.linalg.norm(tilt) < 1e-3:  # it points at the camera: turn and tilt are alike
        tilt = T[:3, 1]
    tilt = tilt / np.linalg.norm(tilt)
    return np.column_stack([limb, tilt, np.cross(tilt, limb)])


def errors(T_true: Array, T: Array, length: float) -> dict[str, Array]:
    """The errors of a pose T_camera_target by kind, in the kind's unit: two of lateral, one of every other."""
    error = rigid.pose_error(T_true, T)
    position = facing(T[:3, 3]).T @ error[:3]
    roll, tilt, turn = rotation_axes(T).T @ error[3:]
    return {
        "depth": position[2:] / np.linalg.norm(T[:3, 3]),
        "lateral": position[:2] / length,
        "turn": np.array([turn]),
        "tilt": np.array([tilt]),
        "roll": np.array([roll]),
    }


def fitted(signs: list[Signs], missed: list[dict[str, Array]]) -> Uncertainty:
    """The uncertainty under which errors (`errors`) are most probable, with a weak prior against steep coefficients. Outliers
    count in full: too large a covariance does less harm than too small a one."""
    from scipy.optimize import minimize  # here, because estimating needs none of it

    features = np.array([one.features for one in signs])
    coefficients = {}
    for kind in KINDS:
        squared = np.array([np.square(one[kind]) for one in missed])

        def cost(a: Array, squared: Array = squared) -> tuple[float, Array]:
            """The negative logarithm of the probability, which is convex, and its gradient (6,)."""
            z = squared.sum(axis=1) * np.exp(-2.0 * features @ a)
            n = squared.shape[1]
            value = np.sum(0.5 * z + n * (features @ a)) + 0.5 * np.sum(a[1:] ** 2)
            return float(value), features.T @ (n - z) + np.array([0.0, *a[1:]])

        start = np.array([0.5 * np.log(squared.mean()), *np.zeros(features.shape[1] - 1)])
        found = minimize(cost, start, jac=True, method="BFGS")
        coefficients[kind] = tuple(round(float(a), 4) for a in found.x)
    return Uncertainty(coefficients)
