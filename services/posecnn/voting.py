"""Hough voting: every pixel of the target names the direction to its centre, and the centre is where most of these rays meet.

Each ray adds its vote to all the cells that it passes through (Xiang et al. 2018, section III-C). The best cell is only where to
begin: the rays that pass near it are then intersected by weighted least squares, so that the centre is not tied to a grid.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from penumbra.shared.geometry.rigid import Array
from penumbra.shared.native import kernel

AGREES_RAD = 0.2
"""A ray that misses the centre by less than this angle agrees with it."""
NEAR_PX = 3.0
"""Pixels nearer to the centre than this cannot say much about its direction: there a ray agrees that misses by this at most."""
MARGIN = 1.0
"""Margin around the picture in which the centre is searched, in sides of the picture: it may be cut off or covered."""
ROUNDS = 4
"""Number of times that the centre is solved for from the rays that agree with it. Chosen, not measured."""


@dataclass(frozen=True)
class Vote:
    """centre (2,) [px]; agrees (n,): which pixels agree with it; spread [rad]: root mean square of the angles by which these miss
    it; share: of the pixels that agree."""

    centre: Array
    agrees: NDArray[np.bool_]
    spread: float
    share: float


def vote(pixels: Array, directions: Array, side: int, cell_px: float = 2.0) -> Vote:
    """The centre that pixels (n, 2) with unit directions (n, 2), x and y, in a picture of `side` pixels a side vote for.

    Raises ValueError where there are no pixels.
    """
    if not len(pixels):
        raise ValueError("vote: expected at least one pixel, got none")
    margin = MARGIN * side
    cells = math.ceil((side + 2.0 * margin) / cell_px)
    counts = np.zeros((cells, cells), np.int32)
    _cast(np.ascontiguousarray(pixels, np.float64), np.ascontiguousarray(directions, np.float64), -margin, cell_px, counts)
    row, column = divmod(int(np.argmax(_blurred(counts))), cells)
    centre = (np.array([column, row]) + 0.5) * cell_px - margin
    for _ in range(ROUNDS):
        agrees = _angles(pixels, directions, centre) < _tolerance(pixels, centre)
        if agrees.sum() < 2:
            break
        centre = intersection(pixels[agrees], directions[agrees], centre)
    angles = _angles(pixels, directions, centre)
    agrees = angles < _tolerance(pixels, centre)
    spread = float(np.sqrt(np.mean(np.minimum(angles[agrees], AGREES_RAD) ** 2))) if agrees.any() else AGREES_RAD
    return Vote(centre, agrees, spread, float(agrees.mean()))


def intersection(pixels: Array, directions: Array, around: Array) -> Array:
    """The point (2,) nearest to lines through pixels (n, 2) along unit directions (n, 2), near `around` (2,).

    A direction that is wrong by an angle misses by that times its pixel's distance, so lines weigh by the inverse square of that
    distance; nearly parallel lines leave the point where it was along them.
    """
    distance = np.hypot(*(pixels - around).T)
    weight = 1.0 / (distance**2 + NEAR_PX**2)
    normal = np.column_stack([-directions[:, 1], directions[:, 0]])
    H = (weight[:, None] * normal).T @ normal
    g = (weight[:, None] * normal).T @ np.sum(normal * (pixels - around), axis=1)
    return around + np.linalg.solve(H + 1e-4 * np.trace(H) * np.eye(2), g)


def _angles(pixels: Array, directions: Array, centre: Array) -> Array:
    """The angles (n,) [rad] by which rays miss a centre."""
    x, y = (centre - pixels).T
    return np.abs(np.arctan2(directions[:, 0] * y - directions[:, 1] * x, directions[:, 0] * x + directions[:, 1] * y))


def _tolerance(pixels: Array, centre: Array) -> Array:
    return np.maximum(AGREES_RAD, np.arctan2(NEAR_PX, np.hypot(*(pixels - centre).T)))


def _blurred(counts: NDArray[np.int32]) -> NDArray[np.int32]:
    """The sums over 3 x 3 cells: rays that cross at a cell's border count as one crossing."""
    rows = counts.copy()
    rows[1:] += counts[:-1]
    rows[:-1] += counts[1:]
    out = rows.copy()
    out[:, 1:] += rows[:, :-1]
    out[:, :-1] += rows[:, 1:]
    return out


@kernel("f8[n, 2], f8[n, 2], f8, f8, out i4[m, m]")
def _cast(pixels, directions, start, cell, counts):
    """Adds the votes of rays; cell (i, j) begins at (start + i cell, start + j cell) [px], row before column."""
    cells = len(counts)
    steps = int(math.ceil(1.5 * cells))
    for i in range(len(pixels)):
        x, y = (pixels[i, 0] - start) / cell, (pixels[i, 1] - start) / cell
        dx, dy = directions[i, 0], directions[i, 1]
        for _ in range(steps):
            column, row = int(math.floor(x)), int(math.floor(y))
            if column < 0 or row < 0 or column >= cells or row >= cells:
                break
            counts[row, column] += 1
            x += dx
            y += dy
