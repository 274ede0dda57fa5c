"""The paper's network (section "Haptic-based Pose Estimation"): joint angles and the pads' measures in, four fully connected
layers of 256 ReLU units, the target's pose out. Inference on numpy alone.

Where the paper's network gives a pose, this one gives a Gaussian: mean and Cholesky factor of the precision, trained by its
likelihood, so that it can say which directions the skin does not show. It answers for the poses it was trained on, a known
broad Gaussian over the cell. What is published is the evidence of the voltages alone: that prior's information
is subtracted again, and directions where nothing remains are unknown.
"""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from services.haptics.nearest import nearest_points
from services.haptics.solve import peak
from shared import cell as cells
from shared.geometry import Array, perturb
from shared.skin import Skin

OUTPUTS = 6 + 21
_ROWS, _COLUMNS = np.tril_indices(6)
_DIAGONAL = _ROWS == _COLUMNS
LOG_LIMIT = 8.0
"""Largest log of a precision factor in units of the prior: 3000 times better than beforehand."""


def features(
    skin: Skin, home: Array, amplitude: Array, variance: Array, alive: NDArray[np.bool_], T_world_pads: Array, joints: ArrayLike
) -> NDArray[np.float32]:
    """The network's input (..., f): per pad the nearest surface point, placed in the world by the robot's kinematics and
    relative to the middle of the training's poses [dm], and whether it is alive; per electrode the compressed
    signal-to-noise ratio; sine and cosine per joint.

    amplitude, variance (..., n); alive (..., p); T_world_pads (..., p, 4, 4); joints (..., j) [rad].
    """
    points, _ = nearest_points(skin, amplitude, variance, alive)
    placed = np.einsum("...pij,...pj->...pi", T_world_pads[..., :3, :3], points) + T_world_pads[..., :3, 3] - home[:3, 3]
    ratio = np.where(alive[..., skin.pad_of], skin.signal(amplitude) / np.sqrt(variance), 0.0)
    joints = np.asarray(joints, dtype=float)
    shape = amplitude.shape[:-1]
    parts = [10.0 * placed.reshape(*shape, -1), alive, np.arcsinh(ratio) / 2.0, np.sin(joints), np.cos(joints)]
    return np.concatenate([np.asarray(part, dtype=np.float32).reshape(*shape, -1) for part in parts], axis=-1)


@dataclass(frozen=True)
class PoseNetwork:
    """Weights and biases of five layers (four hidden), and the prior that it was trained with: home (4, 4), spread
    (6,) of the pose error about it."""

    weights: tuple[NDArray[np.float32], ...]
    biases: tuple[NDArray[np.float32], ...]
    home: Array
    spread: Array

    def gaussian(self, x: NDArray[np.float32]) -> tuple[Array, Array]:
        """Mean (6,) and precision (6, 6) of the pose error about home, in units of `spread`, for one input (f,)."""
        for W, b in zip(self.weights[:-1], self.biases[:-1], strict=True):
            x = np.maximum(x @ W + b, 0.0)
        out = np.asarray(x @ self.weights[-1] + self.biases[-1], dtype=np.float64)
        L = np.zeros((6, 6))
        L[_ROWS, _COLUMNS] = np.where(_DIAGONAL, np.exp(np.minimum(out[6:], LOG_LIMIT)), out[6:])
        return out[:6], L @ L.T

    def posterior(self, x: NDArray[np.float32]) -> Array:
        """T_world_target that the network thinks most probable, prior included: where a solve may start."""
        return perturb(self.home, self.spread * self.gaussian(x)[0])

    def likelihood(self, x: NDArray[np.float32]) -> tuple[Array, Array]:
        """T_world_target where the evidence alone peaks, and its information (6, 6) about `geometry.perturb`: the network's
        precision less the prior's (which is one in its units), clipped to be positive."""
        mean, precision = self.gaussian(x)
        # d(pose error at the mean) / d(pose error about home): the left Jacobian of the rotation
        A = np.eye(6)
        A[3:, 3:] = _left_jacobian(self.spread[3:] * mean[3:])
        to_units = np.linalg.inv(A) / self.spread[:, None]
        information = to_units.T @ (precision - np.eye(6)) @ to_units
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
    """What a network was trained for: pads, robots and body. Another cell needs another training."""
    parts = {
        "pads": {name: pad.model_dump() for name, pad in cell.pads.items()},
        "types": {name: kind.model_dump() for name, kind in cell.pad_types.items()},
        "robots": {name: robot.model_dump() for name, robot in cell.robots.items()},
        "mesh": cell.targets[target].mesh,
        "body": cell.body.model_dump(),
    }
    return hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()[:16]


def load(path: Path, cell: cells.Cell, target: str) -> PoseNetwork:
    """The network in an .npz that `penumbra haptics train` wrote. Raises ValueError where it was trained for another cell,
    FileNotFoundError where there is none."""
    with np.load(path) as data:
        trained_for = str(data["fingerprint"])
        if trained_for != fingerprint(cell, target):
            raise ValueError(
                f"{path}: weights for target {target} of this cell ({fingerprint(cell, target)}) expected, they belong to "
                f"another description of it ({trained_for}): run `penumbra haptics train --cell {cell.name}`"
            )
        count = sum(name.startswith("weight") for name in data.files)
        weights = tuple(data[f"weight{i}"].astype(np.float32) for i in range(count))
        biases = tuple(data[f"bias{i}"].astype(np.float32) for i in range(count))
        return PoseNetwork(weights, biases, data["home"], data["spread"])
