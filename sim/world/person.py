"""The person of a cell: the target and, if it is the parametric forearm, the upper arm and torso that follow it."""

from __future__ import annotations

import numpy as np

from penumbra.shared.body import anatomy as bodies
from penumbra.shared.body.anatomy import Mesh
from penumbra.shared.cell import description as cells
from penumbra.shared.geometry import rigid
from penumbra.shared.geometry.rigid import Array


class Person:
    """A person's body. meshes: the target, then upper arm and torso if the target is `body:forearm`, each in its own frame."""

    def __init__(self, cell: cells.Cell, sim: cells.Sim, target: cells.Target):
        self.meshes: list[Mesh] = [bodies.target_mesh(target, cell)]
        self.whole = target.mesh == "body:forearm"
        if self.whole:
            self.meshes += [bodies.upper_arm_mesh(cell.body), bodies.torso_mesh(cell.body)]
        self._elbow = (target.size.length if target.size else 1.0) * cell.body.forearm_length / 2.0
        self._upper_arm = cell.body.upper_arm_length
        self._shoulder = np.asarray(sim.shoulder)
        self._R_world_torso = rigid.from_rpy((0.0, 0.0, 0.0), (0.0, 0.0, target.home.rpy[2]))[:3, :3]

    def poses(self, T_world_target: Array) -> list[Array]:
        """T_world_part (..., 4, 4) of every mesh for T_world_target (..., 4, 4): the upper arm runs from the elbow towards the
        cell's shoulder and keeps its length, the torso stays upright and follows."""
        if not self.whole:
            return [T_world_target]
        elbow = T_world_target[..., :3, 3] - T_world_target[..., :3, 0] * self._elbow
        x = elbow - self._shoulder
        x /= np.linalg.norm(x, axis=-1, keepdims=True)
        x0, x1, x2 = x[..., 0], x[..., 1], x[..., 2]
        y0, y1 = np.stack([-x1, x0]) / np.sqrt(x0**2 + x1**2)  # y lies across the vertical; np.cross costs five times as much
        y, z = np.stack([y0, y1, np.zeros_like(y0)], axis=-1), np.stack([-x2 * y1, x2 * y0, x0 * y1 - x1 * y0], axis=-1)
        shoulder = elbow - self._upper_arm * x
        upper_arm = frame(np.stack([x, y, z], axis=-1), shoulder)
        return [T_world_target, upper_arm, frame(self._R_world_torso, shoulder)]


def frame(rotation: Array, position: Array) -> Array:
    """Transforms (..., 4, 4) of rotations (..., 3, 3) and positions (..., 3), which broadcast."""
    T = np.zeros((*np.broadcast_shapes(rotation.shape[:-2], position.shape[:-1]), 4, 4))
    T[..., :3, :3], T[..., :3, 3], T[..., 3, 3] = rotation, position, 1.0
    return T
