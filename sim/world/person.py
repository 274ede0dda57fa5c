"""The person of a cell: the target and, if it is the parametric forearm, the upper arm and torso that follow it."""

from __future__ import annotations

import numpy as np

from penumbra.shared.body import anatomy as bodies
from penumbra.shared.body.anatomy import Mesh
from penumbra.shared.body.posture import Posture
from penumbra.shared.cell import description as cells
from penumbra.shared.geometry.rigid import Array


class Person:
    """A person's body. meshes: the target, then upper arm and torso if the target is `body:forearm`, each in its own frame."""

    def __init__(self, cell: cells.Cell, sim: cells.Sim, target: cells.Target):
        self.meshes: list[Mesh] = [bodies.target_mesh(target, cell)]
        self.whole = target.mesh == "body:forearm"
        if self.whole:
            self.meshes += [bodies.upper_arm_mesh(cell.body), bodies.torso_mesh(cell.body)]
        self._posture = Posture.of(cell, target, np.array(sim.shoulder))

    def poses(self, T_world_target: Array) -> list[Array]:
        """T_world_part (..., 4, 4) of every mesh for T_world_target (..., 4, 4): see `Posture.poses`."""
        return [T_world_target, *(self._posture.poses(T_world_target) if self.whole else [])]
