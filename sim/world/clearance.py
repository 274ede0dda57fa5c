"""Clearance of the person from the robot, the pads and the table: motions are drawn so that they never touch."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from penumbra.shared.body.anatomy import Mesh
from penumbra.shared.body.posture import frame
from penumbra.shared.body.robot import RobotModel
from penumbra.shared.geometry import rigid
from penumbra.shared.geometry.rigid import Array
from penumbra.shared.geometry.surface import Surface
from penumbra.shared.skin.layout import Skin
from penumbra.sim.world.motion import JointMotion
from penumbra.sim.world.person import Person

ROBOT_CLEARANCE = 0.022
"""Minimum distance [m] to the robot at the instants that are checked; between them it shrinks by less than 7 mm."""
TABLE_CLEARANCE = 0.025
"""Minimum distance [m] to the table and to pads in it at the instants that are checked; between them it shrinks by less than
5 mm."""
SAMPLE = 0.02
"""Spacing [m] of the points that represent a hull."""


def rotations(rpy: Array) -> Array:
    """Rotation matrices (k, 3, 3) of roll, pitch, yaw (k, 3) [rad] about the fixed x, y, z axes, as in `rigid.from_rpy`."""
    (cr, cp, cy), (sr, sp, sy) = np.cos(rpy).T, np.sin(rpy).T
    rows = [
        [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
        [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
        [-sp, cp * sr, cp * cr],
    ]
    return np.moveaxis(np.array(rows), 2, 0)


def hull_points(mesh: Mesh, spacing: float = SAMPLE) -> Array:
    """Points (n, 3) on a mesh's surface, no farther apart than about `spacing` [m]: a grid on every triangle, thinned."""
    points = [mesh.vertices]
    for a, b, c in mesh.vertices[mesh.faces]:
        n = int(np.ceil(max(np.linalg.norm(b - a), np.linalg.norm(c - a), np.linalg.norm(c - b)) / spacing))
        u, v = (w.ravel() / n for w in np.meshgrid(np.arange(n + 1), np.arange(n + 1)))
        inside = u + v <= 1.0
        points.append(a + u[inside, None] * (b - a) + v[inside, None] * (c - a))
    everything = np.concatenate(points)
    _, first = np.unique(np.round(everything / spacing).astype(int), axis=0, return_index=True)
    return everything[np.sort(first)]


class Obstacle:
    """Points (n, 3) that move along with a link; the person keeps `distance` [m] away from them."""

    def __init__(self, points: Array, distance: float):
        self.points, self.distance = points, distance
        self.middle = (points.min(axis=0) + points.max(axis=0)) / 2.0
        self.radius = float(np.linalg.norm(points - self.middle, axis=1).max())


class BodyPart:
    """A part of the person, prepared for distance queries."""

    def __init__(self, mesh: Mesh):
        self.vertices = mesh.vertices
        self._surface = Surface(mesh.vertices, mesh.faces)
        self._low, self._high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)

    def clearance(self, obstacle: Obstacle, T_world_obstacle: Array, T_world_part: Array, enough: float = 0.01) -> float:
        """Minimum distance [m] to an obstacle in excess of the demanded one, over poses (k, 4, 4) of both. At most `enough`:
        farther points are not measured."""
        R = T_world_part[:, :3, :3]
        to_part = np.swapaxes(R, 1, 2) @ T_world_obstacle[:, :3, :3]
        shift = np.einsum("kij,ki->kj", R, T_world_obstacle[:, :3, 3] - T_world_part[:, :3, 3])
        reach = obstacle.distance + enough
        middle = to_part @ obstacle.middle + shift
        beyond = np.linalg.norm(np.maximum(np.maximum(self._low - middle, middle - self._high), 0.0), axis=1)
        close = beyond < reach + obstacle.radius
        if not close.any():
            return enough
        points = obstacle.points @ np.swapaxes(to_part[close], 1, 2) + shift[close, None]
        near = points[((points > self._low - reach) & (points < self._high + reach)).all(axis=2)]
        if len(near) == 0:
            return enough
        return min(enough, float(self._surface.nearest(near)[0].min()) - obstacle.distance)

    def height(self, T_world_part: Array) -> float:
        """Minimum height [m] of the part over poses (k, 4, 4)."""
        return float((self.vertices @ T_world_part[:, 2, :3].T + T_world_part[:, 2, 3]).min())


class Clearance:
    """Clearance of the person from all obstacles, for `LimbMotion`."""

    def __init__(
        self,
        person: Person,
        robots: Mapping[str, RobotModel],
        motions: Mapping[str, JointMotion],
        skin: Skin | None,
        table: bool,
    ):
        self._person, self._robots, self._motions, self._table = person, robots, motions, table
        self._parts = [BodyPart(mesh) for mesh in person.meshes]
        self._obstacles = [  # by robot and link; robot "" is the world
            (robot, link, Obstacle(hull_points(mesh), ROBOT_CLEARANCE))
            for robot, model in robots.items()
            for link, mesh in model.meshes.items()
        ]
        for i, link in enumerate(skin.links if skin else ()):
            assert skin is not None
            points = rigid.apply(skin.T_link_pads[i], skin.centroids[skin.of(i)])
            robot, _, name = link.partition("/")
            self._obstacles.append(
                (robot, name, Obstacle(points, ROBOT_CLEARANCE)) if name else ("", "", Obstacle(points, TABLE_CLEARANCE))
            )

    def __call__(self, times: Array, poses: Array) -> float:
        """Minimum distance [m] in excess of the demanded ones at scene times (k,) [s] and target poses (k, 6).

        At most 1 cm where there is a robot or a pad.
        """
        T_target = frame(rotations(poses[:, 3:]), poses[:, :3])
        placed = list(zip(self._parts, self._person.poses(T_target), strict=True))
        least = np.inf
        if self._table:  # forearm and upper arm: the torso stands behind the table
            least = min(part.height(T) for part, T in placed[:2]) - TABLE_CLEARANCE
        links = {name: self._robots[name].link_transforms(motion.at(times)) for name, motion in self._motions.items()}
        still = np.tile(np.eye(4), (len(times), 1, 1))
        for robot, link, obstacle in self._obstacles:
            if least < 0.0:
                break
            T = links[robot][link] if robot else still
            least = min(least, *(part.clearance(obstacle, T, T_part) for part, T_part in placed))
        return float(least)
