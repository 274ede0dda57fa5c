"""Evidence of a mask: whether each pixel shows the target, is free of it, or is covered by something."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from penumbra.shared.cell.description import Camera
from penumbra.shared.contract.labels import Label
from penumbra.shared.native import kernel
from penumbra.shared.perception.intrinsics import Intrinsics

FREE, TARGET, COVERED = 0, 1, 2
"""State of a pixel. COVERED: something is in front of the target, or the pixel is unknown. Other parts of the limb count as
covering, too: the upper arm's rounded end hides a few centimetres of the elbow, so their border is not the target's contour."""

SMOOTHING_PX = 1.0
"""Standard deviation [px] of the blur that makes the boundary of a hard mask sub-pixel: about the period of its stairs."""
TAPS = (0.000133831, 0.004431862, 0.053991128, 0.241971445, 0.398943469, 0.241971445, 0.053991128, 0.004431862, 0.000133831)
"""Weights of that blur along rows and along columns, equal to OpenCV's."""
LEAST_KNOWN = 1e-3
"""Smoothed share of known pixels below which a pixel counts as unknown."""
NOTHING_COVERED = np.empty((0, 0), np.float32)
"""`Evidence.known` if no pixel is covered."""
INNER = 0.84
"""Smoothed share of the target below which a target pixel is on a boundary. A straight boundary then has one such pixel per pixel
of its length."""
GUARD_PX = 2
"""Distance [px] from a covered pixel within which a boundary may be the occluder's and not the target's."""
DEPTH_MARGIN = 0.05
"""Distance [m] behind the target's farthest point beyond which something is certainly behind it: half a limb's thickness."""

UNEXPLAINED_PX, PREDICTED_PX = 5, 10
"""Distances [px]: within the first of a mask's target, its boundary may be the target's own; by the second, the prediction may be
off."""
FORESHORTENED = 0.4
"""Minimum length of a limb's image relative to that of a limb parallel to it: a shorter one has no side beyond its end."""


@dataclass(frozen=True)
class Evidence:
    """`state` (h, w) uint8; `field` (h, w) float32: smoothed share of the target among known pixels, 0.5 on its boundary;
    `guarded` (h, w) uint8: 1 near COVERED pixels; `hand` (h, w) uint8: 1 on the target's hand, which lies towards +x; `known` (h,
    w) float32: smoothed share of known pixels, (0, 0) if all are known; `seen_px`: number of pixels that show the target;
    `boundary_px`: number of those on the target's own boundary; `x0`, `y0`, `scale`: window as in `messages.Mask`."""

    state: NDArray[np.uint8]
    field: NDArray[np.float32]
    guarded: NDArray[np.uint8]
    hand: NDArray[np.uint8]
    seen_px: int
    boundary_px: int
    intrinsics: Intrinsics
    known: NDArray[np.float32]
    x0: int = 0
    y0: int = 0
    scale: int = 1

    def measurements(self, correlation: float) -> float:
        """Number of independent measurements of the boundary, plus six for the unknowns of a pose."""
        return self.boundary_px / correlation + 6.0


def classify(
    labels: NDArray[np.uint8],
    target_labels: Collection[int],
    robot_depth: NDArray[np.float32] | None = None,
    reach: tuple[float, float] = (0.0, 0.0),
) -> NDArray[np.uint8]:
    """The state (h, w) of every pixel of a mask of class indices (h, w).

    `robot_depth` (h, w) [m], infinite outside the robot, overrides the mask if given. `reach`: the target's smallest and largest
    depth [m]. A robot in front of the target covers it, and a robot behind the target is background.
    """
    table = np.full(256, COVERED, np.uint8)
    table[[Label.BACKGROUND, Label.TORSO]] = FREE
    table[list(target_labels)] = TARGET
    state = table[labels]
    if robot_depth is not None:
        behind = (robot_depth > reach[1] + DEPTH_MARGIN) & np.isfinite(robot_depth)
        before = robot_depth < reach[0]
        between = np.isfinite(robot_depth) & ~behind & (state != TARGET)
        state[behind & (labels == Label.ROBOT)] = FREE
        state[before | between] = COVERED
    return state


def cover_outside(state: NDArray[np.uint8], x0: int, y0: int, scale: int, camera: Camera) -> None:
    """Marks in place as COVERED the pixels of a window (first pixel x0, y0) outside the image: nothing is known there."""
    h, w = state.shape
    left, top = max(0, -(x0 // scale)), max(0, -(y0 // scale))
    right, bottom = (camera.width - x0) // scale, (camera.height - y0) // scale
    state[:top], state[:, :left] = COVERED, COVERED
    state[max(bottom, 0) : h], state[:, max(right, 0) : w] = COVERED, COVERED


def cover_beyond(state: NDArray[np.uint8], T: NDArray[np.float64], start: float, k: Intrinsics) -> None:
    """Marks in place as COVERED the target's pixels beyond the near end of a limb: the body continues there, and where bare skin
    meets bare skin a mask does not show the joint. T_camera_target (4 x 4) has the limb along x, which begins at `start` [m]. A
    limb that points at the camera has no such side in the image, and is left as it is.
    """
    ends = T[:3, 3] + np.outer([start, 0.0], T[:3, 0])
    if ends[:, 2].min() <= 0.0:
        return
    (u, v), (u1, v1) = ends[:, :2] / ends[:, 2:] * (k.fx, k.fy) + (k.cx, k.cy)
    along = np.array([u1 - u, v1 - v])
    length = float(np.hypot(*along))
    if length < FORESHORTENED * k.fx * abs(start) / ends[0, 2]:
        return
    rows, columns = np.arange(state.shape[0])[:, None], np.arange(state.shape[1])
    beyond = ((columns - u) * along[0] + (rows - v) * along[1]) / length < 0.0
    state[beyond & (state == TARGET)] = COVERED


def cover_unexplained(state: NDArray[np.uint8], predicted: NDArray[np.bool_]) -> None:
    """Marks in place as COVERED the free pixels in or near the predicted silhouette (h, w) and far from all target pixels: if the
    prediction is right, something hides it there, though the mask says background."""
    far = cv2.distanceTransform((state != TARGET).astype(np.uint8), cv2.DIST_L2, 3) > UNEXPLAINED_PX
    around = cv2.dilate(predicted.astype(np.uint8), np.ones((2 * PREDICTED_PX + 1, 2 * PREDICTED_PX + 1), np.uint8))
    state[(state == FREE) & far & (around != 0)] = COVERED


def gather(
    state: NDArray[np.uint8], labels: NDArray[np.uint8], intrinsics: Intrinsics, x0: int = 0, y0: int = 0, scale: int = 1
) -> Evidence:
    """The evidence of a mask from its states and labels (h, w); `x0`, `y0`, `scale`: its window as in `messages.Mask`."""
    state = np.ascontiguousarray(state)
    target = (state == TARGET).astype(np.float32)
    covered = (state == COVERED).astype(np.uint8)
    known = _blur((1 - covered).astype(np.float32)) if covered.any() else NOTHING_COVERED
    field = _blur(target)
    if known.size:
        field = np.divide(field, known, out=np.zeros_like(field), where=known > LEAST_KNOWN)
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * GUARD_PX + 1, 2 * GUARD_PX + 1))
    guarded = cv2.dilate(covered, disc, borderType=cv2.BORDER_CONSTANT, borderValue=1)
    hand = ((labels == Label.HAND) & (state == TARGET)).astype(np.uint8)
    seen_px = int(np.count_nonzero(target))
    boundary_px = _boundary_px(state, field, guarded)
    return Evidence(
        state, field, guarded.astype(np.uint8, copy=False), hand, seen_px, boundary_px, intrinsics, known, x0, y0, scale
    )


@kernel("u1[h, w], f4[h, w], u1[h, w] -> i8")
def _boundary_px(state, field, guarded):
    count = 0
    for y in range(state.shape[0]):
        for x in range(state.shape[1]):
            if state[y, x] == TARGET and field[y, x] < INNER and guarded[y, x] == 0:
                count += 1
    return count


def _blur(image: NDArray[np.float32]) -> NDArray[np.float32]:
    return cv2.GaussianBlur(image, (0, 0), SMOOTHING_PX, borderType=cv2.BORDER_REPLICATE).astype(np.float32, copy=False)


def compare(state: NDArray[np.uint8], silhouette: NDArray[np.bool_]) -> tuple[int, int]:
    """Numbers of pixels of a silhouette (h, w) that show the target, and that are free, by a mask's states (h, w)."""
    counts = np.empty(2, np.int64)
    count_compared(state, silhouette, counts)
    both, free = counts.tolist()
    return both, free


@kernel("u1[h, w], b1[h, w], out i8[2]")
def count_compared(state, silhouette, counts):
    """Writes the two counts of `compare`."""
    both, free = 0, 0
    for y in range(state.shape[0]):
        a, b = 0, 0
        for x in range(state.shape[1]):  # without branches, so that it runs on vectors
            a += silhouette[y, x] & (state[y, x] == TARGET)
            b += silhouette[y, x] & (state[y, x] == FREE)
        both += a
        free += b
    counts[0], counts[1] = both, free
