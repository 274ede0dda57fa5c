"""Pictures of a calibration board as a camera with a known lens takes them, and robots that carry it."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

from penumbra.services.calibrate.board import FEWEST, Board
from penumbra.services.calibrate.intrinsics import View
from penumbra.shared.geometry import rigid
from penumbra.shared.geometry.lens import Lens
from penumbra.shared.geometry.rigid import Array

LENS = Lens(640, 480, 615.0, 613.0, 322.5, 236.0, k1=-0.28, k2=0.09, p1=0.0008, p2=-0.0006)
"""Lens of a webcam, with a barrel distortion of 6 % at the corners."""
TEXTURE = 2e-4
"""Edge [m] of a pixel of the board's texture."""
SAMPLES = 2
"""Number of rays per pixel along each direction."""
CORNER_PX = 0.06
"""Noise [px] of a corner that is found in a picture of the default blur and noise: the residuals of the fits."""
NEAR, FAR = 0.25, 4.0


@dataclass(frozen=True)
class Photographer:
    """Takes pictures of a board. blur: of the optics [px]; noise: of a pixel [grey levels]."""

    board: Board
    lens: Lens = LENS
    blur: float = 0.6
    noise: float = 2.5

    @cached_property
    def _rays(self) -> NDArray[np.float32]:
        """x / z and y / z of the rays of a finer picture: (SAMPLES height, SAMPLES width, 2)."""
        first = (1.0 / SAMPLES - 1.0) / 2.0
        x = first + np.arange(SAMPLES * self.lens.width) / SAMPLES
        y = first + np.arange(SAMPLES * self.lens.height) / SAMPLES
        pixels = self.lens.undistorted(np.stack(np.meshgrid(x, y), axis=-1))
        k = np.array([self.lens.fx, self.lens.fy]), np.array([self.lens.cx, self.lens.cy])
        return ((pixels - k[1]) / k[0]).astype(np.float32)

    @cached_property
    def _texture(self) -> NDArray[np.uint8]:
        """The board on a sheet that is a square wider, in front of grey."""
        rim = self.board.square
        width, height = (round((each + 2 * rim) / TEXTURE) for each in self.board.size)
        sheet = np.full((height, width), 225, np.uint8)
        for x, y, w, h in self.board.black:
            x0, y0, x1, y1 = (round(each / TEXTURE) for each in (x + rim, y + rim, x + w + rim, y + h + rim))
            sheet[y0:y1, x0:x1] = 25
        return sheet

    def picture(self, T_camera_board: Array, rng: np.random.Generator) -> NDArray[np.uint8]:
        """The picture (height, width, 3) uint8 of a board at a pose."""
        R, t = T_camera_board[:3, :3], T_camera_board[:3, 3]
        n = R[:, 2]  # of the plane in the camera's frame
        rays = self._rays
        depth = (n @ t) / (rays[..., 0] * n[0] + rays[..., 1] * n[1] + n[2])
        x = (rays[..., 0] * depth - t[0]) * R[0, 0] + (rays[..., 1] * depth - t[1]) * R[1, 0] + (depth - t[2]) * R[2, 0]
        y = (rays[..., 0] * depth - t[0]) * R[0, 1] + (rays[..., 1] * depth - t[1]) * R[1, 1] + (depth - t[2]) * R[2, 1]
        rim = self.board.square
        u = np.where((depth > NEAR) & (depth < FAR), (x + rim) / TEXTURE - 0.5, -1e3).astype(np.float32)
        v = ((y + rim) / TEXTURE - 0.5).astype(np.float32)
        fine = cv2.remap(self._texture, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=(120,))
        seen = cv2.resize(fine, (self.lens.width, self.lens.height), interpolation=cv2.INTER_AREA).astype(np.float32)
        seen = cv2.GaussianBlur(seen, (0, 0), self.blur) + self.noise * rng.standard_normal(seen.shape, np.float32)
        return np.repeat(np.clip(seen, 0, 255).astype(np.uint8)[..., None], 3, axis=2)

    def view(self, name: str, T_camera_board: Array, rng: np.random.Generator) -> View | None:
        """The corners that are found in such a picture; None where the board is not found."""
        found = self.board.find(self.picture(T_camera_board, rng))
        return None if found is None else View(name, *found)

    def corners(self, name: str, T_camera_board: Array, rng: np.random.Generator) -> View | None:
        """The corners that would be found in such a picture, without rendering it: a thousand times faster."""
        points = rigid.apply(T_camera_board, self.board.corners)
        k = (self.lens.fx, self.lens.fy), (self.lens.cx, self.lens.cy)
        shown = self.lens.distorted(points[:, :2] / points[:, 2:] * k[0] + k[1])
        shown += CORNER_PX * rng.standard_normal(shown.shape)
        inside = np.all((shown > 8) & (shown < (self.lens.width - 8, self.lens.height - 8)), axis=1)
        return View(name, shown[inside], np.flatnonzero(inside)) if inside.sum() >= FEWEST else None


def held(board: Board, count: int, rng: np.random.Generator) -> list[Array]:
    """T_camera_board (4, 4) of a board that is held before the camera by hand: everywhere in the picture, near and far,
    tilted."""
    middle = np.array([*board.size, 0.0]) / 2.0
    out = []
    for _ in range(count):
        distance = rng.uniform(0.4, 0.75)
        place = np.array([rng.uniform(-0.38, 0.38), rng.uniform(-0.28, 0.28), 1.0]) * distance
        tilt = rigid.rotation(np.radians([rng.uniform(-40, 40), rng.uniform(-40, 40), rng.uniform(-30, 30)]))
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = tilt, place - tilt @ middle
        out.append(T)
    return out


MOUNT = rigid.from_rpy((-0.14, -0.10, 0.06), (0.03, -0.02, 0.01))
"""T_link_board: the board on the flange of a robot, its middle in front of it and its back towards it."""
NOISE = 2e-4, float(np.radians(0.05))
"""Standard deviations of a robot's repeatability along each axis [m] and about it [rad]."""


@dataclass(frozen=True)
class Carried:
    """A robot that shows a board to a camera. T_world_camera: where the camera stands; T_link_board: how the board is mounted;
    noise: standard deviations of the link's position [m] and rotation [rad] about those from the joints."""

    T_world_camera: Array = field(default_factory=lambda: rigid.look_at((1.3, -0.5, 0.9), (0.4, 0.0, 0.5)))
    T_link_board: Array = field(default_factory=lambda: MOUNT)
    noise: tuple[float, float] = NOISE

    def poses(self, board: Board, count: int, rng: np.random.Generator) -> list[tuple[Array, Array]]:
        """T_world_link from the joints and the true T_camera_board of `count` poses."""
        middle = np.array([*board.size, 0.0]) / 2.0
        out = []
        for _ in range(count):
            place = np.array([rng.uniform(-0.25, 0.25), rng.uniform(-0.18, 0.18), 1.0]) * rng.uniform(0.7, 1.2)
            T_camera_board = np.eye(4)
            T_camera_board[:3, :3] = rigid.rotation(
                np.radians([rng.uniform(-35, 35), rng.uniform(-35, 35), rng.uniform(-30, 30)])
            )
            T_camera_board[:3, 3] = place - T_camera_board[:3, :3] @ middle
            out.append((self.said(T_camera_board, rng), T_camera_board))
        return out

    def said(self, T_camera_board: Array, rng: np.random.Generator) -> Array:
        """T_world_link from the joints, with noise, for a board at T_camera_board."""
        T_world_link = self.T_world_camera @ T_camera_board @ rigid.inverse(self.T_link_board)
        return rigid.perturb(T_world_link, np.repeat(self.noise, 3) * rng.standard_normal(6))
