"""Where the rest of a person is, given the forearm."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from penumbra.shared.cell import description as cells
from penumbra.shared.geometry import rigid
from penumbra.shared.geometry.rigid import Array

RISES = np.radians(60.0)
"""Angle [rad] by which the upper arm rises behind a forearm at home where no shoulder is given: that of a person at a table."""

ASSUMED, STATED = 0.15, 0.05
"""Standard deviation [m] along each axis of where the shoulder is, without and with a shoulder in the cell file."""


@dataclass(frozen=True)
class Posture:
    """The person behind a forearm. elbow, upper_arm: the elbow's distance behind the target's origin, and the length of the upper
    arm [m]; shoulder (3,): where the shoulder would be if the arm were long enough [m]; R_world_torso (3, 3); spread: standard
    deviation [m] of the shoulder's place along each axis."""

    elbow: float
    upper_arm: float
    shoulder: Array
    R_world_torso: Array
    spread: float = 0.0

    @classmethod
    def usual(cls, cell: cells.Cell, target: cells.Target) -> Posture | None:
        """The posture of somebody of whom only the cell file is known: the shoulder is where the file says, or above and behind
        the elbow at home. None for a target that is not the parametric forearm."""
        if target.mesh != "body:forearm":
            return None
        if target.shoulder is not None:
            return replace(cls.of(cell, target, np.array(target.shoulder)), spread=STATED)
        home, own = target.home.transform, cls.of(cell, target, np.zeros(3))
        behind = np.array([*-home[:2, 0], 0.0])
        behind /= max(float(np.linalg.norm(behind)), 1e-9)
        rises = np.cos(RISES) * behind + np.sin(RISES) * np.array([0.0, 0.0, 1.0])
        return replace(own, shoulder=home[:3, 3] - own.elbow * home[:3, 0] + own.upper_arm * rises, spread=ASSUMED)

    @classmethod
    def of(cls, cell: cells.Cell, target: cells.Target, shoulder: Array) -> Posture:
        """The posture of a cell's person, who faces along the forearm at home."""
        elbow = (target.size.length if target.size else 1.0) * cell.body.forearm_length / 2.0
        R = rigid.from_rpy((0.0, 0.0, 0.0), (0.0, 0.0, target.home.rpy[2]))[:3, :3]
        return cls(elbow, cell.body.upper_arm_length, np.asarray(shoulder, float), R)

    @property
    def numbers(self) -> Array:
        """All numbers (14,), for kernels: shoulder, R_world_torso, elbow, upper_arm."""
        return np.array([*self.shoulder, *self.R_world_torso.ravel(), self.elbow, self.upper_arm], np.float64)

    def poses(self, T_world_target: Array) -> list[Array]:
        """T_world_part (..., 4, 4) of upper arm and torso for T_world_target (..., 4, 4): the upper arm runs from the elbow
        towards the shoulder and keeps its length, the torso stays upright and follows."""
        elbow = T_world_target[..., :3, 3] - T_world_target[..., :3, 0] * self.elbow
        x = elbow - self.shoulder
        x /= np.linalg.norm(x, axis=-1, keepdims=True)
        x0, x1, x2 = x[..., 0], x[..., 1], x[..., 2]
        y0, y1 = np.stack([-x1, x0]) / np.sqrt(x0**2 + x1**2)  # y lies across the vertical; np.cross costs five times as much
        y, z = np.stack([y0, y1, np.zeros_like(y0)], axis=-1), np.stack([-x2 * y1, x2 * y0, x0 * y1 - x1 * y0], axis=-1)
        shoulder = elbow - self.upper_arm * x
        return [frame(np.stack([x, y, z], axis=-1), shoulder), frame(self.R_world_torso, shoulder)]


def frame(rotation: Array, position: Array) -> Array:
    """Transforms (..., 4, 4) of rotations (..., 3, 3) and positions (..., 3), which broadcast."""
    T = np.zeros((*np.broadcast_shapes(rotation.shape[:-2], position.shape[:-1]), 4, 4))
    T[..., :3, :3], T[..., :3, 3], T[..., 3, 3] = rotation, position, 1.0
    return T
