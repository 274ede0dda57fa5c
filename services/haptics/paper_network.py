"""The paper's network (section "Haptic-based Pose Estimation"): joint angles and the pads' measures in, four fully connected
layers of 256 ReLU units, the target's pose out. Inference uses numpy alone.

The pose error is a function of the pose itself, as in the paper: R_c = f_c(x, theta), found by Gaussian-process regression over
the limb's pose relative to the nearest pad. The network's answer includes its training prior, a known broad Gaussian over the
cell. Only the evidence of the voltages is published: the prior's information is subtracted, and directions without remaining
information are unknown.
"""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from penumbra.services.haptics.paper_nearest import nearest_points
from penumbra.services.haptics.solve import peak
from penumbra.shared.cell import description as cells
from penumbra.shared.geometry.rigid import Array, perturb
from penumbra.shared.geometry.surface import Surface
from penumbra.shared.skin import response
from penumbra.shared.skin.layout import Skin

HEAD_ON = 1e-6
"""Sine of the angle between a limb's axis and the direction to the nearest pad, below which no side of the limb counts as
nearer."""


def features(
    skin: Skin, home: Array, signal: Array, variance: Array, T_world_pads: Array, joints: ArrayLike
) -> NDArray[np.float32]:
    """The network's input (..., f): per pad the nearest surface point, placed in the world by the robot's kinematics and
    relative to the middle of the training's poses [dm], and whether it feels anything at all; per electrode the compressed
    signal-to-noise ratio; sine and cosine per joint.

    signal, variance (..., n), infinite variance for electrodes to leave out; T_world_pads (..., p, 4, 4); joints (..., j) [rad].
    """
    points, _ = nearest_points(skin, signal, variance)
    placed = np.einsum("...pij,...pj->...pi", T_world_pads[..., :3, :3], points) + T_world_pads[..., :3, 3] - home[:3, 3]
    alive = np.maximum.reduceat(np.isfinite(variance), skin.first[:-1], axis=-1)
    joints = np.asarray(joints, dtype=float)
    ratio = np.arcsinh(signal / np.sqrt(variance)) / 2.0
    parts = [10.0 * placed.reshape(*signal.shape[:-1], -1), alive, ratio, np.sin(joints), np.cos(joints)]
    return np.concatenate([np.asarray(part, dtype=np.float32).reshape(*signal.shape[:-1], -1) for part in parts], axis=-1)


@dataclass(frozen=True)
class Relative:
    """Pose of a limb relative to the nearest pad. pose (4,): log gap [m], position along the limb [m], lateral offset of the limb
    from the electrode (0 straight above it, 1 sideways), and the slope of its axis against the pad; frame (3, 3): rows are unit
    vectors along the limb, across it, and away from the pad, in the world."""

    pose: Array
    frame: Array

    @staticmethod
    def of(skin: Skin, surface: Surface, T_world_pads: Array, used: NDArray[np.bool_], T: Array) -> Relative:
        """For electrodes in use (n,) and a target at T (4, 4)."""
        electrodes = skin.positions(T_world_pads)[used]
        distance, nearest, gradient = surface.nearest((electrodes - T[:3, 3]) @ T[:3, :3])
        k = int(np.argmin(distance))
        normal = T_world_pads[skin.pad_of[used][k], :3, 2]
        axial = T[:3, 0]
        away = -(T[:3, :3] @ gradient[k])
        if np.linalg.norm(np.cross(away, axial)) < HEAD_ON:
            away = np.eye(3)[np.argmin(np.abs(axial))]
        away -= (away @ axial) * axial
        away /= np.linalg.norm(away)
        pose = np.array(
            [np.log(max(distance[k], 0.003)), nearest[k, 0], 1.0 - abs(float(away @ normal)), abs(float(axial @ normal))]
        )
        return Relative(pose, np.stack([axial, np.cross(away, axial), away]))


@dataclass(frozen=True)
class Regression:
    """A Gaussian process for each component of R_c: logs of the variances along, across, away [m^2], and about across and away
    [rad^2]. points (k, 4): the training's relative poses; lengths (5, 4) and amplitudes (5,) of the kernels; weights (k, 5);
    means (5,)."""

    points: Array
    lengths: Array
    amplitudes: Array
    weights: Array
    means: Array

    def variances(self, pose: Array) -> Array:
        """Variances (5,) at a relative pose (4,)."""
        apart = (self.points[:, None] - pose) / self.lengths
        kernels = self.amplitudes * np.exp(-0.5 * np.sum(apart**2, axis=-1))
        return np.exp(self.means + np.sum(kernels * self.weights, axis=0))


@dataclass(frozen=True)
class PoseNetwork:
    """Weights and biases of five layers (four hidden); the training prior: home (4, 4) and spread (6,) of the pose error about
    it; and R_c."""

    weights: tuple[NDArray[np.float32], ...]
    biases: tuple[NDArray[np.float32], ...]
    home: Array
    spread: Array
    regression: Regression

    def mean(self, x: NDArray[np.float32]) -> Array:
        """Mean (6,) of the pose error about home, in units of `spread`, for one input (f,)."""
        for W, b in zip(self.weights[:-1], self.biases[:-1], strict=True):
            x = np.maximum(x @ W + b, 0.0)
        return np.asarray(x @ self.weights[-1] + self.biases[-1], dtype=np.float64)

    def posterior(self, x: NDArray[np.float32]) -> Array:
        """The network's most probable T_world_target, prior included: a start for a solve."""
        return perturb(self.home, self.spread * self.mean(x))

    def covariance(self, relative: Relative) -> Array:
        """R_c (6, 6) of the pose error of `posterior`, about `geometry.perturb`; the roll's variance is the prior's."""
        frame = np.zeros((6, 6))
        frame[:3, :3] = frame[3:, 3:] = relative.frame
        along, across, away, pitch, yaw = self.regression.variances(relative.pose)
        roll = float(np.mean(self.spread[3:] ** 2))
        return np.asarray(frame.T @ np.diag([along, across, away, roll, pitch, yaw]) @ frame)

    def likelihood(self, x: NDArray[np.float32], relative: Relative) -> tuple[Array, Array]:
        """T_world_target where the evidence alone peaks, and its information (6, 6) about `geometry.perturb`: R_c's inverse less
        the prior's, clipped to be positive."""
        mean = self.mean(x)
        # d(pose error at the mean) / d(pose error about home): the left Jacobian of the rotation
        A = np.eye(6)
        A[3:, 3:] = _left_jacobian(self.spread[3:] * mean[3:])
        to_units = np.linalg.inv(A) / self.spread[:, None]
        information = np.linalg.inv(self.covariance(relative)) - to_units.T @ to_units
        return peak(perturb(self.home, self.spread * mean), information, to_units.T @ mean)


def _left_jacobian(rotation: Array) -> Array:
    """d log(exp(r + dr) exp(-r)) / dr of a rotation vector r (3,)."""
    angle = float(np.linalg.norm(rotation))
    if angle < 1e-6:
        return np.eye(3)
    axis = rotation / angle
    K = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    sine = np.sin(angle) / angle
    return sine * np.eye(3) + (1.0 - sine) * np.outer(axis, axis) + (1.0 - np.cos(angle)) / angle * K


def fingerprint(cell: cells.Cell, target: str) -> str:
    """Hash of everything that a network depends on: the pads' responses and poses, robots and body. Another cell needs another
    training; a new calibration or another source of joint angles does not."""
    parts = {
        "pads": {
            name: [response.fingerprint(cell, name, target), pad.link, pad.position, pad.rpy] for name, pad in cell.pads.items()
        },
        "robots": {name: robot.model_dump(exclude={"source"}) for name, robot in cell.robots.items()},
    }
    return hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()[:16]


def load(path: Path, cell: cells.Cell, target: str) -> PoseNetwork:
    """Load the network from an .npz of `penumbra haptics train`. Raises ValueError if it was trained for another cell,
    FileNotFoundError if there is none."""
    with np.load(path) as data:
        trained_for = str(data["fingerprint"])
        if trained_for != fingerprint(cell, target):
            raise ValueError(
                f"{path}: expected weights for target {target} of this cell ({fingerprint(cell, target)}), got weights for "
                f"another description of it ({trained_for}); run `penumbra haptics train --cell {cell.name}`"
            )
        count = sum(name.startswith("weight") for name in data.files)
        weights = tuple(data[f"weight{i}"].astype(np.float32) for i in range(count))
        biases = tuple(data[f"bias{i}"].astype(np.float32) for i in range(count))
        names = ("points", "lengths", "amplitudes", "kernel_weights", "means")
        regression = Regression(*(data[name].astype(np.float64) for name in names))
        return PoseNetwork(weights, biases, data["home"], data["spread"], regression)
