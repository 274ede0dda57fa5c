"""One target of the simulated cell, with the person whose it is: how it moves, and what the skin feels of it."""

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
    """Where a target is. T_world_target (4, 4), the same as pose (6,): x, y, z [m], roll, pitch, yaw [rad]; velocity (6,): linear
    [m/s] and angular [rad/s] along the world's axes."""

    T_world_target: Array
    pose: Array
    velocity: Array


class Actor:
    """A target in motion. The cell's `sim` says where its first target moves and where that person's shoulder is; everybody
    else does the same as far from it as the homes are apart. near: the pads that it may come near.

    Raises CellError where the region cannot be moved in.
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
        """The pose at a time of the scene, which runs at this speed."""
        pose, rate = self._limb.at(scene_s)
        velocity = speed * np.concatenate([rate[:3], angular_velocity(pose[3:], rate[3:])])
        return Placed(rigid.from_rpy(pose[:3], pose[3:]), pose, velocity)

    def parts(self, scene_s: float) -> list[Array]:
        """T_world_mesh of each of the person's meshes at a time of the scene."""
        pose, _ = self._limb.at(scene_s)
        return self.person.poses(rigid.from_rpy(pose[:3], pose[3:]))

    def plan(self, until_s: float) -> None:
        """Plans its motion up to a time of the scene."""
        self._limb.plan(until_s)

    def change(self, placed: Placed, T_world_pads: Array) -> Array:
        """Changes of capacitance (m,) [fF] by it at the electrodes that it may come near (`near`), for all pads (p, 4, 4)."""
        return np.zeros(0) if self._skin is None else self._skin.limb(T_world_pads[self.near.pads], placed.T_world_target)

    def gaps(self, placed: Placed, points: Array) -> Array:
        """Distances [m] (n,) from points (n, 3) in the world to its skin; 0 inside."""
        local = rigid.apply(rigid.inverse(placed.T_world_target), points)
        return np.maximum(self._surface.nearest(local)[0], 0.0)


def _moved(position: tuple[float, float, float], way: Array) -> tuple[float, float, float]:
    x, y, z = np.add(position, way).tolist()
    return x, y, z
