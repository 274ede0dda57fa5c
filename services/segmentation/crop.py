"""Where to look: the window of the image around the predicted targets, and the recurrent state that moves along with it."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import torch

from services.segmentation.prednet import State
from shared import geometry
from shared.cell import Camera
from shared.geometry import Array

STEP = 8
"""Windows lie and measure in multiples of this many of their own pixels: the stride of the network's coarsest layer."""
SIZE_STEP = 32
"""Sizes are rounded up to this, so that the size seldom changes while the target turns."""
MAX_PIXELS = 224 * 224
"""Of a window around targets: what a step has time for. A larger target is looked at with a coarser scale."""
MAX_PIXELS_WHOLE = 320 * 240
"""Of the whole frame, when nobody knows where the target is."""
MARGIN_M = 0.04
"""Room around the target [m]: the prediction's error, and the surroundings that tell the contour."""
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


def extrapolate(T: Array, velocity: Array, dt_s: float) -> Array:
    """A pose after dt [s] at a constant twist (6,), linear [m/s] and angular [rad/s] along the fixed frame's axes."""
    return geometry.perturb(T, np.asarray(velocity) * dt_s)


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
    """The window of (nearly) the whole frame: what is left over at the right and lower edge is less than STEP pixels."""
    scale = 1
    while camera.width * camera.height > MAX_PIXELS_WHOLE * scale * scale:
        scale *= 2
    unit = STEP * scale
    return Window(0, 0, max(camera.width // unit, 1) * STEP, max(camera.height // unit, 1) * STEP, scale)


def window_around(camera: Camera, targets: Iterable[tuple[Array, Array]], previous: Window | None = None) -> Window | None:
    """The window that holds targets, given as (T_world_target (4, 4), corners (8, 3) of their box), with MARGIN_M of room.

    The previous window is kept while it holds them and is not much too large: the less it moves, the more the recurrent state
    is worth. None where no target is in the picture, or one is too near to the camera to say.
    """
    low, high = np.array([np.inf, np.inf]), np.array([-np.inf, -np.inf])
    for T_world_target, corners in targets:
        points = geometry.apply(geometry.inverse(camera.T_world_camera) @ T_world_target, corners)
        if points[:, 2].min() < NEAR_M:
            return None
        focal, centre = np.array([camera.fx, camera.fy]), np.array([camera.cx, camera.cy])
        pixels = points[:, :2] / points[:, 2:] * focal + centre
        margin = MARGIN_M * focal / points[:, 2].mean()
        low, high = np.minimum(low, pixels.min(axis=0) - margin), np.maximum(high, pixels.max(axis=0) + margin)
    size = np.array([camera.width, camera.height])
    low, high = np.maximum(low, 0.0), np.minimum(high, size - 1.0)
    if np.any(high - low < 2.0):
        return None
    scale = 1
    while np.prod(np.maximum((high - low) / scale, 2 * STEP)) > MAX_PIXELS:
        scale *= 2
    if previous is not None and previous.scale == scale and _fits(previous, low, high):
        return previous
    unit = STEP * scale
    limit = np.maximum(size // unit * STEP, STEP)
    extent = np.minimum(np.ceil((high - low) / (scale * SIZE_STEP)).astype(int) * SIZE_STEP, limit)
    if previous is not None and previous.scale == scale:
        old = np.array([previous.width, previous.height])
        extent = np.where((old >= extent) & (old <= extent + SIZE_STEP), old, extent)
    middle = (low + high) / 2.0
    x0, y0 = np.clip(np.round((middle - extent * scale / 2.0) / unit).astype(int), 0, (limit - extent) // STEP) * unit
    return Window(int(x0), int(y0), int(extent[0]), int(extent[1]), scale)


def _fits(window: Window, low: Array, high: Array) -> bool:
    holds = window.x0 <= low[0] and window.y0 <= low[1] and high[0] < window.right and high[1] < window.bottom
    spare = np.array([window.width, window.height]) - (high - low) / window.scale
    return bool(holds and spare.max() < 3 * SIZE_STEP)


def shift_state(state: State, strides: Sequence[int], old: Window, new: Window) -> State:
    """The recurrent state of `old` as that of `new` (same scale): what both see is kept, the rest has seen nothing (zero).

    Raises ValueError where the windows are not a whole number of the coarsest layer's positions apart.
    """
    unit = max(strides) * old.scale
    if old.scale != new.scale or (new.x0 - old.x0) % unit or (new.y0 - old.y0) % unit:
        raise ValueError(f"windows of one scale, multiples of {unit} pixels apart, expected, {old} and {new} came")
    out = []
    for tensor, stride in zip(state, strides, strict=True):
        dx, dy = ((new.x0 - old.x0) // (old.scale * stride), (new.y0 - old.y0) // (old.scale * stride))
        height, width = new.height // stride, new.width // stride
        moved = torch.zeros(*tensor.shape[:2], height, width, dtype=tensor.dtype).to(memory_format=torch.channels_last)
        rows = slice(max(0, dy), max(max(0, dy), min(tensor.shape[2], height + dy)))
        columns = slice(max(0, dx), max(max(0, dx), min(tensor.shape[3], width + dx)))
        moved[:, :, rows.start - dy : rows.stop - dy, columns.start - dx : columns.stop - dx] = tensor[:, :, rows, columns]
        out.append(moved)
    return tuple(out)
