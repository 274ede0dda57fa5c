"""The occluder: a panel that slides in front of the camera so that a wanted share of the target is hidden."""

from __future__ import annotations

import bisect
import threading

import numpy as np
from numpy.typing import ArrayLike

from penumbra.shared.body.anatomy import Mesh
from penumbra.shared.cell import description as cells
from penumbra.shared.contract.labels import Label
from penumbra.shared.geometry import rigid
from penumbra.shared.geometry.rigid import Array

BOX_CORNERS = np.array([(x, y, z) for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])
"""Corners (8, 3) of a cube with edges of length 1 around the origin."""
BOX_FACES = np.array(
    [
        (1, 3, 0),
        (4, 1, 0),
        (0, 3, 2),
        (2, 4, 0),
        (1, 7, 3),
        (5, 1, 4),
        (5, 7, 1),
        (3, 7, 2),
        (6, 4, 2),
        (2, 7, 6),
        (6, 5, 4),
        (7, 5, 6),
    ],
    np.int32,
)
"""Corners (12, 3) of the cube's triangles, counter-clockwise from outside. trimesh has the same cube, but importing it costs
0.3 s of CPU at the emulator's start."""
AWAY = -1.0
"""Level of the occluder when it is out of the picture; at 0 it begins to hide the target."""


class OcclusionSchedule:
    """The wanted level of occlusion over time: a share of the target's pixels in [0, 1], or AWAY.

    Automatic: away for 2.5 to 6 s, then hiding for 2.5 to 5 s, in three of five cases all of it, otherwise 50 to 95 %.
    Levels change at SLOPE per second: the occluder slides.
    """

    SLOPE = 2.5

    def __init__(self, seed: int):
        self._rng = np.random.default_rng([seed, 3])
        self._lock = threading.Lock()
        self._ends, self._levels = [float(self._rng.uniform(3.0, 5.0))], [AWAY]
        self._commands: list[tuple[float, float | None, float]] = [(0.0, None, AWAY)]  # time, level or automatic, level before

    def command(self, time_s: float, level: float | None) -> None:
        """Holds a level in [0, 1] (0: away) from a time on, or follows the schedule (None)."""
        self._commands.append((time_s, None if level is None else level or AWAY, self.at(time_s)))

    @property
    def commanded(self) -> float | None:
        """The level last commanded in [0, 1], None for automatic."""
        level = self._commands[-1][1]
        return level if level is None else max(level, 0.0)

    def at(self, time_s: float) -> float:
        """The level in [AWAY, 1] at a time."""
        begin, level, before = next(c for c in reversed(self._commands) if c[0] <= time_s or c is self._commands[0])
        if level is not None:
            return before + float(np.clip(level - before, *_reach(self.SLOPE * (time_s - begin))))
        automatic = self._automatic(time_s)
        return before + float(np.clip(automatic - before, *_reach(self.SLOPE * (time_s - begin))))

    def _automatic(self, time_s: float) -> float:
        with self._lock:
            while self._ends[-1] <= time_s:
                hide = self._levels[-1] == AWAY
                level = (1.0 if self._rng.random() < 0.6 else float(self._rng.uniform(0.5, 0.95))) if hide else AWAY
                hold = self._rng.uniform(2.5, 5.0) if hide else self._rng.uniform(2.5, 6.0)
                self._levels.append(level)
                self._ends.append(self._ends[-1] + 2.0 / self.SLOPE + float(hold))
        i = bisect.bisect_right(self._ends, time_s)
        if i == 0:
            return self._levels[0]
        since = time_s - self._ends[i - 1]
        return self._levels[i - 1] + float(np.clip(self._levels[i] - self._levels[i - 1], *_reach(self.SLOPE * since)))


def _reach(change: float) -> tuple[float, float]:
    return (-change, change)


class Panel:
    """A box 3 mm thick that stands across the line from a camera to the target, nearer to the camera, one edge through the
    target's picture. mesh: in its own frame, x from the hiding edge into the panel, z along the camera's optical axis."""

    DEPTH = 0.55
    """Place on the way from the camera to the target, as a share of it: well before the robot."""
    SIZE = 0.45
    """Width and height [m]: larger than the projection of a forearm with hand onto the plane at DEPTH."""
    MARGIN = 0.02
    """Distance [m] of the edge beyond a wholly hidden target, as the measured picture may lag by a frame."""
    WHOLLY = 0.95
    """Level from which on everything is hidden."""

    def __init__(self, seed: int):
        angle = np.random.default_rng([seed, 4]).uniform(0.0, 2.0 * np.pi)
        self._direction = np.array([np.cos(angle), np.sin(angle)])  # from the edge into the panel, in the picture
        self.mesh = box((self.SIZE, self.SIZE, 0.003), (self.SIZE / 2, 0.0, 0.0015), Label.OCCLUDER)

    def pose(self, level: float, camera: cells.Camera, target: Mesh, T_world_target: Array) -> Array | None:
        """T_world_panel that hides `level` of the target's picture in a camera, None where it is out of the picture.

        The picture's area is that of the front-facing triangles. The panel's edge is a weighted quantile of it along the
        direction in which the panel slides. This is exact for convex bodies, and within some hundredths for a hand over its own
        forearm.
        """
        if level <= AWAY:
            return None
        corners = rigid.apply(rigid.inverse(camera.T_world_camera) @ T_world_target, target.vertices)
        depth = self.DEPTH * float(corners[:, 2].mean())
        picture = corners[:, :2] / corners[:, 2:]  # normalised image coordinates
        across = picture @ self._direction
        sideways = picture @ np.array([-self._direction[1], self._direction[0]])
        triangles = picture[target.faces]
        u, v = triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]
        area = np.maximum(-(u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0]), 0.0)  # y points down: faces towards the camera are negative
        margin = self.MARGIN / depth
        low, high = across.min() - margin, across.max() + margin
        if level >= self.WHOLLY:
            edge = low
        elif level >= 0.0:
            edge = _upper_quantile(across[target.faces], area, level)
        else:  # on its way out: at AWAY it stands beyond the border of the widest picture
            out = np.hypot(camera.width / camera.fx, camera.height / camera.fy) + high
            edge = high - level * (out - high)
        x, y = edge * self._direction + 0.5 * (sideways.min() + sideways.max()) * np.array(
            [-self._direction[1], self._direction[0]]
        )
        T_camera_panel = np.eye(4)
        T_camera_panel[:2, 0] = self._direction
        T_camera_panel[:2, 1] = -self._direction[1], self._direction[0]
        T_camera_panel[:3, 3] = x * depth, y * depth, depth
        return camera.T_world_camera @ T_camera_panel


def _upper_quantile(across: Array, area: Array, share: float) -> float:
    """The value above which `share` of the area lies, for triangles with corners (m, 3) and areas (m,): each triangle's area
    is assumed to be spread evenly from its lowest to its highest corner."""
    low, high = across.min(axis=1), np.maximum(across.max(axis=1), across.min(axis=1) + 1e-9)
    grid = np.linspace(low.min(), high.max(), 129)
    beyond = np.clip((high - grid[:, None]) / (high - low), 0.0, 1.0) @ area / max(float(area.sum()), 1e-30)
    return float(np.interp(-share, -beyond, grid))


def box(size: ArrayLike, middle: ArrayLike, label: Label) -> Mesh:
    """A box with edges `size` (3,) [m] along its frame's axes around `middle` (3,)."""
    return Mesh(BOX_CORNERS * np.asarray(size) + np.asarray(middle), BOX_FACES.copy(), np.full(12, label, np.uint8))
