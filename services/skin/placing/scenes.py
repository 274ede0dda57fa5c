"""Scenes on which pads are judged: a limb somewhere in its workspace, each with a posture of the robots."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from penumbra.shared.body.anatomy import target_mesh
from penumbra.shared.body.robot import RobotModel
from penumbra.shared.cell import description as cells
from penumbra.shared.cell.pads import Pad
from penumbra.shared.geometry import rigid
from penumbra.shared.geometry.rigid import Array
from penumbra.shared.geometry.surface import Surface
from penumbra.shared.skin.layout import HOME_SIGMAS, link_names

GAP = 0.01
"""Minimum distance [m] of a limb from a link or from the pads' plane."""
BATCH, BATCHES = 300, 100
"""Number of poses drawn per batch, and maximum number of batches. A workspace with no free pose in the first batch, or with too
few in all, counts as too small."""


@dataclass(frozen=True)
class Scenes:
    """n scenes. targets (n, 4, 4): T_world_target; links: T_world_link (n, 4, 4) by ROBOT/LINK, and `world`."""

    targets: Array
    links: Mapping[str, Array]

    def __len__(self) -> int:
        return len(self.targets)

    def pads(self, pads: tuple[Pad, ...]) -> Array:
        """T_world_pads (n, p, 4, 4)."""
        return np.stack([self.links[pad.link] @ pad.T_link_pad for pad in pads], axis=1)


@dataclass(frozen=True)
class Room:
    """Constraints on the limb's place. solids: points (m, 3) on each link, by ROBOT/LINK; plane (4, 4): T_world_plane of a table
    top, z outwards; places: T_link_pad (4, 4) where pads may sit, by link; reach [m]: maximum gap to the nearest place."""

    solids: Mapping[str, Array]
    plane: Array | None
    places: Mapping[str, list[Array]]
    reach: float


class Drawing:
    """Draws scenes of a cell's target. box (2, 3) [m]: bounds of its position in the world, uniformly drawn; without one the
    target is drawn around its home in the cell file. joints: bounds (2, j) of all robots' joints."""

    def __init__(self, cell: cells.Cell, target: str, models: Mapping[str, RobotModel], box: Array | None, joints: Array):
        self.target, self.mesh = cell.targets[target], target_mesh(cell.targets[target], cell)
        self.surface = Surface(self.mesh.vertices, self.mesh.faces)
        self._radius = float(np.linalg.norm(self.mesh.vertices, axis=1).max())
        self._models, self.box, self._joints = models, box, joints

    def links(self, joints: Array) -> dict[str, Array]:
        """T_world_link (n, 4, 4) by ROBOT/LINK at joint angles (n, j), and `world`."""
        found, first = {}, 0
        for robot, model in self._models.items():
            found[robot] = model.link_transforms(joints[:, first : first + len(model.joints)])
            first += len(model.joints)
        return {"world": np.tile(np.eye(4), (len(joints), 1, 1)), **link_names(found)}

    def postures(self, rng: np.random.Generator, count: int) -> Array:
        """Joint angles (count, j), uniform within their bounds."""
        low, high = self._joints
        return rng.uniform(low, high, (count, len(low)))

    @property
    def middle(self) -> dict[str, Array]:
        """T_world_link (1, 4, 4) in the middle of the joints' bounds."""
        return self.links(self._joints.mean(axis=0)[None])

    def pose(self, rng: np.random.Generator) -> Array:
        """A random T_world_target (4, 4), without regard to obstacles."""
        home, spread = self.target.home.transform, self.target.home_spread
        turn = _cut(rng, 3) * spread.rotation
        T = rigid.perturb(home, np.concatenate([_cut(rng, 3) * spread.position, turn]))
        if self.box is not None:
            T[:3, 3] = rng.uniform(*self.box)
        return T

    def gaps(self, T: Array, links: Mapping[str, Array], room: Room, k: int = 0) -> tuple[float, float]:
        """For a limb at T (4, 4), with links as in scene k: the smallest distance [m] to links and plane, and to a place of a
        pad. They may be infinite beyond GAP and beyond the room's reach; the second is infinite if the first is below GAP."""
        solids = [rigid.apply(links[name][k], points) for name, points in room.solids.items()]
        clear = self._distance(T, solids, GAP)
        if room.plane is not None:
            heights = rigid.apply(rigid.inverse(room.plane) @ T, self.mesh.vertices)[:, 2]
            clear = min(clear, float(heights.min()))
        if clear < GAP:
            return clear, np.inf
        places = [(links[name][k] @ np.array(own))[:, :3, 3] for name, own in room.places.items()]
        return clear, self._distance(T, places, room.reach)

    def _distance(self, T: Array, points: Sequence[Array], most: float) -> float:
        """The smallest distance [m] from a limb at T (4, 4) to points (n, 3); infinite if it certainly exceeds `most`."""
        local = (np.concatenate([*points, np.empty((0, 3))]) - T[:3, 3]) @ T[:3, :3]
        local = local[(local**2).sum(axis=1) < (self._radius + most) ** 2]
        return float(self.surface.nearest(local)[0].min(initial=np.inf))

    def draw(self, room: Room, count: int, seed: int) -> Scenes:
        """Draw `count` scenes in which the limb keeps clear and is within reach. Raises CellError if there are hardly any."""
        rng = np.random.default_rng([seed, 51])
        poses: list[Array] = []
        postures: list[Array] = []
        for _ in range(BATCHES):
            joints = self.postures(rng, BATCH)
            links = self.links(joints)
            for k in range(BATCH):
                T = self.pose(rng)
                clear, away = self.gaps(T, links, room, k)
                if clear >= GAP and away <= room.reach:
                    poses.append(T)
                    postures.append(joints[k])
                if len(poses) == count:
                    return Scenes(np.array(poses), self.links(np.array(postures)))
            if not poses:
                break
        where = "around the target's home" if self.box is None else "in --workspace"
        raise cells.CellError(
            f"expected poses {where} that keep {100 * GAP:g} cm clear of robots and table and come within "
            f"{100 * room.reach:g} cm of a place for a pad, got {len(poses)} of {count}; give another --workspace, "
            "--links or --range"
        )


def _cut(rng: np.random.Generator, count: int) -> Array:
    """Standard normal numbers (count,), redrawn if they exceed HOME_SIGMAS."""
    out = rng.standard_normal(count)
    while (far := np.abs(out) > HOME_SIGMAS).any():
        out[far] = rng.standard_normal(int(far.sum()))
    return out
