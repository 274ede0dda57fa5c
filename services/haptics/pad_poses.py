"""Computes the pads' poses at a stamp: forward kinematics at joint angles interpolated to it, or extrapolated with the last
velocity if voltages arrive before the joint angles of their time."""

from __future__ import annotations

import numpy as np

from penumbra.shared.body.robot import RobotModel
from penumbra.shared.cell import description as cells
from penumbra.shared.geometry.rigid import Array
from penumbra.shared.perception.joint_history import RobotJoints
from penumbra.shared.skin.layout import Skin, link_names

STALE_NS = 100_000_000
"""Maximum distance [ns] between a stamp and the joint angles used for it. Chosen: at 1 rad/s a joint moves a pad that is half a
metre away by 5 cm in this time."""


class PadPoses:
    """Poses of a cell's pads. Joint angles may be added from another thread than the one that calls `at`.

    models: of all robots of the cell, by name; their joints in this order are the network's joint angles.
    """

    def __init__(self, cell: cells.Cell, skin: Skin, models: dict[str, RobotModel]):
        self.skin, self.models = skin, models
        self._carriers = {link.partition("/")[0] for link in skin.links} & set(models)
        counts = {name: len(model.joints) for name, model in models.items()}
        self._joints = RobotJoints(counts, STALE_NS, is_carried_on=True)

    def add(self, robot: str, stamp_ns: int, joints: Array) -> None:
        """Add joint angles (j,) [rad]. Raises ValueError for an unknown robot or a wrong number of joints."""
        self._joints.add(robot, stamp_ns, joints)

    def at(self, stamp_ns: int) -> tuple[Array, Array] | None:
        """T_world_pads (p, 4, 4) and all joint angles (j,) at stamp_ns; None if a robot that carries pads has sent none near that
        time."""
        links: dict[str, dict[str, Array]] = {}
        joints, known = [], self._joints.at(stamp_ns)
        for name, model in self.models.items():
            q = known.get(name)
            if q is not None:
                links[name] = model.link_transforms(q)
            elif name in self._carriers:
                return None
            else:
                q = np.zeros(len(model.joints))
            joints.append(q)
        return self.skin.T_world_pads(link_names(links)), np.concatenate(joints) if joints else np.zeros(0)
