"""Priors of a window: silhouettes of the robots from their joints, and of the targets from their predicted poses. `model.PRIORS`
defines the values."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import cv2
import numpy as np
from numpy.typing import NDArray

from penumbra.services.segmentation.model import PRIORS
from penumbra.shared.body import anatomy
from penumbra.shared.body.anatomy import Mesh
from penumbra.shared.cell.description import Cell
from penumbra.shared.geometry import raster, rigid
from penumbra.shared.geometry.rigid import Array
from penumbra.shared.perception.intrinsics import Intrinsics
from penumbra.shared.perception.lookout import NEAR_M, Window
from penumbra.shared.perception.prediction import deviation
from penumbra.shared.perception.robot_depth import RobotDepth

SHARP_PX = 4.0
"""Standard deviation [px] above which a blur runs on a coarser grid, on which it is between half of this and this: much faster,
with a difference of some hundredths."""
LEAST_PX = 0.5
"""Standard deviation [px] below which a blur is skipped."""


class Priors:
    """Draws the priors of windows of one camera's pictures; targets: names of those that it can see. Not thread-safe."""

    def __init__(self, cell: Cell, camera: str, targets: Iterable[str]):
        self._camera, self._targets = cell.cameras[camera], cell.targets
        self._T_camera_world = rigid.inverse(self._camera.T_world_camera)
        self._axes = np.kron(np.eye(2), self._T_camera_world[:3, :3])  # covariances: world axes to camera axes
        self._robots = RobotDepth(cell, self._T_camera_world)
        self._meshes = {name: anatomy.target_mesh(cell.targets[name], cell) for name in targets}

    def prepare(self, window: Window) -> None:
        """Compile the code of a call, so that the first frame does not wait for it."""
        homes = {name: (self._targets[name].home.transform, np.eye(6)) for name in self._meshes}
        self(window, homes, {name: np.zeros(len(robot.joints)) for name, robot in self._robots.robots.items()})

    def __call__(
        self, window: Window, poses: Mapping[str, tuple[Array, Array]], joints: Mapping[str, Array]
    ) -> NDArray[np.float32]:
        """Priors (window.height, window.width, 2) in [-1, 1]. poses: T_world_target and its covariance (6, 6) along the world's
        axes, of the targets that are not lost; joints (n,) [rad]: of the robots whose joints are known."""
        shape, k = (window.height, window.width), Intrinsics.of_window(self._camera, window.x0, window.y0, window.scale)
        robots = np.isfinite(self._robots.render(joints, k, shape)).astype(np.float32)
        expected = {}
        for name, (T, covariance) in poses.items():
            if name in self._meshes:
                turned = self._axes @ covariance @ self._axes.T
                expected[name] = silhouette(self._meshes[name], self._T_camera_world @ T, turned, k, shape)
        shares = [share for share in expected.values() if share is not None]
        out = np.empty((*shape, len(PRIORS)), np.float32)
        out[..., 0] = combined([robots], len(joints) == len(self._robots.robots), shape)
        out[..., 1] = combined(shares, len(shares) == len(self._meshes), shape)
        return out


def combined(shares: Iterable[NDArray[np.float32]], is_all: bool, shape: tuple[int, int]) -> NDArray[np.float32]:
    """A prior (h, w) in [-1, 1] from the probabilities (h, w) that objects cover a pixel. is_all: whether there are no other
    objects; otherwise pixels outside of these are unknown."""
    free = np.ones(shape, np.float32)
    for share in shares:
        free *= 1.0 - share
    prior: NDArray[np.float32] = 1.0 - 2.0 * free
    return prior if is_all else np.maximum(prior, 0.0, dtype=np.float32)


def silhouette(
    mesh: Mesh, T_camera_target: Array, covariance: Array, k: Intrinsics, shape: tuple[int, int]
) -> NDArray[np.float32] | None:
    """Probability (h, w) of each pixel to lie in the silhouette of a mesh whose pose has a covariance (6, 6) along the camera's
    axes: the silhouette at that pose, blurred by the root mean square of its points' standard deviations in the picture. None if
    the mesh is too near to the camera."""
    points = rigid.apply(T_camera_target, mesh.vertices)
    if points[:, 2].min() < NEAR_M:
        return None
    height, width = shape
    found = raster.silhouette(points, mesh.faces, (k.fx, k.fy, k.cx, k.cy), (0, 0, width, height))
    return blurred(found.astype(np.float32), deviation(points, T_camera_target[:3, 3], covariance, k))


def blurred(shares: NDArray[np.float32], sigma: tuple[float, float]) -> NDArray[np.float32]:
    """Shares (h, w) in [0, 1] blurred by standard deviations [px] in x and y, limited to the picture's size."""
    height, width = shares.shape
    x, y = min(sigma[0], width), min(sigma[1], height)
    if max(x, y) < LEAST_PX:
        return shares
    coarse = 1
    while max(x, y) > SHARP_PX * coarse:
        coarse *= 2
    size = (max(width // coarse, 1), max(height // coarse, 1))
    small = cv2.resize(shares, size, interpolation=cv2.INTER_AREA) if coarse > 1 else shares
    least = 0.1  # OpenCV treats zero as "choose automatically"
    small = cv2.GaussianBlur(
        small, (0, 0), max(x / coarse, least), sigmaY=max(y / coarse, least), borderType=cv2.BORDER_REPLICATE
    )
    if coarse > 1:
        small = cv2.resize(small, (width, height), interpolation=cv2.INTER_LINEAR)
    return np.asarray(small, np.float32)
