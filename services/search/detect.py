"""Finds the target in a mask without a prediction: hypotheses from the mask's moments and the mesh's proportions."""

from __future__ import annotations

import itertools
from collections.abc import Collection, Iterator

import cv2
import numpy as np
from msgspec.structs import replace
from numpy.typing import NDArray

from penumbra.services.search.contour import Model
from penumbra.services.search.evidence import TARGET, Evidence
from penumbra.shared.contract.labels import Label
from penumbra.shared.contract.messages import Mask
from penumbra.shared.geometry import rigid
from penumbra.shared.geometry.rigid import Array

SMALLEST_PX = 150
"""Minimum number of pixels of a region whose shape can be used."""
MOST_PARTS = 3
"""Maximum number of regions that are tried, largest first: furniture that a network labels as the target may be larger."""
TILTS = (-0.6, -0.3, 0.0, 0.3, 0.6)
"""Samples of the angle [rad] between the limb's axis and the image plane."""
ROLLS = (0.0, np.pi)
"""Samples of the roll [rad] about the axis, relative to that at home: the same, and the limb turned over."""
SLIDES = (-0.3, -0.15, 0.0, 0.15, 0.3)
"""Samples of the limb's middle along its axis, from the visible part's, in lengths of the limb: one end may be hidden."""


def is_shown(mask: Mask, target_labels: Collection[int]) -> bool:
    """Whether a mask shows at least SMALLEST_PX pixels of a target."""
    return bool(np.count_nonzero(np.isin(mask.labels, list(target_labels))) >= SMALLEST_PX)


def regions(mask: Mask, target_labels: Collection[int], reach_px: float) -> Iterator[tuple[Mask, list[Mask]]]:
    """Windows of a mask, `reach_px` around each region with the target's labels, largest first, each with the masks to start
    from: the whole region, then either half. A network may label a bare upper arm as the target, too, so that the region has a
    bend. The other half, and the regions of earlier windows, are marked as unknown.
    """
    labels = mask.labels.copy()
    _, numbers, stats, centroids = cv2.connectedComponentsWithStats(np.isin(labels, list(target_labels)).astype(np.uint8))
    by_size = 1 + np.argsort(-stats[1:, cv2.CC_STAT_AREA])
    for region in by_size[:MOST_PARTS]:
        if stats[region, cv2.CC_STAT_AREA] < SMALLEST_PX:
            return
        u, v = centroids[region]
        rows = slice(max(int(v - reach_px), 0), int(v + reach_px) + 1)
        columns = slice(max(int(u - reach_px), 0), int(u + reach_px) + 1)
        x0, y0 = mask.x0 + columns.start * mask.scale, mask.y0 + rows.start * mask.scale
        inside = numbers == region
        window = replace(mask, labels=np.ascontiguousarray(labels[rows, columns]), x0=x0, y0=y0)
        halves = [
            replace(window, labels=np.where(other[rows, columns], np.uint8(Label.OCCLUDER), window.labels))
            for other in _halves(inside)
        ]
        yield window, [window, *halves]
        labels = np.where(inside, np.uint8(Label.OCCLUDER), labels)


def _halves(inside: NDArray[np.bool_]) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """The two halves of a region (h, w), cut through its middle across its longest direction."""
    pixels = np.argwhere(inside)
    from_middle = pixels - pixels.mean(axis=0)
    longest = np.linalg.eigh(from_middle.T @ from_middle)[1][:, 1]
    one, other = np.zeros_like(inside), np.zeros_like(inside)
    one[tuple(pixels[from_middle @ longest > 0.0].T)] = True
    other[tuple(pixels[from_middle @ longest <= 0.0].T)] = True
    return one, other


def hypotheses(model: Model, evidence: Evidence, T_home: Array) -> list[Array]:
    """Poses T_camera_target (4 x 4 each) that may have produced the mask's largest region; empty if it is too small.

    The region's second moments give the axis in the image, its hand pixels the direction, its width a depth, beside that of
    `T_home` (T_camera_target where the target is expected). Rolls are relative to `T_home`.
    """
    count, regions, stats, centroids = cv2.connectedComponentsWithStats((evidence.state == TARGET).astype(np.uint8))
    largest = 1 + int(np.argmax(stats[1:, cv2.CC_STAT_AREA])) if count > 1 else 0
    if largest == 0 or stats[largest, cv2.CC_STAT_AREA] < SMALLEST_PX:
        return []
    k = evidence.intrinsics
    rows, columns = np.nonzero(regions == largest)
    spread, axes = np.linalg.eigh(np.cov(np.stack([columns, rows])))
    # a uniform strip of width b has variance b^2 / 12 across; the mesh's own width is measured in the same way
    depth = float(k.fx * np.std(model.vertices[:, 1]) / np.sqrt(max(spread[0], 0.01)))
    z_home = float(T_home[2, 3])
    depths = (z_home, float(np.clip(depth, z_home / 3.0, z_home * 3.0)))
    u, v = centroids[largest]
    ray = np.array([(u - k.cx) / k.fx, (v - k.cy) / k.fy, 1.0])
    middle = model.vertices.mean(axis=0)
    slides = np.array(SLIDES) * np.ptp(model.vertices[:, 0])

    found = []
    for toward_hand, tilt, roll in itertools.product(_directions(evidence, rows, columns, axes[:, 1]), TILTS, ROLLS):
        x = np.array([*(np.cos(tilt) * toward_hand), np.sin(tilt)])
        R = rigid.rotation(roll * x) @ _shortest_rotation(T_home[:3, 0], x) @ T_home[:3, :3]
        for z, slide in itertools.product(depths, slides):
            T = np.eye(4)
            T[:3, :3] = R
            T[:3, 3] = ray * z - R @ middle + x * slide
            found.append(T)
    return found


def mirrored(T: Array) -> list[Array]:
    """Poses (4 x 4 each) with nearly the same silhouette as T_camera_target: the axis tilted the other way out of the image
    plane, or another roll. A fit that stopped at one of them is restarted from the others."""
    return [tilted(T, -2.0 * tilt(T)), rolled(T, 0.6), rolled(T, -0.6)]


def tilt(T: Array) -> float:
    """The angle [rad] from the image plane to the axis of T_camera_target (4 x 4), positive away from the camera."""
    return float(np.arcsin(np.clip(T[:3, 0] @ T[:3, 3] / np.linalg.norm(T[:3, 3]), -1.0, 1.0)))


def tilted(T: Array, angle: float) -> Array:
    """T_camera_target (4 x 4) with its axis turned away from the camera by an angle [rad]."""
    out = T.copy()
    out[:3, :3] = rigid.rotation(angle * _perpendicular(T[:3, 0], T[:3, 3])) @ T[:3, :3]
    return out


def rolled(T: Array, angle: float) -> Array:
    """T_camera_target (4 x 4) turned about its axis by an angle [rad]."""
    out = T.copy()
    out[:3, :3] = rigid.rotation(angle * T[:3, 0]) @ T[:3, :3]
    return out


def _directions(evidence: Evidence, rows: NDArray[np.intp], columns: NDArray[np.intp], axis: Array) -> list[Array]:
    """The axis (2,) in the image, pointing to the hand; both directions if the hand is not recognised."""
    is_hand = evidence.hand[rows, columns] != 0
    if not 0.02 < is_hand.mean() < 0.75:  # where nearly all is labelled as hand, the labels say nothing
        return [axis, -axis]
    pixels = np.column_stack([columns, rows])
    lead = (pixels[is_hand].mean(axis=0) - pixels[~is_hand].mean(axis=0)) @ axis
    return [axis if lead > 0 else -axis]


def _shortest_rotation(a: Array, b: Array) -> Array:
    """The rotation matrix of the shortest arc from unit vector a (3,) to b (3,); about any perpendicular if they are opposite."""
    return rigid.rotation(np.arctan2(np.linalg.norm(np.cross(a, b)), a @ b) * _perpendicular(a, b))


def _perpendicular(a: Array, b: Array) -> Array:
    """The unit vector (3,) along a x b; any that is perpendicular to a, if they are parallel."""
    axis = np.cross(a, b)
    if np.linalg.norm(axis) < 1e-9:
        axis = np.cross(a, np.eye(3)[np.argmin(np.abs(a))])
    return np.asarray(axis / np.linalg.norm(axis), np.float64)
