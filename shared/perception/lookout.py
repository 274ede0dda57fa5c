"""Image window for the segmentation: around the predicted targets, wider around those that nothing measures any more, or around
their homes when they are lost."""

from __future__ import annotations

import itertools
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from penumbra.shared.body import anatomy
from penumbra.shared.cell.description import Camera, Cell
from penumbra.shared.contract.messages import FusedPose
from penumbra.shared.geometry import rigid
from penumbra.shared.geometry.rigid import Array
from penumbra.shared.perception.intrinsics import Intrinsics
from penumbra.shared.perception.prediction import deviation, predict

STEP = 16
"""Grid [px of the window] of a window's position, the stride of the coarsest of five layers. The sides are multiples of it too,
unless they end at the picture's edge."""
SIZE_STEP = 32
"""Step [px of the window] to which sizes are rounded up, so that they seldom change while the target turns."""
MAX_PIXELS = 224 * 224
"""Maximum number of pixels of a window around targets. A larger target is shown at a coarser scale."""
MAX_PIXELS_WIDE = 320 * 240
"""Maximum number of pixels of a window of the whole frame, or around all targets' homes, while a target is lost."""
HOME_SIGMAS = 2.0
"""Maximum distance from its home, in standard deviations, of the search for a lost target. A limb further away would not be taken
for the target."""
SIGMAS = 1.0
"""Distance from its prediction, in standard deviations, at which a target that nothing measures is still in the window. Chosen:
with 2, other things in a cluttered picture were taken for a hidden limb, which then was not found again."""
ARM_M = 0.09
"""Width [m] of the belly of a forearm (circumference 0.28 to 0.31 m), and of a hand with adducted thumb (ANSUR II, Gordon et al.
2014)."""
WIDEST_ARM_PX = 56
"""Maximum width [px] of an arm in a window, that of the training. A wider arm is shown at a coarser scale, at which the network
sees more than smooth skin at once."""
MARGIN_M = 0.04
"""Minimum margin around the target [m], for surroundings that show the contour."""
NEAR_M = 0.1
"""Minimum distance [m] from the camera of all parts of a target that is projected."""


@dataclass(frozen=True)
class Window:
    """A window of a frame: pixel (r, c) of `height` x `width` covers `scale` x `scale` image pixels, the first of which is (y0 +
    r * scale, x0 + c * scale), as in `messages.Mask`."""

    x0: int
    y0: int
    width: int
    height: int
    scale: int = 1

    @property
    def right(self) -> int:
        """The first image column beyond the window."""
        return self.x0 + self.width * self.scale

    @property
    def bottom(self) -> int:
        """The first image row beyond the window."""
        return self.y0 + self.height * self.scale


def corners_of(vertices: Array) -> Array:
    """Corners (8, 3) of the bounding box of vertices (n, 3), in their frame."""
    low, high = np.min(vertices, axis=0), np.max(vertices, axis=0)
    x, y, z = np.meshgrid(*zip(low, high, strict=True), indexing="ij")
    return np.column_stack([x.ravel(), y.ravel(), z.ravel()])


class Sized(Protocol):
    """Protocol of objects with a width and a height [px]: a camera, a window."""

    @property
    def width(self) -> int: ...
    @property
    def height(self) -> int: ...


def whole_frame(camera: Sized) -> Window:
    """Window of the whole frame, at the finest power-of-two scale within MAX_PIXELS_WIDE."""
    scale = 1
    while camera.width * camera.height > MAX_PIXELS_WIDE * scale * scale:
        scale *= 2
    return reduced(camera, scale)


def reduced(picture: Sized, scale: int) -> Window:
    """Window of a whole picture at a scale, without a remainder of less than `scale` pixels at the right and lower edge."""
    return Window(0, 0, max(picture.width // scale, 1), max(picture.height // scale, 1), scale)


class Lookout:
    """Selects windows in the frames of one camera: around the targets of its cell as predicted from their fused poses, and around
    the homes of lost targets.

    targets: targets that the camera can see, judged by the region around their homes. most: maximum number of pixels of a window
    around targets that are not lost.
    """

    def __init__(self, cell: Cell, camera: str, most: int = MAX_PIXELS):
        self._camera, self._most = cell.cameras[camera], most
        self._poses: dict[str, FusedPose] = {}
        self._boxes: dict[str, Array] = {}
        self._homes: dict[str, tuple[Array, Array]] = {}
        self._at_home: list[tuple[Array, Array]] = []
        for name, target in cell.targets.items():
            corners = corners_of(anatomy.target_mesh(target, cell).vertices)
            home, spread = rigid.apply(target.home.transform, corners), target.home_spread
            room = HOME_SIGMAS * np.hypot(spread.position, spread.rotation * np.abs(corners).max())
            region = corners_of(np.vstack([home - room, home + room]))
            if _is_in_picture(self._camera, region):
                self._boxes[name], self._homes[name] = corners, (np.eye(4), region)
                self._at_home.append((target.home.transform, corners))
        self.targets = tuple(self._boxes)
        self._window = self._wide()

    def add(self, pose: FusedPose) -> None:
        """Stores the newest fused pose of a target. Ignored for a target that the camera cannot see."""
        if pose.target in self._boxes:
            self._poses[pose.target] = pose

    @property
    def window(self) -> Window:
        """The latest window; initially the one around all homes."""
        return self._window

    @property
    def at_home(self) -> Window:
        """Window if all targets were found at their homes. A window of this size likely follows the one around all homes."""
        return window_around(self._camera, self._at_home, None, self._most) or self._wide()

    def look(self, stamp_ns: int) -> Window:
        """Selects the window for a frame exposed at a stamp; the previous one while it fits (`window_around`)."""
        self._window = self.foresee(stamp_ns)
        return self._window

    def predicted(self, stamp_ns: int) -> dict[str, tuple[Array, Array]]:
        """T_world_target and covariance (6, 6) at a stamp, by target, of visible targets that are not lost."""
        found = {}
        for name in self._boxes:
            T, covariance = predict(self._poses.get(name), stamp_ns)
            if T is not None and covariance is not None:
                found[name] = T, covariance
        return found

    def foresee(self, stamp_ns: int) -> Window:
        """The window that `look` would select for a frame of this stamp."""
        known = self.predicted(stamp_ns)
        sure = [(T, self._boxes[name]) for name, (T, _) in known.items()]
        spread = [covariance if self._poses[name].state == "coasting" else None for name, (_, covariance) in known.items()]
        is_known = len(sure) == len(self._boxes)
        found = window_around(self._camera, sure, self._window, self._most, spread) if is_known else None
        return found or self._wide([name for name in self._boxes if name not in known], sure)

    def _wide(self, lost: Iterable[str] = (), sure: Iterable[tuple[Array, Array]] = ()) -> Window:
        homes = [self._homes[name] for name in lost or self._homes]
        return window_around(self._camera, [*homes, *sure], None, MAX_PIXELS_WIDE) or whole_frame(self._camera)


def _is_in_picture(camera: Camera, region: Array) -> bool:
    """Whether a camera may see a part of a box, given its corners (8, 3) in the world: false only if all corners lie beyond one
    side of the view."""
    x, y, z = rigid.apply(rigid.inverse(camera.T_world_camera), region).T
    u, v = camera.fx * x + camera.cx * z, camera.fy * y + camera.cy * z
    sides = (z - NEAR_M, u, camera.width * z - u, v, camera.height * z - v)
    return all((side >= 0.0).any() for side in sides)


def window_around(
    camera: Camera,
    targets: Iterable[tuple[Array, Array]],
    previous: Window | None = None,
    most: int = MAX_PIXELS,
    covariances: Iterable[Array | None] = (),
) -> Window | None:
    """Window of at most `most` pixels, before its sides are rounded up, around targets, given as (T_world_target (4, 4), corners
    (8, 3) of their box), with a margin of MARGIN_M or, if that is more, SIGMAS standard deviations of their poses. covariances
    (6, 6 each): of the first targets' poses, None for those that are known. Arms of ARM_M are at most WIDEST_ARM_PX wide.

    The previous window is kept while it contains the targets and is not much too large: the recurrent state is worth more the
    less the window moves. None where no target is in the picture, or one is too near to be projected.
    """
    low, high, arm_px = np.array([np.inf, np.inf]), np.array([-np.inf, -np.inf]), 0.0
    T_camera_world, k = rigid.inverse(camera.T_world_camera), Intrinsics.of_window(camera, 0, 0, 1)
    axes = np.kron(np.eye(2), T_camera_world[:3, :3])
    for (T_world_target, corners), covariance in itertools.zip_longest(targets, covariances):
        T = T_camera_world @ T_world_target
        points = rigid.apply(T, corners)
        if points[:, 2].min() < NEAR_M:
            return None
        focal, centre = np.array([camera.fx, camera.fy]), np.array([camera.cx, camera.cy])
        pixels = points[:, :2] / points[:, 2:] * focal + centre
        metre_px = focal / points[:, 2].mean()
        margin, arm_px = MARGIN_M * metre_px, max(arm_px, ARM_M * float(metre_px.max()))
        if covariance is not None:
            margin = np.maximum(margin, SIGMAS * np.array(deviation(points, T[:3, 3], axes @ covariance @ axes.T, k)))
        low, high = np.minimum(low, pixels.min(axis=0) - margin), np.maximum(high, pixels.max(axis=0) + margin)
    return window_of(camera, low, high, arm_px, previous, most)


def window_of(
    picture: Sized, low: Array, high: Array, arm_px: float, previous: Window | None = None, most: int = MAX_PIXELS
) -> Window | None:
    """Window of at most `most` pixels that contains the visible part of the rectangle from low (2,) to high (2,), x and y [px].
    arm_px: width of an arm in the picture [px], at most WIDEST_ARM_PX in the window. The previous window is kept as in
    `window_around`. None where the rectangle lies outside the picture."""
    size = np.array([picture.width, picture.height])
    low, high = np.maximum(low, 0.0), np.minimum(high, size - 1.0)
    if np.any(high - low < 2.0):
        return None
    scale = 1
    while np.prod(np.maximum((high - low) / scale, 2 * STEP)) > most or arm_px > WIDEST_ARM_PX * scale:
        scale *= 2
    size = size // scale * scale  # the remainder is less than a pixel of the window
    if previous is not None and previous.scale == scale and _fits(previous, low, np.minimum(high, size - 1.0)):
        return previous
    unit = STEP * scale
    limit = np.maximum(size // unit * STEP, STEP)
    extent = np.minimum(np.ceil((high - low) / (scale * SIZE_STEP)).astype(int) * SIZE_STEP, limit)
    if previous is not None and previous.scale == scale:
        old = np.array([previous.width, previous.height]) // STEP * STEP
        extent = np.where((old >= extent) & (old <= extent + SIZE_STEP), old, extent)
    middle = (low + high) / 2.0
    first = np.clip(np.round((middle - extent * scale / 2.0) / unit).astype(int), 0, (limit - extent) // STEP) * STEP
    left = size // scale - first
    width, height = np.where(left - extent < STEP, left, extent).tolist()
    x0, y0 = (first * scale).tolist()
    return Window(x0, y0, width, height, scale)


def _fits(window: Window, low: Array, high: Array) -> bool:
    holds = window.x0 <= low[0] and window.y0 <= low[1] and high[0] < window.right and high[1] < window.bottom
    spare = np.array([window.width, window.height]) - (high - low) / window.scale
    return bool(holds and spare.max() < 3 * SIZE_STEP)
