"""Finds the pose that a mask shows from a far start, for masks that are wrong in places.

  1. Turn the start about the object's middle in all directions (`starts`), and shift each so that silhouette and mask have the
     same middle and the same area (`align`).
  2. Take a few least-squares steps of contour against boundary on a small picture, and go on with the best poses (`descend`).
  3. Take more steps on the full picture, with less and less weight for points that are far off.
  4. Compare the hypotheses by the number of pixels in which silhouette and mask differ, and by their distances from the boundary.

The start itself counts as a weak measurement: of poses that explain the mask equally well, the nearest to the start is right.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from penumbra.services.search import evidence
from penumbra.services.search.contour import DROPPED, NEAR, Model, Points
from penumbra.services.search.evidence import COVERED, FREE, TARGET, Evidence
from penumbra.services.search.mask_fit import Noise
from penumbra.services.search.objects.creases import Creases
from penumbra.services.search.objects.paint import Paint
from penumbra.shared.geometry import rigid
from penumbra.shared.geometry.rigid import Array
from penumbra.shared.native import kernel
from penumbra.shared.perception.intrinsics import Intrinsics

Bool = NDArray[np.bool_]

COARSE_PX, FINE_PX = 45.0, 200.0
"""Square root of the mask's area [px] in the small and in the full picture, which are scaled down to it."""
TURNS = (14.0, 28.0)
"""Angles [deg] by which the starts are turned."""
AXES = 16
"""Number of axes about which the starts are turned."""
SURVIVORS = (14, 5)
"""Number of hypotheses kept after the alignment, and for the full picture."""
SAME = (0.01, 0.06)
"""Hypotheses nearer than this [m, rad] count as one."""
NOISE = Noise(edge=2.0, correlation=40.0, dilation=0.7)
"""Errors of a network's mask of any object [px of the image]."""
FARTHEST_PX = 8.0
"""Maximum distance from the mask's boundary [px of the image] with which a pixel counts: a missing part is one mistake."""
PIECE = 0.2
"""Share of the mask above which a piece of it is also tried as the whole object."""
AROUND = 0.5
"""Margin around the mask that is searched, in diagonals of the mask."""
DAMPING = 0.02
"""Share added to the diagonal of the normal equations (Marquardt)."""
STILL = (3e-4, 1.5e-3)
"""A step smaller than this [m, rad] is the last."""
MAX_STEP = np.array([0.08, 0.08, 0.15, 0.3, 0.3, 0.3])
"""Maximum step of a pass [m, rad] for an object a metre away."""


@dataclass(frozen=True)
class Shape:
    """An object about its own middle: a model with few triangles for the small picture, and one with all; its creases; and its
    colours for both, None if it has none."""

    coarse: Model
    fine: Model
    creases: Creases
    paints: tuple[Paint, Paint] | None

    @property
    def size(self) -> float:
        """Length of the bounding box's diagonal [m]."""
        return float(np.linalg.norm(np.ptp(self.coarse.vertices, axis=0)))


@dataclass(frozen=True)
class Level:
    """A mask in a picture whose pixels are `scale` image pixels wide; `distance` (h, w) float32: from each pixel's centre to the
    mask's boundary [px of this picture]."""

    evidence: Evidence
    distance: NDArray[np.float32]
    scale: int

    @property
    def shape(self) -> tuple[int, int]:
        return self.evidence.state.shape[0], self.evidence.state.shape[1]


def level(state: NDArray[np.uint8], k: Intrinsics, x0: int, y0: int, scale: int) -> Level:
    """The state (h, w) of the pixels from (x0, y0) on of an image with intrinsics k, scaled down."""
    if scale > 1:
        h, w = state.shape[0] // scale, state.shape[1] // scale
        cut = state[: h * scale, : w * scale]

        def share(kind: int) -> Array:
            return cv2.resize((cut == kind).astype(np.float32), (w, h), interpolation=cv2.INTER_AREA).astype(np.float64)

        target, covered = share(TARGET), share(COVERED)
        state = np.where(covered >= 0.5, COVERED, np.where(target > 0.5 * (1.0 - covered), TARGET, FREE)).astype(np.uint8)
    half = (scale - 1) / 2.0
    k = Intrinsics(k.fx / scale, k.fy / scale, (k.cx - x0 - half) / scale, (k.cy - y0 - half) / scale)
    target = (state == TARGET).astype(np.uint8)
    distance = np.where(
        target != 0, cv2.distanceTransform(target, cv2.DIST_L2, 5), cv2.distanceTransform(1 - target, cv2.DIST_L2, 5)
    )
    return Level(evidence.gather(state, np.zeros_like(state), k, x0, y0, scale), (distance - 0.5).astype(np.float32), scale)


@kernel("u1[h, w], f4[h, w], b1[h, w], f8, out i8[3] -> f8")
def _difference(state, distance, silhouette, farthest, counts):
    """The sum of distances [px] of the pixels in which a silhouette (h, w) and the mask differ. Writes the number of the mask's
    pixels that the silhouette covers, and of its pixels that are free, and that are covered."""
    total, both, free, covered = 0.0, 0, 0, 0
    for y in range(state.shape[0]):
        for x in range(state.shape[1]):
            if silhouette[y, x]:
                if state[y, x] == TARGET:
                    both += 1
                elif state[y, x] == FREE:
                    free += 1
                    total += min(distance[y, x], farthest)
                else:
                    covered += 1
            elif state[y, x] == TARGET:
                total += min(distance[y, x], farthest)
    counts[0], counts[1], counts[2] = both, free, covered
    return total


@dataclass(frozen=True)
class Score:
    """How well a pose explains a mask; `cost`: chi^2 of the pixels that differ and of the distance from the start."""

    cost: float
    both: int
    either: int
    covered: int

    @property
    def overlap(self) -> float:
        return self.both / max(self.either, 1)


@dataclass(frozen=True)
class Prior:
    """Prior of a pose: T_camera_object and the information (6, 6) about it along the camera's axes."""

    T: Array
    information: Array

    def cost(self, T: Array) -> float:
        error = rigid.pose_error(self.T, T)
        return float(error @ self.information @ error)


def score(model: Model, at: Level, T: Array, prior: Prior, noise: Noise = NOISE) -> Score:
    """How well a pose explains the mask."""
    h, w = at.shape
    silhouette = model.silhouette(T, at.evidence.intrinsics, (0, 0, w, h))
    counts = np.empty(3, np.int64)
    total = _difference(at.evidence.state, at.distance, silhouette, FARTHEST_PX / at.scale, counts)
    both, free, covered = counts.tolist()
    # the distances of the pixels that differ sum up to l r^2 / 2 for a contour that is off by r along a length l
    cost = 2.0 * total * at.scale**3 / (noise.edge**2 * noise.correlation)
    return Score(cost + prior.cost(T), both, at.evidence.seen_px + free, covered)


def starts(T: Array, angles: tuple[float, ...] = TURNS, count: int = AXES) -> list[Array]:
    """The pose T (4 x 4), and T turned about its origin by angles [deg] about `count` axes in all directions."""
    i = np.arange(count) + 0.5
    z = 1.0 - 2.0 * i / count  # a Fibonacci lattice on the sphere
    angle = np.pi * (1.0 + 5.0**0.5) * i
    axes = np.stack([np.sqrt(1.0 - z * z) * np.cos(angle), np.sqrt(1.0 - z * z) * np.sin(angle), z], axis=1)
    turns = [np.concatenate([np.zeros(3), np.radians(degrees) * axis]) for degrees in angles for axis in axes]
    return [T, *(rigid.perturb(T, turn) for turn in turns)]


Moments = tuple[float, float, float]
"""Area [px] and middle (u, v) of a region."""


def regions(at: Level) -> list[Moments]:
    """The whole mask, and, if it has several pieces, each of the large ones: the others may belong to another object."""
    target = at.evidence.state == TARGET
    count, _, sizes, middles = cv2.connectedComponentsWithStats(target.astype(np.uint8))
    areas = sizes[1:, cv2.CC_STAT_AREA]
    large = [i for i in range(count - 1) if areas[i] > PIECE * areas.sum()]
    pieces = [(float(areas[i]), float(middles[1 + i][0]), float(middles[1 + i][1])) for i in large] if count > 2 else []
    return [_moments(target), *pieces]


def align(model: Model, at: Level, T: Array, wanted: Moments) -> Array:
    """The pose shifted so that the silhouette's area and middle are those of a region; covered pixels do not count."""
    state, k = at.evidence.state, at.evidence.intrinsics
    h, w = at.shape
    for _ in range(2):  # the second time in the right place and of nearly the right size
        found = _moments(model.silhouette(T, k, (0, 0, w, h)) & (state != COVERED))
        T = T.copy()
        if found[0] < 4.0:  # outside the picture: its origin goes to the mask's middle
            T[:2, 3] = ((wanted[1] - k.cx) / k.fx * T[2, 3], (wanted[2] - k.cy) / k.fy * T[2, 3])
            continue
        T[:3, 3] *= min(max(math.sqrt(found[0] / wanted[0]), 0.6), 1.7)
        # along the line of sight the middle stays where it is in the image
        T[0, 3] += (wanted[1] - found[1]) / k.fx * T[2, 3]
        T[1, 3] += (wanted[2] - found[2]) / k.fy * T[2, 3]
    return T


def _moments(mask: Bool) -> Moments:
    columns, rows = mask.sum(axis=0), mask.sum(axis=1)
    area = float(columns.sum())
    if area == 0.0:
        return 0.0, 0.0, 0.0
    return area, float(columns @ np.arange(len(columns))) / area, float(rows @ np.arange(len(rows))) / area


@dataclass(frozen=True)
class Contour:
    """The contour at a pose: points (n,) as in `contour.Matched`, offsets r (n,) to the boundary and their kinds (n,)."""

    points: Points
    r: Array
    kind: NDArray[np.uint8]

    def jacobian(self, T: Array, k: Intrinsics) -> Array:
        """Jacobian (n, 7) of the contour's motion along its normal [px] by a pose error at T [m, rad] and the dilation [px]."""
        position, normal = self.points["position"], self.points["normal"]
        (X, Y, Z), (nx, ny) = position.T, normal.T
        J = np.empty((len(X), 7))
        J[:, 0], J[:, 1] = nx * k.fx / Z, ny * k.fy / Z
        J[:, 2] = -(J[:, 0] * X + J[:, 1] * Y) / Z
        J[:, 3:6] = np.cross(position - T[:3, 3], J[:, :3])  # a rotation vector w moves the point by w x (X - origin)
        J[:, 6] = 1.0
        return J


def contour(model: Model, at: Level, T: Array, reach: float, spacing: float = 2.0) -> Contour:
    """The contour at a pose, compared with the mask within `reach` [px of the level]."""
    found = model.matched(T, at.evidence, spacing, reach)
    return Contour(found.points, found.r, found.kind)


def robust(r: Array, width: float) -> Array:
    """Weights (n,) of offsets: those of Cauchy's distribution, by which a distant one counts almost nothing."""
    return 1.0 / (1.0 + np.square(r / width))


def information(found: Contour, at: Level, T: Array, width: float, noise: Noise) -> tuple[Array, Array]:
    """The information (6, 6) about the pose error at T and its right side (6,), from points whose weights decrease beyond an
    offset of `width` [px of the image]. The mask's dilation is marginalised (Schur complement)."""
    weights = found.points["length"] * robust(found.r, width / at.scale) * (found.kind != DROPPED)
    weights *= at.scale**3 / (noise.edge**2 * noise.correlation)
    J = found.jacobian(T, at.evidence.intrinsics)
    weighted = J * weights[:, None]
    H, g = weighted.T @ J, weighted.T @ found.r
    gain = H[:6, 6] / (H[6, 6] + (noise.dilation / at.scale) ** -2)
    return H[:6, :6] - np.outer(gain, H[6, :6]), g[:6] - gain * g[6]


def descend(model: Model, at: Level, T: Array, prior: Prior, widths: tuple[float, ...], noise: Noise = NOISE) -> Array:
    """Least-squares steps, one for each of `widths` [px of the image], the offset beyond which the points' weights decrease."""
    for width in widths:
        found = contour(model, at, T, max(3.0 * width / at.scale, 4.0))
        H, g = information(found, at, T, width, noise)
        H += prior.information
        H[_DIAGONAL] *= 1.0 + DAMPING
        step = np.linalg.solve(H, g + prior.information @ rigid.pose_error(prior.T, T))
        step /= max(1.0, float(np.max(np.abs(step) / MAX_STEP)))
        T = rigid.perturb(T, step)
        T[2, 3] = max(T[2, 3], 2.0 * NEAR)
        if width == widths[-1] and np.abs(step[:3]).max() < STILL[0] and np.abs(step[3:]).max() < STILL[1]:
            break
    return T


_DIAGONAL = np.diag_indices(6)


@dataclass(frozen=True)
class Pyramid:
    """A mask in a small and in the full picture."""

    coarse: Level
    fine: Level


def pyramid(state: NDArray[np.uint8], k: Intrinsics) -> Pyramid:
    """A mask cropped and scaled. `state` (h, w): FREE, TARGET or COVERED for every pixel of an image with intrinsics k."""
    target = state == TARGET
    rows, columns = np.flatnonzero(target.any(axis=1)), np.flatnonzero(target.any(axis=0))
    size = math.sqrt(np.count_nonzero(target))
    fine = max(1, int(size / FINE_PX))
    coarse = max(fine, round(size / COARSE_PX))
    margin = int(AROUND * math.hypot(rows[-1] - rows[0] + 1, columns[-1] - columns[0] + 1)) + 8 * coarse
    x0, y0 = max(int(columns[0]) - margin, 0), max(int(rows[0]) - margin, 0)
    window = state[y0 : rows[-1] + margin + 1, x0 : columns[-1] + margin + 1]
    return Pyramid(level(window, k, x0, y0, coarse), level(window, k, x0, y0, fine))


COARSE_WIDTHS = (16.0, 12.0, 10.0, 8.0, 8.0)
MORE_WIDTHS = (8.0, 6.0, 6.0, 5.0, 5.0)
FINE_WIDTHS = (5.0, 4.0, 4.0, 3.0, 3.0, 3.0)
"""Widths [px of the image] of the successive steps, see `descend`: for all hypotheses on the small picture, for the best ones
there, and for those on the full picture."""


def search(shape: Shape, masks: Pyramid, prior: Prior, noise: Noise = NOISE) -> list[tuple[Score, Array]]:
    """The poses T_camera_object near the prior that explain the mask best, best first."""
    model, at = shape.coarse, masks.coarse
    aligned = [align(model, at, T, region) for region in regions(at) for T in starts(prior.T)]
    found = ranked(model, at, aligned, prior, noise)[: SURVIVORS[0]]
    for widths in (COARSE_WIDTHS, MORE_WIDTHS):
        found = distinct(ranked(model, at, [descend(model, at, T, prior, widths, noise) for _, T in found], prior, noise))
    model, at = shape.fine, masks.fine
    poses = [descend(model, at, T, prior, FINE_WIDTHS, noise) for _, T in found[: SURVIVORS[1]]]
    return distinct(ranked(model, at, poses, prior, noise))


def ranked(model: Model, at: Level, poses: list[Array], prior: Prior, noise: Noise) -> list[tuple[Score, Array]]:
    """The poses with their scores, best first."""
    return sorted(((score(model, at, T, prior, noise), T) for T in poses), key=lambda one: one[0].cost)


def distinct(ranked: list[tuple[Score, Array]]) -> list[tuple[Score, Array]]:
    """The poses that have no better one nearby (SAME)."""
    kept: list[tuple[Score, Array]] = []
    for one in ranked:
        errors = [rigid.pose_error(one[1], T) for _, T in kept]
        if all(np.linalg.norm(e[:3]) > SAME[0] or np.linalg.norm(e[3:]) > SAME[1] for e in errors):
            kept.append(one)
    return kept
