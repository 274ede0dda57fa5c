"""Where to look: the window of the image around the predicted targets, around their homes when they are lost."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from penumbra.shared.body import anatomy
from penumbra.shared.cell.description import Camera, Cell
from penumbra.shared.contract.messages import FusedPose
from penumbra.shared.geometry import rigid
from penumbra.shared.geometry.rigid import Array
from penumbra.shared.perception.prediction import predict

STEP = 16
"""Windows begin at multiples of this many of their own pixels, the stride of the coarsest of five layers. Their sides are
multiples of it, too, unless they end where the picture does."""
SIZE_STEP = 32
"""Sizes are rounded up to this, so that the size seldom changes while the target turns."""
MAX_PIXELS = 224 * 224
"""Largest window around targets. A larger target is shown at a coarser scale."""
MAX_PIXELS_WIDE = 320 * 240
"""Largest window of the whole frame, or around all targets' homes, while one of the targets is lost."""
HOME_SIGMAS = 2.0
"""Distance from its home, in standard deviations, within which a lost target is looked for: further away nothing would be
taken for it."""
ARM_M = 0.09
"""Width [m] of a forearm's belly (circumference 0.28 to 0.31 m) and of a hand with its thumb laid on (ANSUR II, Gordon et al.
2014)."""
WIDEST_ARM_PX = 56
"""An arm that is wider [px] is shown at a coarser scale, at which the network sees more than smooth skin at once: the widest that
it is trained with."""
MARGIN_M = 0.04
"""Margin around the target [m]: the prediction's error, and the surroundings that show the contour."""
NEAR_M = 0.1
"""A target with a part nearer to the camera than this is not projected."""


@dataclass(frozen=True)
class Window:
    """A window of a frame: pixel (r, c) of `height` x `width` covers `scale` x `scale` image pixels from
    (y0 + r * scale, x0 + c * scale) on, as in `messages.Mask`."""

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
    """The corners (8, 3) of the box around vertices (n, 3), in their frame."""
    low, high = np.min(vertices, axis=0), np.max(vertices, axis=0)
    x, y, z = np.meshgrid(*zip(low, high, strict=True), indexing="ij")
    return np.column_stack([x.ravel(), y.ravel(), z.ravel()])


class Sized(Protocol):
    """Something so many pixels wide and high: a camera, a window."""

    @property
    def width(self) -> int: ...
    @property
    def height(self) -> int: ...


def whole_frame(camera: Sized) -> Window:
    """The window of the whole frame, at the scale at which it is looked at."""
    scale = 1
    while camera.width * camera.height > MAX_PIXELS_WIDE * scale * scale:
        scale *= 2
    return reduced(camera, scale)


def reduced(picture: Sized, scale: int) -> Window:
    """The window of a whole picture at a scale, but for less than `scale` pixels at the right and lower edge."""
    return Window(0, 0, max(picture.width // scale, 1), max(picture.height // scale, 1), scale)


class Lookout:
    """Where to look in the frames of one camera: around the targets of its cell as fusion predicts them, and around the homes of
    those that are lost. targets: those that it can see, by what its picture shows of the region around their homes; most: pixels
    of the largest window around those that are not."""

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
        """Takes the newest fused pose of a target; of one that it cannot see nothing is kept."""
        if pose.target in self._boxes:
            self._poses[pose.target] = pose

    @property
    def window(self) -> Window:
        """The window last looked at, at first that around all homes."""
        return self._window

    @property
    def at_home(self) -> Window:
        """The window if all targets were found at their homes: one of its size is likely the next after that around all homes."""
        return window_around(self._camera, self._at_home, None, self._most) or self._wide()

    def look(self, stamp_ns: int) -> Window:
        """The window for a frame exposed at a stamp: kept where it was while it does (`window_around`)."""
        self._window = self.foresee(stamp_ns)
        return self._window

    def predicted(self, stamp_ns: int) -> dict[str, tuple[Array, Array]]:
        """T_world_target and covariance (6, 6) at a stamp, by target, of those that it can see and that are not lost."""
        found = {}
        for name in self._boxes:
            T, covariance = predict(self._poses.get(name), stamp_ns)
            if T is not None and covariance is not None:
                found[name] = T, covariance
        return found

    def foresee(self, stamp_ns: int) -> Window:
        """The window that `look` would give next, for a frame of this stamp."""
        known = self.predicted(stamp_ns)
        sure = [(T, self._boxes[name]) for name, (T, _) in known.items()]
        found = window_around(self._camera, sure, self._window, self._most) if len(sure) == len(self._boxes) else None
        return found or self._wide([name for name in self._boxes if name not in known], sure)

    def _wide(self, lost: Iterable[str] = (), sure: Iterable[tuple[Array, Array]] = ()) -> Window:
        homes = [self._homes[name] for name in lost or self._homes]
        return window_around(self._camera, [*homes, *sure], None, MAX_PIXELS_WIDE) or whole_frame(self._camera)


def _is_in_picture(camera: Camera, region: Array) -> bool:
    """Whether a camera may see something of a box, given as its corners (8, 3) in the world: unless all of them lie beyond one
    side of what it sees."""
    x, y, z = rigid.apply(rigid.inverse(camera.T_world_camera), region).T
    u, v = camera.fx * x + camera.cx * z, camera.fy * y + camera.cy * z
    sides = (z - NEAR_M, u, camera.width * z - u, v, camera.height * z - v)
    return all((side >= 0.0).any() for side in sides)


def window_around(
    camera: Camera, targets: Iterable[tuple[Array, Array]], previous: Window | None = None, most: int = MAX_PIXELS
) -> Window | None:
    """The window of at most `most` pixels, before its sides are rounded up, that holds targets, given as (T_world_target (4, 4),
    corners (8, 3) of their box), with a margin of MARGIN_M, arms of ARM_M at most WIDEST_ARM_PX wide.

    The previous window is kept while it holds them and is not much too large: the less it moves, the more the recurrent state
    is worth. None where no target is in the picture, or one is too near to the camera to say.
    """
    low, high, arm_px = np.array([np.inf, np.inf]), np.array([-np.inf, -np.inf]), 0.0
    for T_world_target, corners in targets:
        points = rigid.apply(rigid.inverse(camera.T_world_camera) @ T_world_target, corners)
        if points[:, 2].min() < NEAR_M:
            return None
        focal, centre = np.array([camera.fx, camera.fy]), np.array([camera.cx, camera.cy])
        pixels = points[:, :2] / points[:, 2:] * focal + centre
        metre_px = focal / points[:, 2].mean()
        margin, arm_px = MARGIN_M * metre_px, max(arm_px, ARM_M * float(metre_px.max()))
        low, high = np.minimum(low, pixels.min(axis=0) - margin), np.maximum(high, pixels.max(axis=0) + margin)
    return window_of(camera, low, high, arm_px, previous, most)


def window_of(
    picture: Sized, low: Array, high: Array, arm_px: float, previous: Window | None = None, most: int = MAX_PIXELS
) -> Window | None:
    """The window of at most `most` pixels that holds the rectangle from low (2,) to high (2,), x and y [px], as far as it lies in
    the picture, an arm so wide in the picture at most WIDEST_ARM_PX wide; the previous one is kept as `window_around` says. None
    where nothing of it lies in the picture."""
    size = np.array([picture.width, picture.height])
    low, high = np.maximum(low, 0.0), np.minimum(high, size - 1.0)
    if np.any(high - low < 2.0):
        return None
    scale = 1
    while np.prod(np.maximum((high - low) / scale, 2 * STEP)) > most or arm_px > WIDEST_ARM_PX * scale:
        scale *= 2
    size = size // scale * scale  # less than a pixel of the window is left over
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
