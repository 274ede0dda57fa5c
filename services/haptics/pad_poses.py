"""Where the pads are at a moment: the robots' forward kinematics at joint angles interpolated to it, or carried on by the
last velocity where voltages come before the joint angles of their time."""

from __future__ import annotations

import threading
from collections import deque

import numpy as np

from shared.body.robot import RobotModel
from shared.cell import description as cells
from shared.geometry.rigid import Array
from shared.skin.layout import Skin, link_names

HISTORY = 64
"""Joint messages kept per robot: a third of a second at 200 Hz."""
STALE_NS = 100_000_000
"""Joint angles further than this from the moment that is asked for are not used."""


class PadPoses:
    """Poses of a cell's pads. Joint angles may come from another thread than the questions.

    models: of all robots of the cell, by name; their joints in this order are the network's joint angles.
    """

    def __init__(self, cell: cells.Cell, skin: Skin, models: dict[str, RobotModel]):
        self.skin, self.models = skin, models
        self._carriers = {link.partition("/")[0] for link in skin.links} & set(models)
        self._history: dict[str, deque[tuple[int, Array]]] = {name: deque(maxlen=HISTORY) for name in models}
        self._lock = threading.Lock()

    def add(self, robot: str, stamp_ns: int, joints: Array) -> None:
        """Take joint angles (j,) [rad]. Raises ValueError for an unknown robot or another number of joints than it has."""
        if robot not in self.models:
            raise ValueError(f"a robot of {', '.join(self.models) or 'none'} expected, {robot!r} came: compare the cell files")
        wanted = len(self.models[robot].joints)
        if joints.shape != (wanted,):
            raise ValueError(f"robot {robot}: {wanted} joint angles expected, shape {joints.shape} came")
        history = self._history[robot]
        with self._lock:
            if history and stamp_ns <= history[-1][0]:
                if history[-1][0] - stamp_ns < STALE_NS:
                    return  # repeated or overtaken
                history.clear()  # time jumped back: the source started again
            history.append((stamp_ns, joints))

    def at(self, stamp_ns: int) -> tuple[Array, Array] | None:
        """T_world_pads (p, 4, 4) and all joint angles (j,) at stamp_ns; None where a robot that carries pads was not heard
        near that time."""
        links: dict[str, dict[str, Array]] = {}
        joints = []
        for name, model in self.models.items():
            with self._lock:
                history = list(self._history[name])
            if history and history[0][0] - STALE_NS <= stamp_ns <= history[-1][0] + STALE_NS:
                q = _joints_at(history, stamp_ns)
                links[name] = model.link_transforms(q)
            elif name in self._carriers:
                return None
            else:
                q = np.zeros(len(model.joints))
            joints.append(q)
        return self.skin.T_world_pads(link_names(links)), np.concatenate(joints) if joints else np.zeros(0)


def _joints_at(history: list[tuple[int, Array]], stamp_ns: int) -> Array:
    """Joint angles (j,) at a time, linear between the two messages around it or beside it; held before the first."""
    after = max(1, next((i for i, (t, _) in enumerate(history) if t >= stamp_ns), len(history) - 1))
    if len(history) == 1 or stamp_ns <= history[0][0]:
        return history[0][1]
    (t0, q0), (t1, q1) = history[after - 1], history[after]
    return q0 + (q1 - q0) * ((stamp_ns - t0) / (t1 - t0))
