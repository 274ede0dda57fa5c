"""Depth images of robots in a camera's view, from their joint angles."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from penumbra.shared.body.robot import robot_models
from penumbra.shared.cell.description import Cell
from penumbra.shared.geometry import rigid
from penumbra.shared.geometry.raster import Raster
from penumbra.shared.geometry.rigid import Array
from penumbra.shared.perception.intrinsics import Intrinsics


class RobotDepth:
    """Renders the depth of the cell's robots in windows of one camera's image. T_camera_world: 4 x 4."""

    def __init__(self, cell: Cell, T_camera_world: Array):
        self.robots = cell.robots
        self._models = robot_models(cell)
        self._T_camera_world = T_camera_world
        self._bounds = {
            (name, link): (mesh.vertices.mean(axis=0), float(np.ptp(mesh.vertices, axis=0).max()))
            for name, model in self._models.items()
            for link, mesh in model.meshes.items()
        }
        self._raster: Raster | None = None

    def render(self, joints: Mapping[str, Array], k: Intrinsics, shape: tuple[int, ...]) -> NDArray[np.float32]:
        """Depth (h, w) [m] of the nearest robot surface, infinite where there is none. `joints` (n,) [rad] by robot."""
        h, w = shape
        if self._raster is None or self._raster.depth.shape != (h, w):
            self._raster = Raster(w, h)
        self._raster.clear()
        for name, q in joints.items():
            model = self._models[name]
            for link, T_world_link in model.link_transforms(q).items():
                if link not in model.meshes:
                    continue
                T = self._T_camera_world @ T_world_link
                centre, radius = self._bounds[name, link]
                if _outside(rigid.apply(T, centre), radius, k, w, h):
                    continue
                mesh = model.meshes[link]
                self._raster.draw(rigid.apply(T, mesh.vertices), mesh.faces, k.fx, k.fy, k.cx, k.cy, 1)
        return self._raster.depth


def _outside(centre: Array, radius: float, k: Intrinsics, w: int, h: int) -> bool:
    """Whether a ball lies outside the window. A ball that reaches behind the camera counts as visible."""
    z = centre[2] - radius
    if centre[2] + radius <= 0.0:
        return True
    if z <= 0.0:
        return False
    u, v = k.fx * centre[0] / centre[2] + k.cx, k.fy * centre[1] / centre[2] + k.cy
    reach = max(k.fx, k.fy) * radius / z * np.hypot(1.0, np.hypot(centre[0], centre[1]) / centre[2])
    return bool(u + reach < 0 or v + reach < 0 or u - reach > w or v - reach > h)
