"""The expected error as maps: slices of the workspace with the present pads and with the proposed ones."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.patches import Polygon
from scipy.spatial import ConvexHull

from penumbra.services.skin.placing.layout import FINE_M, Placing
from penumbra.services.skin.placing.scenes import GAP, Scenes
from penumbra.services.skin.placing.sensing import Sensing
from penumbra.shared.geometry import rigid
from penumbra.shared.geometry.rigid import Array

CELLS = 28
"""Number of squares along the longer side of a map."""
MARGIN = 0.10
"""Margin [m] of a map around the workspace."""
RANGE_CM = (0.1, 20.0)
"""Limits [cm] of the colour scale."""
AXES = "xyz"


@dataclass(frozen=True)
class Slice:
    """A plane through the workspace. across: the axis of the world normal to it; at: its position on that axis [m]; errors (rows,
    columns) [m]: by the two other axes, nan where the limb would touch something; extent: of these axes."""

    across: int
    at: float
    errors: Array
    extent: tuple[float, float, float, float]

    @property
    def axes(self) -> tuple[int, int]:
        """The axes to the right and upwards."""
        right, up = (axis for axis in range(3) if axis != self.across)
        return right, up


def write(path: Path, placing: Placing, layouts: Mapping[str, Sensing]) -> None:
    """Write maps of these layouts side by side, as PNG. Raises OSError."""
    figure = Figure(figsize=(4.6 * len(layouts) + 1.2, 7.4), layout="constrained")
    grid = figure.subplots(2, len(layouts), squeeze=False)
    picture, bounds = None, _bounds(placing, layouts)
    for column, (title, sensing) in enumerate(layouts.items()):
        for row, across in enumerate((2, 0)):
            cut, axes = slice_of(placing, sensing, across, bounds), grid[row, column]
            picture = axes.imshow(
                100.0 * cut.errors,
                origin="lower",
                extent=tuple(100.0 * side for side in cut.extent),
                cmap="viridis_r",
                norm=LogNorm(*RANGE_CM),
                interpolation="nearest",
            )
            _surroundings(axes, placing, sensing, cut)
            right, up = cut.axes
            axes.set_title(f"{title}, {AXES[across]} = {100 * cut.at:.0f} cm", fontsize=10)
            axes.set_xlabel(f"{AXES[right]} of the limb's middle, cm")
            axes.set_ylabel(f"{AXES[up]}, cm")
            axes.set_xlim(*(100.0 * side for side in cut.extent[:2]))
            axes.set_ylim(*(100.0 * side for side in cut.extent[2:]))
    if picture is not None:
        bar = figure.colorbar(
            picture, ax=grid, label="expected error of the position, cm (line: 2 cm; white: the limb would touch)", shrink=0.8
        )
        ticks = [0.1, 0.2, 0.5, 1, 2, 5, 10, 20]
        bar.set_ticks(ticks, labels=[f"{tick:g}" for tick in ticks])
    figure.savefig(path, dpi=130)


def _bounds(placing: Placing, layouts: Mapping[str, Sensing]) -> Array:
    """Corners (2, 3) [m] in the world of the mapped region: the workspace and the pads."""
    low, high = np.percentile(placing.fresh.targets[:, :3, 3], [2.0, 98.0], axis=0)
    middle = placing.drawing.middle
    pads = np.array([(middle[pad.link][0] @ pad.T_link_pad)[:3, 3] for each in layouts.values() for pad in each.pads])
    edge = 0.6 * max(placing.board.size)
    return np.stack([np.minimum(low - MARGIN, pads.min(axis=0) - edge), np.maximum(high + MARGIN, pads.max(axis=0) + edge)])


def slice_of(placing: Placing, sensing: Sensing, across: int, bounds: Array) -> Slice:
    """The map of a layout normal to an axis of the world, through the middle of the workspace, within bounds (2, 3) [m]. The limb
    has its home orientation, and the robots are in the middle of their joints' bounds."""
    low, high = bounds
    at = float(np.median(placing.fresh.targets[:, across, 3]))
    right, up = (axis for axis in range(3) if axis != across)
    side = max(high[right] - low[right], high[up] - low[up]) / CELLS
    columns, rows = (low[axis] + side * (np.arange(round((high[axis] - low[axis]) / side)) + 0.5) for axis in (right, up))
    targets = np.tile(placing.drawing.target.home.transform, (len(rows) * len(columns), 1, 1))
    targets[:, across, 3] = at
    targets[:, right, 3], targets[:, up, 3] = np.tile(columns, len(rows)), np.repeat(rows, len(columns))
    middle = placing.drawing.middle
    free = np.array([placing.drawing.gaps(T, middle, placing.room)[0] >= GAP for T in targets])
    errors = np.full(len(targets), np.nan)
    if free.any():
        links = {name: np.tile(T, (int(free.sum()), 1, 1)) for name, T in middle.items()}
        errors[free] = sensing.errors(Scenes(targets[free], links))
    extent = (columns[0] - 0.5 * side, columns[-1] + 0.5 * side, rows[0] - 0.5 * side, rows[-1] + 0.5 * side)
    return Slice(across, at, errors.reshape(len(rows), len(columns)), extent)


def _surroundings(axes: Axes, placing: Placing, sensing: Sensing, cut: Slice) -> None:
    """The line of 2 cm, links of robots, and pads."""
    right, up = cut.axes
    if np.isfinite(cut.errors).all() or np.isfinite(cut.errors).sum() > 4:
        rows, columns = cut.errors.shape
        x = np.linspace(*cut.extent[:2], 2 * columns + 1)[1::2]
        y = np.linspace(*cut.extent[2:], 2 * rows + 1)[1::2]
        low, high = np.nanmin(cut.errors), np.nanmax(cut.errors)
        if low < FINE_M < high:
            axes.contour(100 * x, 100 * y, 100 * cut.errors, levels=[100 * FINE_M], colors="white", linewidths=1.2)
    middle = placing.drawing.middle
    for name, points in placing.room.solids.items():
        seen = 100.0 * rigid.apply(middle[name][0], points)[:, [right, up]]
        outline = seen[ConvexHull(seen).vertices]
        axes.add_patch(Polygon(outline, facecolor="#00000018", edgecolor="#00000060", linewidth=0.6))
    x, y = 0.5 * np.asarray(placing.board.size)
    corners = np.array([(-x, -y, 0.0), (x, -y, 0.0), (x, y, 0.0), (-x, y, 0.0)])
    for pad in sensing.pads:
        seen = 100.0 * rigid.apply(middle[pad.link][0] @ pad.T_link_pad, corners)[:, [right, up]]
        axes.add_patch(Polygon(seen, facecolor="#d4543999", edgecolor="#7a1f0c", linewidth=1.0))
