"""One target of the simulated cell and the person it belongs to: its motion and its effect on the skin."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from penumbra.shared.body.robot import RobotModel
from penumbra.shared.cell import description as cells
from penumbra.shared.geometry import rigid
from penumbra.shared.geometry.rigid import Array
from penumbra.shared.geometry.surface import Surface
from penumbra.shared.skin.layout import Near
from penumbra.sim.skin.pads import SkinModel
from penumbra.sim.world.clearance import Clearance
from penumbra.sim.world.motion import JointMotion, LimbMotion, angular_velocity
from penumbra.sim.world.person import Person


@dataclass(frozen=True)
class Placed:
    """Pose and velocity of a target. T_world_target (4, 4) and pose (6,) are the same: x, y, z [m], roll, pitch, yaw [rad].
    velocity (6,): linear [m/s] and angular [rad/s] along the world's axes."""

    T_world_target: Array
    pose: Array
    velocity: Array


class Actor:
    """A moving target and its person. The cell's `sim` gives the motion region and the shoulder of the first target; for every
    other target both are shifted by the offset between the homes. near: the pads that the target may come near.

    Raises CellError where the region holds no allowed pose.
    """

    def __init__(
        self,
        cell: cells.Cell,
        sim: cells.Sim,
        name: str,
        seed: int,
        robots: Mapping[str, RobotModel],
        motions: Mapping[str, JointMotion],
    ):
        target = cell.targets[name]
        apart = np.subtract(target.home.position, next(iter(cell.targets.values())).home.position)
        here = sim.model_copy(
            update={
                "shoulder": _moved(sim.shoulder, apart),
                "motion": sim.motion.model_copy(
                    update={"low": _moved(sim.motion.low, apart), "high": _moved(sim.motion.high, apart)}
                ),
            }
        )
        self.person = Person(cell, here, target)
        self.near = Near.of(cell, name)
        self._skin = SkinModel(self.near.cell, name) if self.near.cell.pads else None
        self._surface = Surface(self.person.meshes[0].vertices, self.person.meshes[0].faces)
        clearance = Clearance(self.person, robots, motions, self._skin.skin if self._skin else None, sim.table is not None)
        self._limb = LimbMotion(here.motion, seed, clearance)

    def at(self, scene_s: float, speed: float) -> Placed:
        """Pose and velocity at a scene time [s]. speed: scene seconds per second."""
        pose, rate = self._limb.at(scene_s)
        velocity = speed * np.concatenate([rate[:3], angular_velocity(pose[3:], rate[3:])])
        return Placed(rigid.from_rpy(pose[:3], pose[3:]), pose, velocity)

    def parts(self, scene_s: float) -> list[Array]:
        """T_world_mesh (4, 4) of each of the person's meshes at a scene time [s]."""
        pose, _ = self._limb.at(scene_s)
        return self.person.poses(rigid.from_rpy(pose[:3], pose[3:]))

    def plan(self, until_s: float) -> None:
        """Plans the motion up to a scene time [s]."""
        self._limb.plan(until_s)

    def change(self, placed: Placed, T_world_pads: Array) -> Array:
        """Changes of capacitance (m,) [fF] by the person at the electrodes of `near`, for poses of all pads (p, 4, 4)."""
        if self._skin is None:
            return np.zeros(0)
        return self._skin.person(T_world_pads[self.near.pads], self.person.poses(placed.T_world_target))

    def gaps(self, placed: Placed, points: Array) -> Array:
        """Distances [m] (n,) from points (n, 3) in the world to the target's skin; 0 inside."""
        local = rigid.apply(rigid.inverse(placed.T_world_target), points)
        return np.maximum(self._surface.nearest(local)[0], 0.0)


def _moved(position: tuple[float, float, float], way: Array) -> tuple[float, float, float]:
    x, y, z = np.add(position, way).tolist()
    return x, y, z
